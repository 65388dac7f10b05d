"""Evaluation of trained models: likelihood bounds, proper scores and predictions, all by one convention."""

from forbes.evaluation.estimates import Estimate
from forbes.evaluation.predictions import Completions, complete, filter, imagine
from forbes.evaluation.scores import score_open_loop, score_particles, score_predictions, score_trajectories
from forbes.evaluation.scoring import evaluate

__all__ = ["Completions", "Estimate", "complete", "evaluate", "filter", "imagine", "score_open_loop"]
__all__ += ["score_particles", "score_predictions", "score_trajectories"]
