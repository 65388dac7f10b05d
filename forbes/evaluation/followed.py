"""An episode as an agent's belief follows it: what every measure of an agent's belief begins with."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from forbes.data.episodes import Episode
from forbes.models import Filtered
from forbes.training.acting import ActingModel

__all__ = ["followed"]


@contextmanager
def followed(agent: ActingModel, episode: Episode, samples: int, seed: int) -> Iterator[tuple[Filtered, Tensor]]:
    """Filter an episode; what is drawn inside of the `with` follows from the seed too, and leaves no trace outside.

    Args:
        agent: in eval mode.
        episode: of T actions.
        samples: S, trajectories of the posterior.
        seed: of all draws.

    Yields:
        S trajectories of T + 1 steps, and the actions that were taken, `(T + 1, A)`, without gradients.
    """
    device = next(agent.parameters()).device
    observation = torch.from_numpy(episode.observation.copy()).to(device)[None]  # (1, T + 1, *O)
    action = torch.from_numpy(episode.action.copy()).to(device)  # (T + 1, A)
    with torch.no_grad(), torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        embedding = agent.model.embed(observation).expand(samples, -1, -1)  # (S, T + 1, E)
        yield agent.model.filter(embedding, action.expand(samples, -1, -1)), action
