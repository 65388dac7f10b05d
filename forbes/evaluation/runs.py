"""Trained runs that are looked at together: what each is, and whether their numbers may be compared."""

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.data import SequenceBatch, SequenceDataModule, Split
from forbes.errors import ForbesError
from forbes.models import BeliefModel, StateSpaceModel
from forbes.training.loading import open_run

__all__ = ["TrainedRun", "data_name", "data_sha256", "find_device", "load_runs", "require_comparable", "run_titles"]
__all__ += ["split_batches"]

_PUBLISHED: dict[type[nn.Module], str] = {GaussianBelief: "RSSM", FlowBelief: "FORBES"}
"""Models whose name is not that of their class."""


class TrainedRun(NamedTuple):
    """A run folder with what it has learned."""

    path: str
    """As the user gave it."""
    model: BeliefModel
    data: SequenceDataModule
    checkpoint: str
    """SHA-256 of the checkpoint that the model was read from."""
    config: dict[str, Any]
    """Sections `model` and `data` of config.yaml without the seeds: runs that differ in the seed only have the same."""

    @property
    def family(self) -> str:
        """The model's name, e.g. FORBES, or Mixture of a `MixtureBelief`.

        What its experiment's name adds follows: RSSM wide for `rssm_wide`.
        """
        kind = _kind(self.model)
        name = _PUBLISHED.get(kind, kind.__name__.removesuffix("Belief").removesuffix("Model"))
        for part in reversed(Path(self.path).resolve().parts):
            if match := re.fullmatch(rf"{name}((?:_[a-z]+)+)(?:-\d+)?", part, re.IGNORECASE):
                return name + match[1].replace("_", " ")
        return name

    @property
    def parameters(self) -> int:
        """How many numbers were learned."""
        return sum(parameter.numel() for parameter in self.model.parameters())


def run_titles(runs: Sequence[TrainedRun]) -> list[str]:
    """Name runs for a picture: by family, and where several are of one, by what their folders do not share."""
    folders: dict[str, list[Path]] = {}
    for run in runs:
        folders.setdefault(run.family, []).append(Path(run.path).resolve())
    titles = []
    for run in runs:
        name, same = run.family, folders[run.family]
        own = Path(run.path).resolve().relative_to(os.path.commonpath(same))
        titles.append(name if len(same) == 1 else f"{name} ({own})")
    return titles


def find_device(name: str) -> str:
    """Choose a device, and try it.

    Args:
        name: "auto", or as torch calls it.

    Raises:
        ForbesError: where it cannot be used.
    """
    chosen = ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name
    try:
        torch.zeros(1, dtype=torch.float64, device=chosen)
    # What torch raises for a name it does not know, without CUDA, and where there is no float64.
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ForbesError(f"--device {name}: it cannot be used ({reason}). Choose cpu, or auto") from error
    return chosen


def load_runs(paths: Sequence[str], device: str = "cpu") -> list[TrainedRun]:
    """Load runs, their models on a device."""
    runs = []
    for path in paths:
        module, data, config, checkpoint = open_run(path)
        sections = {key: _without_seed(config[key]) for key in ("model", "data")}
        runs.append(TrainedRun(path, module.model.to(device), data, checkpoint, sections))
    return runs


def _kind(model: BeliefModel) -> type[nn.Module]:
    """Return what tells families apart: the belief's, or the model's where its filter is another."""
    if type(model) is not StateSpaceModel:
        return type(model)
    prior, posterior = model.prior, model.posterior
    return type(prior if isinstance(posterior, GaussianBelief) else posterior)  # FORBES may have a flow in one only


def _without_seed(section: dict[str, Any]) -> dict[str, Any]:
    arguments = {key: value for key, value in section.get("init_args", {}).items() if key != "seed"}
    return section | {"init_args": arguments}


def split_batches(
    data: SequenceDataModule, split: Split, sequences: int, batch_size: int
) -> Iterator[tuple[int, SequenceBatch]]:
    """Return the first so many sequences of a split in order, with the index of each batch's first."""
    for index in torch.arange(sequences).split(batch_size):
        yield int(index[0]), data.sequences(split, index)


def data_name(data: SequenceDataModule) -> str:
    """Name the data: the source with its arguments, and the length."""
    return f"{data.source}, {data.length} steps"


def data_sha256(data: SequenceDataModule, split: Split, sequences: int) -> str:
    """Hash the content of the first so many sequences of a split, as the model sees it."""
    digest = hashlib.sha256()
    for _, batch in split_batches(data, split, sequences, batch_size=500):
        for values in (batch.observation, batch.action, batch.mask):
            digest.update(str(tuple(values.shape[1:])).encode())
            digest.update(values.numpy().tobytes())
    return digest.hexdigest()


def require_comparable(runs: Sequence[TrainedRun], hashes: Sequence[str]) -> None:
    """Refuse runs whose data, by their hash, or whose likelihoods differ: their numbers are about different things.

    Raises:
        ForbesError: naming the first two that differ.
    """
    first, first_hash = runs[0], hashes[0]
    for run, sha256 in zip(runs[1:], hashes[1:], strict=True):
        if sha256 != first_hash:
            raise ForbesError(
                f"{run.path}: its data are {data_name(run.data)}, those of {first.path} are {data_name(first.data)}, "
                "expected the same sequences. Compare runs of the same data"
            )
        if (name := run.model.likelihood.name) != (other := first.model.likelihood.name):
            raise ForbesError(
                f"{run.path}: its likelihood is {name}, that of {first.path} is {other}, expected the same. "
                "Compare runs of the same likelihood"
            )
