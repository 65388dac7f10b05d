"""Evaluation: bounds, proper scores and predictions of finished models, by one convention (DESIGN §8)."""

from forbes.evaluation.bounds import score_predictions, score_trajectories
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.open_loop import score_open_loop
from forbes.evaluation.predictions import Completions, complete, filter, imagine
from forbes.evaluation.scoring import evaluate
from forbes.evaluation.smc import score_particles

__all__ = ["Completions", "Estimate", "complete", "evaluate", "filter", "imagine", "score_open_loop"]
__all__ += ["score_particles", "score_predictions", "score_trajectories"]
