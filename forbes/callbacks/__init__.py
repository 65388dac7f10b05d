"""Callbacks. Most only observe; `Collect` plays episodes, and `CudaGraph` changes how an update is computed."""

from forbes.callbacks.belief_plot import BeliefPlot
from forbes.callbacks.collect import Collect
from forbes.callbacks.cuda_graph import CudaGraph
from forbes.callbacks.elbo_curve import ElboCurve
from forbes.callbacks.episode_video import EpisodeVideo
from forbes.callbacks.imagined_futures import ImaginedFutures
from forbes.callbacks.open_loop_panel import OpenLoopPanel
from forbes.callbacks.parameter_count import ParameterCount
from forbes.callbacks.picture import PictureCallback
from forbes.callbacks.prediction_grid import PredictionGrid
from forbes.callbacks.return_curve import ReturnCurve

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
