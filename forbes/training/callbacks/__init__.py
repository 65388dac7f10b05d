"""Callbacks: they watch a training and draw, and none of them changes it; but one, which plays."""

from forbes.training.callbacks.belief_plot import BeliefPlot
from forbes.training.callbacks.collect import Collect
from forbes.training.callbacks.cuda_graph import CudaGraph
from forbes.training.callbacks.elbo_curve import ElboCurve
from forbes.training.callbacks.episode_video import EpisodeVideo
from forbes.training.callbacks.imagined_futures import ImaginedFutures
from forbes.training.callbacks.open_loop_panel import OpenLoopPanel
from forbes.training.callbacks.parameter_count import ParameterCount
from forbes.training.callbacks.picture import PictureCallback
from forbes.training.callbacks.prediction_grid import PredictionGrid
from forbes.training.callbacks.return_curve import ReturnCurve

__all__ = [
    "BeliefPlot",
    "Collect",
    "CudaGraph",
    "ElboCurve",
    "EpisodeVideo",
    "ImaginedFutures",
    "OpenLoopPanel",
    "ParameterCount",
    "PictureCallback",
    "PredictionGrid",
    "ReturnCurve",
]
