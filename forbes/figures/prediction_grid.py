"""Sampled completions of unfinished sequences next to the truth, by one model (paper, Figure 4)."""

from matplotlib.figure import Figure

from forbes.data import SequenceBatch, SequenceData
from forbes.evaluation.predictions import complete, true_frames
from forbes.evaluation.runs import model_name
from forbes.figures.grids import Panel, draw_panels, seen_panel, truth_panel
from forbes.figures.style import method_styles
from forbes.models import BeliefModel

__all__ = ["colour_of", "prediction_grid"]


def prediction_grid(model: BeliefModel, data: SequenceData, batch: SequenceBatch, context: int, samples: int) -> Figure:
    """Draw sequences of images and sampled completions, at the training length and at the end of the longest.

    Args:
        model: model on the batch's device.
        data: data of the sequences.
        batch: B sequences of at least the training length.
        context: number of frames that the model sees.
        samples: number of completions, N, from torch's global generator.
    """
    times = sorted({data.length, batch.observation.shape[1]})
    completions = complete(model, data.source, batch, context, samples)
    colour = colour_of(model)
    sampled = [
        Panel(f"sampled completions, t = {time}", completions.at(time).transpose(0, 1), colour) for time in times
    ]
    pictures = true_frames(model, data.source, batch)
    return draw_panels([truth_panel(pictures, times[::-1]), seen_panel(pictures, context), *sampled])


def colour_of(model: BeliefModel) -> str:
    """Return the colour of a model's family, which all figures share."""
    name = model_name(model)
    return method_styles([name])[name].colour
