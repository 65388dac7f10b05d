"""λ-returns against their definition, and the losses against theirs."""

import pytest
import torch

from forbes.control.returns import actor_loss, critic_loss, lambda_returns

GAMMA = 0.9


def n_step_return(reward, value, start, n):
    """The definition, spelled out: n rewards from `start`, then the value of the state reached."""
    return sum(GAMMA**k * reward[start + k] for k in range(n)) + GAMMA**n * value[start + n]


def draw(*shape, seed=0):
    return torch.randn(2, *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("horizon", [2, 3, 15])
@pytest.mark.parametrize("lambda_", [0.0, 0.5, 0.95, 1.0])
def test_equals_the_weighted_sum_of_n_step_returns(horizon, lambda_):
    reward, value = draw(horizon)

    returns = lambda_returns(reward, value, GAMMA, lambda_)

    for start in range(horizon - 1):
        longest = horizon - 1 - start
        expected = lambda_ ** (longest - 1) * n_step_return(reward, value, start, longest)
        for n in range(1, longest):
            expected += (1 - lambda_) * lambda_ ** (n - 1) * n_step_return(reward, value, start, n)
        torch.testing.assert_close(returns[start], expected)


def test_every_trajectory_has_its_own_returns():
    reward, value = draw(4, 3, 6)

    returns = lambda_returns(reward, value, GAMMA, 0.95)

    assert returns.shape == (4, 3, 5)
    torch.testing.assert_close(returns[2, 1], lambda_returns(reward[2, 1], value[2, 1], GAMMA, 0.95))


def test_losses_discount_what_is_imagined_later():
    """A state τ - 1 steps after the first counts γ^(τ - 1), in both losses (H - 1 = 3)."""
    value, returns = draw(1, 3)
    valid = torch.ones(1, dtype=torch.bool)

    expected = -sum(GAMMA**k * returns[0, k] for k in range(3)) / 3
    torch.testing.assert_close(actor_loss(returns, GAMMA, valid), expected)
    expected = sum(GAMMA**k * (value[0, k] - returns[0, k]) ** 2 / 2 for k in range(3)) / 3
    torch.testing.assert_close(critic_loss(value, returns, GAMMA, valid), expected)


def test_trajectories_that_start_on_padding_do_not_count():
    value, returns = draw(4, 3)
    valid = torch.tensor([True, False, True, False])

    for loss in (lambda v, r, ok: actor_loss(r, GAMMA, ok), lambda v, r, ok: critic_loss(v, r, GAMMA, ok)):
        torch.testing.assert_close(loss(value, returns, valid), loss(value[::2], returns[::2], valid[::2]))


def test_the_critic_does_not_move_its_targets():
    value, returns = (x.requires_grad_() for x in draw(2, 3))
    loss = critic_loss(value, returns, GAMMA, torch.ones(2, dtype=torch.bool))

    gradient = torch.autograd.grad(loss, (value, returns), allow_unused=True)

    assert gradient[0].abs().min() > 0
    assert gradient[1] is None
