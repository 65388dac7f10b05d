"""Evaluation of trained models: likelihood bounds, proper scores and predictions, all by one convention."""

from forbes.evaluation.belief_metrics import ELBO, PLL, CalibrationError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.predictions import Completions, complete, filter, imagine
from forbes.evaluation.scores import score_open_loop, score_particles, score_predictions, score_trajectories
from forbes.evaluation.scoring import evaluate

__all__ = ["ELBO", "PLL", "CalibrationError", "Completions", "Estimate", "complete", "evaluate", "filter", "imagine"]
__all__ += ["score_open_loop", "score_particles", "score_predictions", "score_trajectories"]
