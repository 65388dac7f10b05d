"""Self-calibration of a trained run."""

import torch

from forbes.errors import ForbesError
from forbes.evaluation.calibration.self_calibration import SelfCalibration, self_calibration
from forbes.evaluation.runs import TrainedRun
from forbes.models import VectorModel

__all__ = ["calibrate_run"]


def calibrate_run(
    run: TrainedRun, sequences: int, time: int, samples: int, seed: int = 0, particles: int | None = None
) -> SelfCalibration:
    """Rank the states that a run's model imagines, for the actions of the first sequences of its training split.

    Args:
        run: run of a model with a state.
        sequences: number of sequences, N.
        time: step whose belief is checked, counted from 1.
        samples: number of samples of each belief, L.
        seed: random seed for all samples.
        particles: see `self_calibration`.

    Raises:
        ForbesError: if the model has no state, the data have too few sequences or steps, or the training diverged.
    """
    if isinstance(run.model, VectorModel) or not run.model.initial(1).state.shape[-1]:
        raise ForbesError(f"{run.path}: a {run.family} model has no state that could be ranked. Name other runs")
    size = run.data.source.size("train")
    if time > run.data.length:
        raise ForbesError(f"--time {time}: the sequences of {run.path} have {run.data.length} steps. Choose fewer")
    if sequences > size:
        raise ForbesError(f"--sequences {sequences}: {run.path} was trained on {size} sequences. Choose fewer")
    action = run.data.sequences("train", torch.arange(sequences), time).action
    try:
        return self_calibration(run.model, action, samples, seed, particles)
    except ForbesError as error:  # e.g. the training diverged
        raise ForbesError(f"{run.path}: {error}") from error
