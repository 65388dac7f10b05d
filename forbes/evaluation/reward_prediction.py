"""Reward prediction of an agent's world model in held-out episodes."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forbes.data.episodes.episode import Episode
from forbes.errors import ForbesError
from forbes.evaluation.agent_beliefs import filter_episode
from forbes.evaluation.estimates import Estimate
from forbes.models import State
from forbes.training.acting import WorldModelAgent

__all__ = ["SAMPLES", "STEPS_AHEAD", "predict_rewards", "r2_by_steps_ahead", "r2_score"]

STEPS_AHEAD = (0, 1, 5, 15)
"""Prediction horizons k: 0 is the reward that comes with the latest observation, 15 the horizon of imagination."""
SAMPLES = 16
"""Number of belief samples, S."""


def predict_rewards(
    agent: WorldModelAgent, episode: Episode, seed: int, name: str, ahead: Sequence[int] = STEPS_AHEAD
) -> dict[int, Tensor]:
    r"""Predict every reward of an episode from the belief k steps before, for the recorded actions.

    .. math:: \hat r_{t \mid t-k} = \tfrac1S \sum_{i=1}^S \hat r(f_t^i), \qquad
              f_{t-k}^i \sim q(\cdot \mid o_{1:t-k}, a_{1:t-k-1}), \quad f_t^i \text{ by the prior and } a_{t-k:t-1}

    A model that has overfitted its training episodes is no better than the mean reward.

    Args:
        agent: agent in eval mode.
        episode: episode of T actions.
        seed: random seed for the belief samples.
        name: name of the episode, for error messages.
        ahead: values of k, at least one of them above 0.

    Returns:
        Predicted rewards of the last steps by k, float64: `(T,)` for k = 0, else `(T - k + 1,)`; `(0,)` if the episode
        is too short.

    Raises:
        ForbesError: if a predicted reward is not finite.
    """
    steps, furthest = len(episode.reward) - 1, max(ahead)
    with filter_episode(agent, episode, SAMPLES, seed) as (filtered, action):
        start = State(filtered.hidden[:, :-1].flatten(0, 1), filtered.state[:, :-1].flatten(0, 1))  # (S T, ...)
        futures = _action_windows(action[1:], furthest).repeat(SAMPLES, 1, 1)  # (S T, K, A)
        later = agent.reward(agent.model.imagine(start, futures).features)  # (S T, K)
        now = agent.reward(filtered.features)[:, 1:].double().mean(0).cpu()  # (T,)
    later = later.unflatten(0, (SAMPLES, steps)).double().mean(0).cpu()  # (T, K)
    if not (now.isfinite().all() and later.isfinite().all()):
        raise ForbesError(
            f"{name}: the world model predicts rewards that are not finite. The training diverged: train again with a "
            "smaller learning_rate"
        )
    return {k: later[: max(steps - k + 1, 0), k - 1] if k else now for k in ahead}


def _action_windows(action: Tensor, horizon: int) -> Tensor:
    """Return the K actions from each step on, zero-padded at the end: `(T, A)` to `(T, K, A)`."""
    padded = torch.cat((action, action.new_zeros(horizon - 1, action.shape[-1])))  # (T + K - 1, A)
    return padded.unfold(0, horizon, 1).transpose(1, 2)  # (T, K, A)


def r2_by_steps_ahead(
    predicted: Sequence[Mapping[int, Tensor]], rewards: Sequence[Tensor]
) -> dict[int, Estimate | None]:
    r"""Return R² of the predicted rewards for each horizon k, with the standard error of a ratio over episodes.

    .. math:: R^2_k = 1 - \frac{\sum (r_t - \hat r_{t \mid t-k})^2}{\sum (r_t - \bar r)^2}

    1 is perfect, 0 is no better than the mean reward.

    Args:
        predicted: results of `predict_rewards` for E episodes, at least 2.
        rewards: r_2 to r_{T+1} of each episode, `(T,)`, float64.

    Returns:
        R² by k; None if no episode is long enough, or all rewards are equal.
    """
    return {k: _estimate(*_squares([by_k[k] for by_k in predicted], rewards)) for k in predicted[0]}


def r2_score(predicted: Sequence[Tensor], rewards: Sequence[Tensor]) -> float | None:
    """Return R² for one horizon, as `r2_by_steps_ahead` does, without its error, so that one episode suffices."""
    residual_ss, total_ss = _squares(predicted, rewards)
    return 1 - (residual_ss.sum() / total_ss.sum()).item() if total_ss.sum() > 0 else None


def _estimate(residual_ss: Tensor, total_ss: Tensor) -> Estimate | None:
    if not total_ss.sum() > 0:
        return None
    unexplained, error = Estimate.per_step(residual_ss, total_ss)
    return Estimate(1 - unexplained, error)


def _squares(predicted: Sequence[Tensor], rewards: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return the residual and the total sum of squares of each episode, `(E,)` each."""
    observed = [reward[len(reward) - len(prediction) :] for prediction, reward in zip(predicted, rewards, strict=True)]
    mean = torch.cat(observed).mean()
    residuals = (reward - prediction for prediction, reward in zip(predicted, observed, strict=True))
    residual_ss = torch.stack([residual.square().sum() for residual in residuals])  # (E,)
    return residual_ss, torch.stack([(reward - mean).square().sum() for reward in observed])  # (E,)
