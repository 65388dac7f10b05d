"""How much of the reward an agent's world model foresees, in episodes it has not learned from."""

from collections.abc import Sequence

import torch
from torch import Tensor

from forbes.data.episodes.episode import Episode
from forbes.errors import ForbesError
from forbes.evaluation.agent_beliefs import filter_episode
from forbes.evaluation.estimates import Estimate
from forbes.models import State
from forbes.training.acting import WorldModelAgent

__all__ = ["SAMPLES", "STEPS_AHEAD", "explained", "predict_rewards", "r2_score"]

STEPS_AHEAD = (0, 1, 5, 15)
"""k; 0 is the reward that comes with the observation the belief has just seen, 15 the horizon of imagination."""
SAMPLES = 16
"""S, trajectories of the belief."""


def predict_rewards(
    agent: WorldModelAgent, episode: Episode, seed: int, name: str, ahead: Sequence[int] = STEPS_AHEAD
) -> list[Tensor]:
    r"""Foretell every reward of an episode from the belief of k steps before, by the actions that were taken.

    .. math:: \hat r_{t \mid t-k} = \tfrac1S \sum_{i=1}^S \hat r(f_t^i), \qquad
              f_{t-k}^i \sim q(\cdot \mid o_{1:t-k}, a_{1:t-k-1}), \quad f_t^i \text{ by the prior and } a_{t-k:t-1}

    A model that has learned its episodes by heart foretells another one's rewards no better than their mean does.

    Args:
        agent: in eval mode.
        episode: of T actions.
        seed: of the draws.
        name: of the episode, for errors.
        ahead: each k, one of them at least 1.

    Returns:
        For each k the rewards of the last steps, in units of reward, float64: `(T,)` where k is 0,
        else `(T - k + 1,)`, or `(0,)` where the episode is too short.

    Raises:
        ForbesError: where the model foretells what is not a finite number.
    """
    steps, furthest = len(episode.reward) - 1, max(ahead)
    with filter_episode(agent, episode, SAMPLES, seed) as (filtered, action):
        start = State(filtered.hidden[:, :-1].flatten(0, 1), filtered.state[:, :-1].flatten(0, 1))  # (S T, ...)
        taken = torch.cat((action[1:], action.new_zeros(furthest - 1, action.shape[-1])))  # (T + K - 1, A)
        taken = taken.unfold(0, furthest, 1).transpose(1, 2).repeat(SAMPLES, 1, 1)  # (S T, K, A)
        later = agent.reward(agent.model.imagine(start, taken).features)  # (S T, K)
        now = agent.reward(filtered.features)[:, 1:].double().mean(0).cpu()  # (T,)
    later = later.unflatten(0, (SAMPLES, steps)).double().mean(0).cpu()  # (T, K)
    if not (now.isfinite().all() and later.isfinite().all()):
        raise ForbesError(
            f"{name}: the world model foretells rewards that are not finite numbers. The training diverged: "
            "train again with a smaller learning_rate"
        )
    return [later[: max(steps - k + 1, 0), k - 1] if k else now for k in ahead]


def explained(foretold: Sequence[Sequence[Tensor]], rewards: Sequence[Tensor]) -> list[Estimate | None]:
    r"""Return the share of the rewards' variance that was foretold, for each distance k.

    .. math:: R^2_k = 1 - \frac{\sum (r_t - \hat r_{t \mid t-k})^2}{\sum (r_t - \bar r)^2}

    1 is perfect, 0 as good as always foretelling the mean; the error is that of a ratio, over episodes.

    Args:
        foretold: by `predict_rewards`, of E episodes, at least 2.
        rewards: r_2 to r_{T+1} of each, `(T,)`, float64.

    Returns:
        For each k; None where no episode is that long, or all rewards are the same.
    """
    return [_estimate(*_squares(told, rewards)) for told in zip(*foretold, strict=True)]


def r2_score(foretold: Sequence[Tensor], rewards: Sequence[Tensor]) -> float | None:
    """Return the share of one distance as `explained` does; without an error, so that one episode will do."""
    missed, there = _squares(foretold, rewards)
    return 1 - (missed.sum() / there.sum()).item() if there.sum() > 0 else None


def _estimate(missed: Tensor, there: Tensor) -> Estimate | None:
    if not there.sum() > 0:
        return None
    share, error = Estimate.per_step(missed, there)
    return Estimate(1 - share, error)


def _squares(foretold: Sequence[Tensor], rewards: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Sum the squares of what was missed and of what there was to foretell, `(E,)` each."""
    paid = [one[len(one) - len(told) :] for told, one in zip(foretold, rewards, strict=True)]
    mean = torch.cat(paid).mean()
    missed = torch.stack([(one - told).square().sum() for told, one in zip(foretold, paid, strict=True)])  # (E,)
    return missed, torch.stack([(one - mean).square().sum() for one in paid])  # (E,)
