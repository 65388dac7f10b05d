"""Samples of learned beliefs over what they share with the exact belief: the state, or the observation without noise.

The docstring of `forbes.figures.beliefs` says why these two.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from forbes.data import SequenceBatch, SequenceData, Simulated
from forbes.errors import ForbesError
from forbes.evaluation.predictions import filter
from forbes.evaluation.runs import TrainedRun, data_name, data_sha256, load_runs, method_name, run_titles
from forbes.models import StateSpaceModel, VectorNormal
from forbes.pomdps import ExactBelief, Process
from forbes.pomdps.distributions import DiagonalGaussian
from forbes.seeding import forked, generator
from forbes.training import KnownBelief
from forbes.training.loading import load_known_belief

__all__ = ["KnownSamples", "LearnedSamples", "WorldSamples", "exact_belief", "known_beliefs", "world_models"]

_COMPARED = 20
"""Number of test sequences that must be the same for all runs."""


class KnownSamples(NamedTuple):
    """The belief of a `KnownBelief` over the state itself, named after the method that has its family."""

    name: str
    data: SequenceData
    module: KnownBelief
    label: str = "state"
    """Name of the values that the belief is over."""

    @property
    def process(self) -> Process:
        """The known process."""
        return self.module.process

    def values(self, state: Tensor) -> Tensor:
        """Return the values of states of the process, which are themselves, `(*, D)`."""
        return state

    def sample(self, batch: SequenceBatch, times: Sequence[int], count: int) -> Tensor:
        """Sample N values after each number of steps of one sequence, `(N, T, D)`, float64."""
        belief = self.module.model.belief(batch.observation.double(), batch.action.double())
        points = belief.sample(count, generator(0, "known belief", 0))  # (N, 1, T, D)
        return points[:, 0, [time - 1 for time in times]]


class WorldSamples(NamedTuple):
    """The belief of a world model, over the observation without noise, E[o_t | h_t, s_t]."""

    name: str
    data: SequenceData
    process: Process
    model: StateSpaceModel
    label: str = "observation without noise"

    def values(self, state: Tensor) -> Tensor:
        """Return the values of states of the process, E[o_t | s_t]: `(*, D)` to `(*, V)`."""
        return _sensor(self.process, state).mean

    @torch.no_grad()
    def sample(self, batch: SequenceBatch, times: Sequence[int], count: int) -> Tensor:
        """Sample N values after each number of steps of one sequence, `(N, T, V)`, float64, with the same noise."""
        found = []
        for time in times:
            with forked("cpu", 0):
                belief = filter(self.model, batch.first(time), count)
            output = self.model.decode(torch.cat((belief.hidden, belief.state), -1))  # (N, V)
            found.append(self.model.likelihood.mean(output))
        return torch.stack(found, 1).double()  # (N, T, V)


LearnedSamples: TypeAlias = KnownSamples | WorldSamples
"""A learned belief of a process, and the values that it is over."""


def exact_belief(process: Process, batch: SequenceBatch) -> ExactBelief:
    """Return p(s_t | o_1:t) of each sequence and step, `(B, T)`."""
    return process.exact_filter(batch.observation.double(), batch.action.double()).belief


def known_beliefs(runs: Sequence[str]) -> list[KnownSamples]:
    """Load runs of `KnownBelief`.

    Raises:
        ForbesError: if a run is of another kind, or of other data than the first.
    """
    learned: list[KnownSamples] = []
    for run in runs:
        module, data, _, _ = load_known_belief(run)
        module.require_data(data)
        name = method_name(type(module.model.head)) + (", ELBO" if module.objective == "elbo" else "")
        if name in [other.name for other in learned]:
            name = f"{name} ({Path(run).resolve().name})"
        learned.append(KnownSamples(name, data, module.double()))
    _require_same(runs, [one.data for one in learned])
    return learned


def world_models(runs: Sequence[str]) -> list[WorldSamples]:
    """Load world models of a known process, with its sensor's noise as their likelihood.

    Raises:
        ForbesError: if a run is of other data than the first, or its belief cannot be compared with the exact one.
    """
    trained = load_runs(runs)
    _require_same(runs, [run.data for run in trained])
    return [_comparable(run, title) for run, title in zip(trained, run_titles(trained), strict=True)]


def _comparable(run: TrainedRun, title: str) -> WorldSamples:
    source, model = run.data.source, run.model
    if not isinstance(source, Simulated):
        raise ForbesError(
            f"{run.path}: its data are {data_name(run.data)}, whose exact beliefs are unknown, expected Simulated. "
            "Name runs of configs/pomdp"
        )
    if not isinstance(model, StateSpaceModel):
        raise ForbesError(f"{run.path}: a {run.family} model has no belief over a state. Name other runs")
    state = run.data.sequences("test", torch.arange(1)).state  # (1, T, D)
    noise = _sensor(source.process, state).std
    if not isinstance(model.likelihood, VectorNormal) or not torch.allclose(
        noise, noise.new_tensor(model.likelihood.std)
    ):
        raise ForbesError(
            f"{run.path}: its likelihood is {model.likelihood.name}, expected the noise of the sensor, "
            f"{noise.mean():g} at every state, without which the beliefs cannot be compared. Name other runs"
        )
    return WorldSamples(title, run.data, source.process, model)


def _sensor(process: Process, state: Tensor) -> DiagonalGaussian:
    """Return p(o_t | s_t), which must be Gaussian."""
    emission = process.emission(state)
    if not isinstance(emission, DiagonalGaussian):
        raise ForbesError(f"{process}: its observations are finite, expected Gaussian noise. Name runs of others")
    return emission


def _require_same(runs: Sequence[str], data: Sequence[SequenceData]) -> None:
    hashes = [data_sha256(one, "test", min(_COMPARED, one.source.size("test"))) for one in data]
    for run, one, sha256 in zip(runs, data, hashes, strict=True):
        if sha256 != hashes[0]:
            raise ForbesError(
                f"{run}: its data are {data_name(one)}, those of {runs[0]} are {data_name(data[0])}, expected the same "
                "sequences. Draw runs of the same data"
            )
