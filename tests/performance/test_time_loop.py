"""A linear map of a time loop is the linear map, called at most once a step."""

import pytest
import torch
from torch.nn.functional import elu, linear

from forbes.errors import ForbesError
from forbes.performance.time_loop import TimeLoop

STEPS, BATCH, IN, OUT = 4, 3, 5, 2


def normal(*shape, seed=0, learns=True):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_(learns)


@pytest.mark.parametrize("bias_shape", [(OUT,), (STEPS, BATCH, OUT)], ids=["one bias", "one bias per step and row"])
@pytest.mark.parametrize("steps", [STEPS, 2], ids=["all steps", "some steps"])
def test_a_bound_map_is_the_linear_map_and_its_activation(bias_shape, steps):
    weight, bias, x = normal(OUT, IN), normal(*bias_shape, seed=1), normal(steps, BATCH, IN, seed=2)
    biases = bias.expand(STEPS, BATCH, OUT)
    bound = TimeLoop(STEPS, BATCH).linear(weight, bias, elu)

    y = torch.stack([bound(x_t) for x_t in x])
    expected = torch.stack([elu(linear(x_t, weight) + b_t) for x_t, b_t in zip(x, biases[:steps], strict=True)])

    torch.testing.assert_close(y, expected)
    gradients, expected_gradients = (
        torch.autograd.grad(values.square().sum(), (weight, bias, x)) for values in (y, expected)
    )
    torch.testing.assert_close(gradients, expected_gradients)


@pytest.mark.parametrize("learns", [True, False])
def test_a_step_too_many_is_one_sentence(learns):
    bound = TimeLoop(STEPS, BATCH).linear(normal(OUT, IN, learns=learns), normal(OUT, learns=learns))
    x = normal(BATCH, IN, learns=False)

    for _ in range(STEPS):
        bound(x)

    with pytest.raises(ForbesError, match=f"TimeLoop: more than {STEPS} steps"):
        bound(x)
