"""λ-returns against their definition, and the losses against theirs."""

import pytest
import torch

from forbes.control.actor_critic import actor_loss, critic_loss, lambda_returns

GAMMA = 0.9
CONSTANT = torch.full((4,), GAMMA, dtype=torch.float64)


def n_step_return(reward, value, discount, start, n):
    """The definition, spelled out: n rewards from `start`, then the value of the state reached."""
    counts = [discount[start : start + k].prod() for k in range(n + 1)]
    return sum(counts[k] * reward[start + k] for k in range(n)) + counts[n] * value[start + n]


def draw(*shape, seed=0):
    return torch.randn(2, *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("horizon", [2, 3, 15, 16])  # states imagined: one more than there are returns
@pytest.mark.parametrize("lambda_", [0.0, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("ends", [False, True])
def test_equals_the_weighted_sum_of_n_step_returns(horizon, lambda_, ends):
    reward, value = draw(horizon)
    discount = draw(horizon, seed=1)[0].sigmoid() if ends else torch.full((horizon,), GAMMA, dtype=torch.float64)

    returns = lambda_returns(reward, value, discount, lambda_)

    for start in range(horizon - 1):
        longest = horizon - 1 - start
        expected = lambda_ ** (longest - 1) * n_step_return(reward, value, discount, start, longest)
        for n in range(1, longest):
            expected += (1 - lambda_) * lambda_ ** (n - 1) * n_step_return(reward, value, discount, start, n)
        torch.testing.assert_close(returns[start], expected)


def test_every_trajectory_has_its_own_returns():
    (reward, value), discount = draw(4, 3, 6), draw(4, 3, 6, seed=1)[0].sigmoid()

    returns = lambda_returns(reward, value, discount, 0.95)

    assert returns.shape == (4, 3, 5)
    torch.testing.assert_close(returns[2, 1], lambda_returns(reward[2, 1], value[2, 1], discount[2, 1], 0.95))


def test_losses_discount_what_is_imagined_later():
    """A state τ - 1 steps after the first counts γ^(τ - 1), in both losses (H - 1 = 3)."""
    value, returns = draw(1, 3)
    valid = torch.ones(1, dtype=torch.bool)

    expected = -sum(GAMMA**k * returns[0, k] for k in range(3)) / 3
    torch.testing.assert_close(actor_loss(returns, CONSTANT, valid), expected)
    expected = sum(GAMMA**k * (value[0, k] - returns[0, k]) ** 2 / 2 for k in range(3)) / 3
    torch.testing.assert_close(critic_loss((value - returns) ** 2 / 2, CONSTANT, valid), expected)


def test_losses_do_not_count_what_comes_after_an_end():
    """The discount of the second state is 0: the third of the four (H - 1 = 3) has no weight, the second its own."""
    value, returns = draw(1, 3)
    discount, valid = torch.tensor([GAMMA, 0.0, GAMMA, GAMMA], requires_grad=True), torch.ones(1, dtype=torch.bool)

    loss = actor_loss(returns, discount, valid)
    torch.testing.assert_close(loss, -(returns[0, 0] + GAMMA * returns[0, 1]) / 3)
    assert not loss.requires_grad  # nor do the weights learn to be small where it goes badly
    errors = (value[0] - returns[0]) ** 2 / 2
    torch.testing.assert_close(critic_loss(errors[None], discount, valid), (errors[0] + GAMMA * errors[1]) / 3)


def test_trajectories_that_start_on_padding_do_not_count():
    returns, _ = draw(4, 3)
    valid = torch.tensor([True, False, True, False])

    for loss in (actor_loss, critic_loss):
        torch.testing.assert_close(loss(returns, CONSTANT, valid), loss(returns[::2], CONSTANT, valid[::2]))
