"""Draw ten frames, their reconstructions and open-loop predictions (the paper's appendix on reconstructions)."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from forbes.data import Experience, Replay, SequenceBatch, SequenceData, SequenceSource, Split
from forbes.errors import ForbesError
from forbes.evaluation.methods import group_by_method, read_run
from forbes.evaluation.predictions import complete, true_frames
from forbes.evaluation.runs import TrainedRun, load_runs
from forbes.figures.agents import variant_styles
from forbes.figures.grids import Panel, draw_bands, require_images
from forbes.figures.style import BLACK, Method
from forbes.models import StateSpaceModel
from forbes.runs.folder import RunFolder
from forbes.seeding import forked
from forbes.shapes import Observed

__all__ = ["draw_reconstructions", "reconstructions"]

_FRAMES = 10


def draw_reconstructions(runs: Sequence[str], index: Sequence[int] = (0,), context: int = 5) -> dict[str, Figure]:
    """Draw ten frames of stored sequences with the reconstructions and predictions of each model.

    Sequences are of the test split, or the validation or training split if there is no other; those of an agent are
    the beginnings of its episodes, the newest first. Models with the same sequences share a figure. Of runs that differ
    only in the seed, the first is drawn.

    Args:
        runs: run folders of world models or agents that observe images.
        index: sequences to draw, counted from 0.
        context: number of frames that a model sees before it predicts.

    Raises:
        ForbesError: if the observations are no images, or there are no such sequences.
    """
    grouped = group_by_method([read_run(path) for path in runs])
    drawn = {}
    for task, of_task in grouped.items():
        styles = variant_styles({title: of_one[0].method for title, of_one in of_task.items()})
        trained = load_runs([of_one[0].path for of_one in of_task.values()])
        batches = [_shown(run, index, context) for run in trained]
        for first, batch in enumerate(batches):
            same = [place for place, other in enumerate(batches) if _same(other.observation, batch.observation)]
            if same[0] == first:
                chosen = {title: trained[place] for place, title in enumerate(of_task) if place in same}
                name = task if len(same) == len(trained) else f"{task}-{'-'.join(chosen)}".replace(" ", "_")
                drawn[name] = reconstructions(chosen, styles, batch, context)
    if len(drawn) == 1:
        return {"reconstructions": next(iter(drawn.values()))}
    return {f"reconstructions-{name}": figure for name, figure in drawn.items()}


def _shown(run: TrainedRun, index: Sequence[int], context: int) -> SequenceBatch:
    """Return the sequences to draw, without the padding that all of them end with."""
    require_images(run.path, run.data.observation_shape, "Name runs that observe images")
    source: SequenceSource = run.data.source
    if isinstance(source, Experience):
        source = Replay(str(RunFolder(run.path).path / "episodes"), hold_out=0)
    splits: tuple[Split, ...] = ("test", "validation", "train")
    split = next(split for split in splits if source.size(split))
    rows = source.latest(source.size(split)) if split == "train" else torch.arange(source.size(split))
    if not all(0 <= value < len(rows) for value in index):
        raise ForbesError(f"--index: {run.path} has {len(rows)} sequences to draw, expected 0 to {len(rows) - 1}")
    batch = SequenceData(source, length=run.data.length, batch_size=1).sequences(split, rows[list(index)])
    batch = batch.first(int(batch.mask.sum(1).max()))  # (B, T, ...)
    if not 0 < context < (steps := batch.mask.shape[1]):
        raise ForbesError(
            f"--context {context}: expected at least 1 and less than the length of the sequences, {steps}"
        )
    return batch


@torch.no_grad()
def reconstructions(
    models: dict[str, TrainedRun], styles: dict[str, Method], batch: SequenceBatch, context: int, seed: int = 0
) -> Figure:
    r"""Draw the truth of each sequence, and two rows for each model.

    Both are :math:`E[o_t \mid h_t, s_t]`. The first is a reconstruction, along the posterior, which has seen
    :math:`o_t`; the second a prediction, along one trajectory of the prior from the belief after `context` frames, for
    the true actions. A model without a stochastic state reconstructs nothing, and has the second row only.

    Args:
        models: runs by title, of the same sequences.
        styles: style by title.
        batch: sequences to draw.
        context: number of frames that a model sees before it predicts.
        seed: random seed for the samples.
    """
    first = next(iter(models.values()))
    truth = true_frames(first.model, first.data.source, batch)  # (B, T, C, H, W)
    times = torch.linspace(1, truth.shape[1], min(_FRAMES, truth.shape[1])).round().long().tolist()
    rows: list[tuple[str, str, Tensor]] = [("truth", BLACK, truth)]
    for title, run in models.items():
        with forked("cpu", seed):
            if isinstance(run.model, StateSpaceModel):
                rows.append((title, styles[title].colour, _reconstructed(run, batch)))
            rows.append((f"{title},\npredicted", styles[title].colour, _predicted(run, batch, context)))
    bands = [
        [Panel("", frames[[number]][:, [time - 1 for time in times]], colour, (), [name])]
        for number in range(len(truth))
        for name, colour, frames in rows
    ]
    bands[-1] = [bands[-1][0]._replace(labels=[f"t={time}" for time in times])]
    bands[0] = [bands[0][0]._replace(title=f"predictions after t = {context}")]
    return draw_bands(bands)


def _same(one: Observed, other: Observed) -> bool:
    """Return whether two observations have the same parts and values."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
    return not isinstance(one, dict) and not isinstance(other, dict) and torch.equal(one, other)


def _reconstructed(run: TrainedRun, batch: SequenceBatch) -> Tensor:
    """Return the mean frames along the posterior, `(B, T, C, H, W)`."""
    model = run.model
    assert isinstance(model, StateSpaceModel)
    filtered = model.filter(model.embed(batch.observation), batch.action)
    return run.data.source.pictures(model.likelihood.images(model.likelihood.mean(model.decode(filtered.features))))


def _predicted(run: TrainedRun, batch: SequenceBatch, context: int) -> Tensor:
    """Return the mean frames along one trajectory of the prior; before it, white: `(B, T, C, H, W)`."""
    frames = complete(run.model, run.data.source, batch, context, samples=1, mean=True).frames[0]
    white = 0.0 if frames.shape[2] == 1 else 1.0  # grey values are ink
    seen = frames.new_full((len(frames), context, *frames.shape[2:]), white)  # (B, context, C, H, W)
    return torch.cat((seen, frames), 1)
