"""Load trained runs, name them, and check that they are comparable."""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

import forbes
from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.data import Experience, SequenceBatch, SequenceData, Split
from forbes.errors import ForbesError
from forbes.models import BeliefModel, StateSpaceModel
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.naming import with_suffix, without_seed
from forbes.runs.worlds import LoadedWorld, is_world, open_world

__all__ = ["TrainedRun", "data_name", "data_sha256", "find_device", "load_runs", "method_name", "model_name"]
__all__ += ["is_agent", "open_model", "recorded_runs", "require_comparable", "run_titles", "split_batches"]

_PUBLISHED: dict[type[nn.Module], str] = {GaussianBelief: "RSSM", FlowBelief: "FORBES"}
"""Published names of the models whose name differs from their class."""


class TrainedRun(NamedTuple):
    """A run folder and its model."""

    path: str
    """Path as the user typed it."""
    model: BeliefModel
    data: SequenceData
    checkpoint: str | None
    """SHA-256 of the checkpoint that the model was loaded from; None for a model of `recorded_runs` without one."""
    config: dict[str, Any]
    """Sections `model` and `data` of config.yaml without seeds: equal for runs that differ only in the seed."""

    @property
    def family(self) -> str:
        """Name of the model, e.g. FORBES, or Mixture for a `MixtureBelief`.

        A suffix of the experiment's name is appended: RSSM wide for `rssm_wide`.
        """
        return with_suffix(model_name(self.model), self.path)

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return sum(parameter.numel() for parameter in self.model.parameters())


def method_name(kind: type[nn.Module]) -> str:
    """Return the published name of a belief family or a model, or that of its class: Mixture for a `MixtureBelief`.

    An adapter that is only called Model has the name of its module.
    """
    return _PUBLISHED.get(kind, kind.__name__.removesuffix("Belief").removesuffix("Model") or kind.__module__)


def model_name(model: BeliefModel) -> str:
    """Return the name of a model's family, e.g. FORBES."""
    return method_name(_kind(model))


def run_titles(runs: Sequence[TrainedRun]) -> list[str]:
    """Return a title for each run: its family, with the distinguishing part of its folder if the family repeats."""
    folders: dict[str, list[Path]] = {}
    for run in runs:
        folders.setdefault(run.family, []).append(Path(run.path).resolve())
    titles = []
    for run in runs:
        name, same = run.family, folders[run.family]
        suffix = Path(run.path).resolve().relative_to(os.path.commonpath(same))
        titles.append(name if len(same) == 1 else f"{name} ({suffix})")
    return titles


def find_device(name: str) -> str:
    """Return the name of a usable device.

    Args:
        name: "auto" (CUDA if available, in several processes a GPU for each), or a torch device.

    Raises:
        ForbesError: if the device cannot be used.
    """
    chosen = ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
    if name == "auto" and chosen == "cuda" and "LOCAL_RANK" in os.environ:
        chosen = f"cuda:{int(os.environ['LOCAL_RANK']) % torch.cuda.device_count()}"
    try:
        torch.zeros(1, dtype=torch.float64, device=chosen)
    # Unknown name, no CUDA, and no float64, in this order.
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ForbesError(f"--device {name}: it cannot be used ({reason}). Choose cpu, or auto") from error
    return chosen


def require_distinct(paths: Sequence[str]) -> None:
    """Raise a ForbesError for a run that is named twice: it would be compared with itself, or count as two seeds."""
    folders = [Path(path).resolve() for path in paths]
    for path, folder in zip(paths, folders, strict=True):
        if folders.count(folder) > 1:
            raise ForbesError(f"{path}: is named twice. Name each run once")


def load_runs(paths: Sequence[str], device: str = "cpu") -> list[TrainedRun]:
    """Load runs, with their models on `device`."""
    runs = []
    for path in paths:
        model, data, config, checkpoint = open_model(path)
        runs.append(TrainedRun(path, model.to(device), data, checkpoint, _sections(config)))
    return runs


def recorded_runs(paths: Sequence[str]) -> list[TrainedRun]:
    """Return runs for what their folders have recorded, which needs no weights.

    A folder without a checkpoint is drawn too: before its first one, or after it was deleted. Its model is untrained.
    """
    require_distinct(paths)
    runs = []
    for path in paths:
        folder = RunFolder.existing(path)
        if folder.config.is_file() and not folder.checkpoint.is_file() and folder.results == folder.path:
            from forbes.runs.modules import build_module  # these import Lightning
            from forbes.training.world_model import WorldModel

            module, data, config = build_module(folder, WorldModel, "forbes beliefs")
            runs.append(TrainedRun(path, module.model, data, None, _sections(config)))
        else:
            runs += load_runs([path])  # which refuses what is no run, and a named checkpoint that is missing
    return runs


def _sections(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: without_seed(config[key]) for key in ("model", "data")}


def is_agent(run: str) -> bool:
    """Return whether a run folder holds an agent, which is evaluated by its returns."""
    config = read_config(RunFolder.trained(run).config)
    if is_world(config):
        return False
    from forbes.training.acting import WorldModelAgent  # imports Lightning
    from forbes.training.loading import load_run

    module, _, name = config["model"]["class_path"].rpartition(".")
    if module == "forbes" and isinstance(kind := getattr(forbes, name, None), type):
        return issubclass(kind, WorldModelAgent)
    found, data = load_run(run)
    if isinstance(data.source, Experience):
        data.source.close()
    return isinstance(found, WorldModelAgent)


def open_model(run: Path | str) -> LoadedWorld:
    """Load the model of a run, on the CPU in evaluation mode. Only runs of other classes than ours import Lightning.

    Raises:
        ForbesError: as `load_run`.
    """
    if loaded := open_world(run):
        return loaded
    from forbes.training.loading import open_run  # imports Lightning

    module, data, config, checkpoint = open_run(run)
    return LoadedWorld(module.model, data, config, checkpoint)


def _kind(model: BeliefModel) -> type[nn.Module]:
    """Return the class that identifies a family: the belief's, or the model's if its filter is not the RSSM's."""
    if type(model) is not StateSpaceModel:
        return type(model)
    prior, posterior = model.prior, model.posterior
    return type(prior if isinstance(posterior, GaussianBelief) else posterior)  # FORBES may have a flow in one only


def split_batches(
    data: SequenceData, split: Split, sequences: int, batch_size: int
) -> Iterator[tuple[int, SequenceBatch]]:
    """Yield the first `sequences` sequences of a split in order, as batches with the index of their first sequence."""
    for first in range(0, sequences, batch_size):
        yield first, data.sequences(split, torch.arange(first, min(first + batch_size, sequences)))


def data_name(data: SequenceData) -> str:
    """Return a name for the data: the source with its arguments, and the length."""
    return f"{data.source}, {data.length} steps"


def data_sha256(data: SequenceData, split: Split, sequences: int) -> str:
    """Hash the first `sequences` sequences of a split, as the model sees them."""
    digest = hashlib.sha256()
    for _, batch in split_batches(data, split, sequences, batch_size=500):
        parts = batch.observation
        observed = [parts[name] for name in sorted(parts)] if isinstance(parts, dict) else [parts]
        for values in (*observed, batch.action, batch.mask):
            digest.update(str(tuple(values.shape[1:])).encode())
            digest.update(values.numpy().tobytes())
    return digest.hexdigest()


def require_comparable(runs: Sequence[TrainedRun], hashes: Sequence[str]) -> None:
    """Require that all runs have the same data (by hash) and likelihood, so that their scores can be compared.

    Raises:
        ForbesError: if two runs differ; names them.
    """
    first, first_hash = runs[0], hashes[0]
    for run, sha256 in zip(runs[1:], hashes[1:], strict=True):
        if sha256 != first_hash:
            raise ForbesError(
                f"{run.path}: its data are {data_name(run.data)}, those of {first.path} are {data_name(first.data)}, "
                "expected the same sequences. Compare runs of the same data"
            )
        if (name := run.model.likelihood.name) != (other := first.model.likelihood.name):
            raise ForbesError(
                f"{run.path}: its likelihood is {name}, that of {first.path} is {other}, expected the same. "
                "Compare runs of the same likelihood"
            )
