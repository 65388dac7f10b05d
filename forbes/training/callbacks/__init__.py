"""Callbacks: they watch a training and draw, and none of them changes it; but one, which plays."""

from forbes.training.callbacks.belief_plot import BeliefPlot
from forbes.training.callbacks.collect import Collect
from forbes.training.callbacks.elbo_curve import ElboCurve
from forbes.training.callbacks.parameter_count import ParameterCount
from forbes.training.callbacks.picture import PictureCallback
from forbes.training.callbacks.prediction_grid import PredictionGrid

__all__ = ["BeliefPlot", "Collect", "ElboCurve", "ParameterCount", "PictureCallback", "PredictionGrid"]
