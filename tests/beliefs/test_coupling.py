"""The flow's mathematics: it is invertible, its log-determinant is the Jacobian's, and zuko computes the same."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import linear

from forbes.beliefs.coupling import ConditionalFlow, LULinear
from forbes.errors import ForbesError

CONTEXT = 3
FLOWS = {
    "dim": st.integers(2, 7),
    "layers": st.integers(1, 5),
    "width": st.integers(1, 16),
    "seed": st.integers(0, 10**6),
}


def randomised(module, scale=0.5):
    """Move every weight of a module in float64 away from where it starts, so that nothing is zero or the identity."""
    with torch.no_grad():
        for parameter in module.double().parameters():
            parameter += scale * torch.randn_like(parameter)
    return module


def random_flow(dim=4, layers=3, width=8, seed=0, scale=0.5):
    torch.manual_seed(seed)
    return randomised(ConditionalFlow(dim, CONTEXT, layers, width), scale)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(**FLOWS)
def test_inverse_undoes_forward_and_gives_its_log_determinant(dim, layers, width, seed):
    flow = random_flow(dim, layers, width, seed)
    x, context = normal(5, dim, seed=seed), normal(5, CONTEXT, seed=1)

    y, log_det = flow(x, context)
    back, log_det_at_y = flow.inverse(y, context)

    torch.testing.assert_close(back, x, rtol=1e-6, atol=1e-6)  # the LU layers' condition numbers multiply
    torch.testing.assert_close(log_det_at_y, log_det, rtol=1e-6, atol=1e-6)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(**FLOWS)
def test_log_determinant_is_that_of_the_jacobian_of_autograd(dim, layers, width, seed):
    flow = random_flow(dim, layers, width, seed)
    x, context = normal(dim, seed=seed), normal(CONTEXT, seed=1)

    _, log_det = flow(x, context)
    jacobian = torch.autograd.functional.jacobian(lambda point: flow(point, context)[0], x)

    torch.testing.assert_close(log_det, torch.linalg.slogdet(jacobian).logabsdet)


def test_starts_as_the_identity():
    flow = ConditionalFlow(5, CONTEXT, layers=4, width=8)
    x, context = normal(6, 5).float(), normal(6, CONTEXT).float()

    y, log_det = flow(x, context)

    torch.testing.assert_close(y, x)
    torch.testing.assert_close(log_det, torch.zeros(6), rtol=0, atol=1e-6)


def test_every_output_depends_on_the_context_and_on_every_input():
    flow = random_flow(dim=5, layers=3)
    x, context = normal(5), normal(CONTEXT, seed=1)

    by_x, by_context = torch.autograd.functional.jacobian(lambda *at: flow(*at)[0], (x, context))

    assert (by_x != 0).all()
    assert (by_context != 0).all()


def test_one_context_serves_many_points():
    flow = random_flow()
    x, context = normal(7, 5, 4), normal(5, CONTEXT, seed=1)

    y, log_det = flow(x, context)

    assert log_det.shape == (7, 5)
    for row in range(5):
        torch.testing.assert_close(y[:, row], flow(x[:, row], context[row].expand(7, -1))[0])


def test_a_coupling_scales_one_part_by_at_most_e_squared():
    flow = random_flow(dim=5, layers=1, scale=100.0)
    x, context = normal(1000, 5), normal(1000, CONTEXT, seed=1)
    step = torch.tensor([0.0, 0, 1, 1, 1], dtype=torch.float64)  # along the part that is transformed

    y, _ = flow(x, context)
    log_slope = (flow(x + step, context)[0] - y)[:, 2:].log().abs()

    torch.testing.assert_close(y[:, :2], x[:, :2], rtol=0, atol=0)
    assert log_slope.max() < 2 + 1e-4  # y is a few 1e9, so float64 gives its differences to 1e-6
    assert log_slope.max() > 1.9, "the weights were too small to reach the bound"


def test_lu_linear_gives_the_determinant_and_the_inverse():
    torch.manual_seed(0)
    mixing = randomised(LULinear(6))

    torch.testing.assert_close(mixing.log_det(), torch.linalg.slogdet(mixing.matrix()).logabsdet)
    torch.testing.assert_close(mixing.inverse_matrix(), torch.linalg.inv(mixing.matrix()))


@pytest.mark.parametrize(("dim", "layers", "message"), [(1, 3, "state_dim is 1"), (4, 0, "layers is 0")])
def test_refuses_what_cannot_be_split_or_stacked(dim, layers, message):
    with pytest.raises(ForbesError, match=message):
        ConditionalFlow(dim, CONTEXT, layers, width=8)


@pytest.fixture(scope="module")
def zuko():
    """The oracle; importing it switches off the validation of all torch.distributions, which is put back here."""
    import zuko

    torch.distributions.Distribution.set_default_validate_args(True)
    return zuko


def as_zuko(transforms, flow, context):
    """Build the flow at one context from zuko's transforms and the flow's own weights."""
    dim = flow.couplings[0].first.in_features + flow.couplings[0].shift.out_features
    shares = linear(context, flow.context.weight, flow.context.bias).chunk(len(flow.couplings), -1)
    parts = []
    for k, (coupling, share) in enumerate(zip(flow.couplings, shares, strict=True)):
        if k > 0:
            lower, upper = flow.mixings[k - 1].triangles()
            diagonal = upper.diagonal()  # zuko has it in L and ones in U
            parts.append(transforms.LULinearTransform((lower * diagonal).tril() + (upper / diagonal[:, None]).triu(1)))
            parts.append(transforms.AdditiveTransform(flow.mixings[k - 1].bias))
        first_half = torch.arange(dim) < dim // 2

        def meta(given, coupling=coupling, share=share):
            hidden = linear(given, coupling.first.weight) + share
            hidden = hidden + coupling.outer(coupling.inner(hidden.relu()).relu())
            log_scale = 2 * torch.tanh(coupling.log_scale(hidden) / 2)
            unclipped = log_scale / (1 + log_scale.abs() / math.log(1e-3))  # zuko's soft clip takes it to log_scale
            shift = coupling.shift(hidden)
            return transforms.DependentTransform(transforms.MonotonicAffineTransform(shift, unclipped), 1)

        parts.append(transforms.CouplingTransform(meta, ~first_half if k % 2 else first_half))
    return transforms.ComposedTransform(*parts)


@pytest.mark.parametrize(("dim", "layers"), [(2, 3), (5, 4), (30, 5)])
def test_agrees_with_zuko_given_equal_weights(zuko, dim, layers):
    flow = random_flow(dim, layers, width=16, scale=0.2)
    x, context = normal(6, dim), normal(6, CONTEXT, seed=1)

    y, log_det = flow(x, context)
    oracle = as_zuko(zuko.transforms, flow, context)
    expected, expected_log_det = oracle.call_and_ladj(x)

    torch.testing.assert_close(y, expected)
    torch.testing.assert_close(log_det, expected_log_det)
    torch.testing.assert_close(flow.inverse(expected, context)[0], oracle.inv(expected))
