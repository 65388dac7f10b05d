"""The forward algorithm against the sum over all paths."""

import pytest
import torch

from forbes.errors import ForbesError
from forbes.pomdps import Tiger, TMaze

PROCESSES = [TMaze(2), TMaze(2, stochasticity=0.3), Tiger()]
IDS = ["t-maze", "t-maze-stochastic", "tiger"]


def draw(process, sequences, length, seed=0):
    return process.sample(sequences, length, torch.Generator().manual_seed(seed))


def probability(process, observation, action):
    """Give p(o), 0 for what cannot be seen."""
    try:
        return process.log_likelihood(observation, action).exp().item()
    except ForbesError:
        return 0.0


@pytest.mark.parametrize("process", PROCESSES, ids=IDS)
def test_the_belief_is_a_sum_over_all_paths(process):
    length = 4
    _, observation, action = draw(process, 5, length)
    exact = process.exact_filter(observation, action)

    for time in range(1, length + 1):
        index = torch.cartesian_prod(*[torch.arange(process.state_dim)] * time).view(-1, time)  # (S^t, t)
        path = torch.eye(process.state_dim, dtype=torch.float64)[index].unsqueeze(1)  # (S^t, 1, t, S)
        joint = process.log_initial(path[:, :, 0]) + process.log_observation(observation[:, :time], path).sum(-1)
        joint = joint + process.log_transition(path[:, :, 1:], path[:, :, :-1], action[:, 1:time]).sum(-1)  # (S^t, B)
        probability = joint.exp()
        evidence = probability.sum(0)  # (B,)
        posterior = probability.T @ path[:, 0, -1] / evidence.unsqueeze(-1)  # (B, S)
        torch.testing.assert_close(exact.step_log_likelihood[:, :time].sum(1), evidence.log())
        torch.testing.assert_close(exact.belief.mean[:, time - 1], posterior)


@pytest.mark.parametrize("process", PROCESSES, ids=IDS)
def test_the_probabilities_of_all_observations_add_up_to_one(process):
    action = draw(process, 1, 3).action

    every = torch.cartesian_prod(*[torch.arange(process.observation_dim)] * 3)  # (O^3, 3)
    observation = torch.eye(process.observation_dim, dtype=torch.float64)[every]  # (O^3, 3, O)
    total = sum(probability(process, one.unsqueeze(0), action) for one in observation)

    assert total == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("process", PROCESSES, ids=IDS)
def test_tables_hold_probabilities(process):
    for table in (process.initial_table, process.transition_table, process.emission_table, process.policy_table):
        assert (table >= 0).all()
        torch.testing.assert_close(table.sum(-1), torch.ones(table.shape[:-1], dtype=torch.float64))


@pytest.mark.parametrize("process", PROCESSES, ids=IDS)
def test_what_is_not_one_hot_is_one_clear_sentence(process):
    _, observation, action = draw(process, 2, 3)
    name, half = type(process).__name__, observation.clone()
    half[1, 2] /= 2

    with pytest.raises(ForbesError, match=f"^{name}: the observation of sequence 1 at step 2 is not one-hot"):
        process.exact_filter(half, action)
    with pytest.raises(ForbesError, match=f"^{name}: the action of sequence 0 at step 1 is not one-hot"):
        process.exact_filter(observation, torch.zeros_like(action))


def test_what_cannot_have_been_seen_is_one_clear_sentence():
    process = TMaze(2)
    _, observation, action = draw(process, 2, 3)
    observation[1, 2] = 1 - observation[1, 0]  # the other sign
    observation[1, 2, 2:] = 0

    with pytest.raises(ForbesError, match=r"^TMaze: sequence 1 has probability 0 from step 2 on"):
        process.exact_filter(observation, action)
