"""Load the trained model of a run, without a Trainer."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from forbes.data import Experience, SequenceDataModule
from forbes.envs import EnvironmentProcess
from forbes.errors import ForbesError
from forbes.runs.modules import LoadedRun, open_module
from forbes.training.acting import WorldModelAgent
from forbes.training.known_belief import KnownBelief
from forbes.training.world_model import WorldModel

__all__ = ["load_known_belief", "load_run", "loaded_agent", "open_run"]


def load_run(run: Path | str) -> tuple[WorldModel, SequenceDataModule]:
    """Load a run's world model, on the CPU and in evaluation mode, and its data, without a Trainer.

    Args:
        run: run folder, for its last checkpoint, or a checkpoint in it; or `pretrained:NAME`, a trained model of the
            package (`forbes export --help` lists them).

    Raises:
        ForbesError: when the folder holds no trained run or one of another kind, or when configuration and checkpoint
            do not fit together.

    Example:
        >>> world, data = forbes.load_run("pretrained:strokes-forbes")
        >>> world.terms(data.sequences("test", torch.arange(8))).elbo.shape
        torch.Size([8])
    """
    loaded = open_run(run)
    return loaded.module, loaded.data


def open_run(run: Path | str) -> LoadedRun[WorldModel]:
    """Load a run as `load_run`, with the provenance that a record of its measurement names."""
    return open_module(run, WorldModel, "forbes beliefs")


def load_known_belief(run: Path | str) -> LoadedRun[KnownBelief]:
    """Load a run of `KnownBelief`, otherwise as `open_run`."""
    return open_module(run, KnownBelief, "forbes evaluate")


@contextmanager
def loaded_agent(
    run: str, device: str, samples: int | None = None
) -> Iterator[tuple[WorldModelAgent, EnvironmentProcess, str]]:
    """Load a run's agent on a device, with its environment, closed at the end, and the SHA-256 of its checkpoint.

    Args:
        run: run folder.
        device: device of the model.
        samples: trajectories of the belief that the agent acts on, K; None for its `acting_samples`.

    Raises:
        ForbesError: when the run is not that of an agent.
    """
    module, data, _, checkpoint = open_run(run)
    if not isinstance(module, WorldModelAgent) or not isinstance(data.source, Experience):
        kind = type(module).__name__
        raise ForbesError(f"{run}: not the run of an agent, but of a {kind}. Name an agent's, or measure it by itself")
    module.to(device)
    module.acting_samples = samples or module.acting_samples
    try:
        yield module, data.source.environment, checkpoint
    finally:
        data.source.close()
