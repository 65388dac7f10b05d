"""Evaluation: bounds and predictions of finished models, by one convention (DESIGN §8)."""

from forbes.evaluation.elbo import Bound, Estimate, evaluate_elbo, paired_difference, sample_terms
from forbes.evaluation.predictions import Completions, complete

__all__ = ["Bound", "Completions", "Estimate", "complete", "evaluate_elbo", "paired_difference", "sample_terms"]
