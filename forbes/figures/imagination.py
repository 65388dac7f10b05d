"""Figures of a model's imagination: open loop against the truth, and several futures of one belief."""

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from forbes.figures.grids import Panel, draw_bands, seen_steps
from forbes.figures.style import BLACK, GREY

__all__ = ["draw_futures", "draw_open_loop"]


def draw_open_loop(truth: Tensor, model: Tensor, mask: Tensor, context: int, columns: int) -> Figure:
    r"""Draw truth, model and error of some sequences over time, for observed and imagined frames.

    .. math:: \text{error} = \tfrac12 + \tfrac12 (\text{model} - \text{truth})

    so an error of 0 is medium grey.

    Args:
        truth: true frames in [0, 1], `(B, T, C, H, W)`.
        model: expected frames of the same shape, reconstructed up to `context` and imagined after it.
        mask: False after the end of a sequence, which stays white, bool `(B, T)`.
        context: number of frames that the model sees.
        columns: number of frames shown: all of the context, the others evenly spaced to the last.
    """
    rows = torch.stack((truth, model, 0.5 + 0.5 * (model - truth)), 1)  # (B, 3, T, C, H, W)
    white = 0.0 if truth.shape[2] == 1 else 1.0  # grey values are ink
    rows = rows.where(mask[:, None, :, None, None, None], white)
    groups = list(range(1, context + 1)), _later(context, truth.shape[1], columns - context)
    titles = "observed and reconstructed", "imagined for the true actions"
    names = ("truth", "model", "error"), ()
    bands = [
        [
            Panel(title, images[:, [time - 1 for time in times]], BLACK, _labels(times), name)
            for title, times, name in zip(titles, groups, names, strict=True)
        ]
        for images in rows
    ]
    bands[1:] = [[panel._replace(title="") for panel in band] for band in bands[1:]]
    bands[:-1] = [[panel._replace(labels=()) for panel in band] for band in bands[:-1]]
    return draw_bands(bands)


def draw_futures(truth: Tensor, futures: Tensor, context: int, columns: int, colour: str) -> Figure:
    """Draw a sequence and, below it, N futures imagined from one belief, with the same past.

    Args:
        truth: true sequence, values in [0, 1], `(T, C, H, W)`.
        futures: imagined steps context + 1 … T, `(N, T - context, C, H, W)`.
        context: number of frames that the model sees.
        columns: number of frames shown per future, evenly spaced to the last.
        colour: ink of the futures, if the frames are grey.
    """
    seen = seen_steps(context)
    later = _later(context, len(truth), columns)
    past = truth[None, [time - 1 for time in seen]]  # (1, S, C, H, W)
    true_rest = truth[None, [time - 1 for time in later]]  # (1, K, C, H, W)
    chosen = futures[:, [time - context - 1 for time in later]]  # (N, K, C, H, W)
    title = f"truth, and {len(futures)} futures imagined from one belief for the true actions"
    names = [f"future {number + 1}" for number in range(len(futures))]
    above = [Panel("seen", past, BLACK, (), ["truth"]), Panel(title, true_rest, BLACK)]
    pasts = past.expand(len(futures), -1, -1, -1, -1)  # (N, S, C, H, W)
    below = [Panel("", pasts, GREY, _labels(seen), names), Panel("", chosen, colour, _labels(later))]
    return draw_bands([above, below])


def _later(context: int, last: int, count: int) -> list[int]:
    """Return evenly spaced steps after the context, counted from 1."""
    steps: list[int] = torch.linspace(context + 1, last, count).round().int().unique().tolist()
    return steps


def _labels(times: Sequence[int]) -> list[str]:
    return [f"t={time}" for time in times]
