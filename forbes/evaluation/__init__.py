"""Evaluation of trained models: likelihood bounds, proper scores and predictions, all by one convention.

The metrics are imported on first use, since they import torchmetrics.
"""

from typing import TYPE_CHECKING, Any

from forbes.evaluation.estimates import Estimate
from forbes.evaluation.predictions import Completions, complete, filter, imagine
from forbes.evaluation.scores import score_open_loop, score_particles, score_predictions, score_trajectories
from forbes.evaluation.scoring import evaluate

if TYPE_CHECKING:
    from forbes.evaluation.belief_metrics import ELBO, PLL, CalibrationError

__all__ = ["ELBO", "PLL", "CalibrationError", "Completions", "Estimate", "complete", "evaluate", "filter", "imagine"]
__all__ += ["score_open_loop", "score_particles", "score_predictions", "score_trajectories"]


def __getattr__(name: str) -> Any:
    """Import a metric."""
    if name not in ("ELBO", "PLL", "CalibrationError"):
        raise AttributeError(f"module 'forbes.evaluation' has no attribute {name!r}")
    from forbes.evaluation import belief_metrics

    return getattr(belief_metrics, name)
