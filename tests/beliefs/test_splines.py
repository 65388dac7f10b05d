"""The splines against zuko, beyond their box, at their extremes, and what they do to a state of one dimension."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from forbes.beliefs import FlowBelief
from forbes.beliefs.splines import (
    BOUND,
    LOG_SLOPES,
    LOG_WIDTH_BOUND,
    SplineCoupling,
    knot_table,
    spline,
    spline_inverse,
)
from forbes.errors import ForbesError

CONTEXT = 3


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_belief(dim, layers=3, bins=6, seed=0, scale=0.3):
    """A spline flow in float64 with no weight where it starts."""
    torch.manual_seed(seed)
    belief = FlowBelief(dim, CONTEXT, layers, width=8, coupling="spline", bins=bins).double()
    with torch.no_grad():
        for parameter in belief.parameters():
            parameter += scale * torch.randn_like(parameter)
    return belief


@pytest.fixture(scope="module")
def zuko():
    """The oracle; importing it switches off the validation of all torch.distributions, which is put back here."""
    import zuko

    torch.distributions.Distribution.set_default_validate_args(True)
    return zuko


def as_zuko(transforms, table):
    """Build zuko's spline with the same bins; its soft clips are undone first."""
    _, _, width, height, _, next_slope = table.unbind(-2)

    def unclip(value, limit):
        return value / (1 - value.abs() / limit)

    half, whole = -math.log(1e-3) / 2, -math.log(1e-3)
    sizes = [size.log() - size.log().mean(-1, keepdim=True) for size in (width, height)]  # a softmax ignores the mean
    slopes = unclip(next_slope[..., :-1].log(), whole)
    return transforms.MonotonicRQSTransform(*(unclip(size, half) for size in sizes), slopes, bound=BOUND)


@pytest.mark.parametrize("bins", [2, 3, 8])
def test_agrees_with_zuko_given_equal_bins(zuko, bins):
    table = knot_table(0.5 * normal(50, 3 * bins + 1))  # whose sizes zuko, too, can make
    table[:, 4, 0] = table[:, 5, -1] = 1  # zuko's slope at the ends, and outside
    x = 3 * normal(200, 50, seed=1)

    y, log_slope = spline(x, table)
    oracle = as_zuko(zuko.transforms, table)
    expected, expected_log_slope = oracle.call_and_ladj(x)

    torch.testing.assert_close(y, expected)
    torch.testing.assert_close(log_slope, expected_log_slope)
    torch.testing.assert_close(spline_inverse(expected, table)[0], oracle.inv(expected))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(dim=st.integers(1, 5), layers=st.integers(1, 4), bins=st.integers(2, 9), seed=st.integers(0, 10**6))
def test_inverse_undoes_the_flow_and_both_give_the_log_det(dim, layers, bins, seed):
    flow = random_belief(dim, layers, bins, seed, scale=0.15).flow
    x, context = 2 * normal(dim, seed=seed), normal(CONTEXT, seed=1)

    y, log_det = flow(x, context)
    back, log_det_at_y = flow.inverse(y, context)
    jacobian = torch.autograd.functional.jacobian(lambda point: flow(point, context)[0], x)

    torch.testing.assert_close(back, x, rtol=1e-6, atol=1e-6)  # the condition numbers of the layers multiply
    torch.testing.assert_close(log_det_at_y, log_det, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(log_det, torch.linalg.slogdet(jacobian).logabsdet)


@pytest.mark.parametrize("direction", [spline, spline_inverse])
def test_beyond_the_box_it_is_a_line_with_the_slope_of_its_edge(direction):
    table = knot_table(3 * normal(6, 25))
    slope = torch.cat((table[:3, 4, 0], table[3:, 5, -1]))
    if direction is spline_inverse:
        slope = 1 / slope
    edge = torch.tensor([-BOUND] * 3 + [BOUND] * 3, dtype=torch.float64)
    x = edge + torch.tensor([-1e6, -2, 0, 0, 2, 1e6], dtype=torch.float64)

    y, log_slope = direction(x, table)
    by_x = torch.func.jacrev(lambda point: direction(point, table)[0])(x).diagonal()

    torch.testing.assert_close(y, edge + slope * (x - edge))
    torch.testing.assert_close(log_slope, table.new_tensor(1 if direction is spline else -1) * slope.log())
    beyond = [0, 1, 4, 5]  # rounding decides on which side of it the edge itself lies
    torch.testing.assert_close(by_x[beyond], slope[beyond])


@pytest.mark.parametrize("direction", [spline, spline_inverse])
def test_gradients_are_finite_beyond_the_box_and_at_its_edge(direction):
    raw = (3 * normal(6, 25)).requires_grad_()
    x = torch.tensor([-1e6, -7.0, -BOUND, BOUND, 7.0, 1e6], dtype=torch.float64, requires_grad=True)

    y, log_slope = direction(x, knot_table(raw))

    assert all(by.isfinite().all() for by in torch.autograd.grad((y + log_slope).sum(), (x, raw)))


@pytest.mark.parametrize("direction", [spline, spline_inverse])
def test_what_left_the_box_is_still_led_by_the_knots(direction):
    """Where the spline is the identity outside, it has no gradient there, and a state that left does not come back."""
    raw = normal(2, 25).requires_grad_()

    y, log_slope = direction(torch.tensor([-7.0, 7.0], dtype=torch.float64), knot_table(raw))

    assert all(
        (torch.autograd.grad(v.sum(), raw, retain_graph=True)[0].norm(dim=-1) > 0.1).all() for v in (y, log_slope)
    )


@pytest.mark.parametrize("scale", [1, 100])
def test_widths_differ_by_a_bounded_factor(scale):
    """A sample in a narrow bin, where the slope turns, has a log-density with a derivative in the thousands."""
    width = knot_table(scale * normal(2000, 25))[:, 2]

    assert (width.amax(-1) / width.amin(-1)).max() <= math.exp(2 * LOG_WIDTH_BOUND) * (1 + 1e-9)


@pytest.mark.parametrize("scale", [1, 100])
def test_the_slope_at_an_end_is_near_the_mean_slope_of_its_bin(scale):
    """With slope 1 at the ends, a flat outer bin has to turn within a few hundredths of its width."""
    table = knot_table(scale * normal(2000, 25))
    mean = table[:, 3] / table[:, 2]

    ends = torch.stack((table[:, 4, 0] / mean[:, 0], table[:, 5, -1] / mean[:, -1])).log()

    assert ends.abs().max() <= 1 + 1e-9


def test_gradients_inside_the_box_are_those_of_differences():
    raw, x = normal(5, 13).requires_grad_(), (2 * normal(5, seed=1)).requires_grad_()

    for direction in (spline, spline_inverse):
        assert torch.autograd.gradcheck(lambda x, raw, by=direction: by(x, knot_table(raw)), (x, raw))


def wildest(count):
    """Narrowest bins beside widest, steepest knots beside flattest."""
    return 100 * normal(count, 25)


@pytest.mark.parametrize("scale", [1, 3, 100])
def test_the_slope_is_bounded_inside_the_bins_too(scale):
    """The bound is not loose: the wildest knots come within one nat of it."""
    table, x = knot_table(scale * normal(2000, 25)), torch.linspace(-BOUND, BOUND, 501, dtype=torch.float64)

    log_slope = spline(x[:, None].expand(-1, 2000), table)[1]
    least, most = log_slope.min().item(), log_slope.max().item()

    assert LOG_SLOPES[0] < least
    assert most < LOG_SLOPES[1]
    assert scale < 100 or (least < LOG_SLOPES[0] + 1 and most > LOG_SLOPES[1] - 1)


def test_is_monotone_bounded_and_invertible_at_extreme_knots():
    """Nothing divides by zero, no root is imaginary; rounding is magnified by the inverse of the least slope only."""
    table = knot_table(wildest(2000).float())
    x = torch.linspace(-BOUND, BOUND, 2000)
    edges = table[:, 1].sort(-1).values[:, 3]  # where rounding decides on which side of a knot a number lies

    y, log_slope = spline(x, table)
    xs, log_slopes = zip(*(spline_inverse(points, table) for points in (x, y, edges)), strict=True)

    rounding = 8 * BOUND * torch.finfo(torch.float32).eps  # of some sums of numbers up to BOUND
    assert (xs[1] - x).abs().max() < rounding * math.exp(-LOG_SLOPES[0])
    assert all(values.isfinite().all() for values in (log_slope, *xs, *log_slopes))
    assert all((points.abs() <= BOUND * (1 + 1e-6)).all() for points in (y, *xs))
    ladder, steps = spline(x[:, None].expand(-1, 50), table[:50])[0].diff(dim=0), 4 * BOUND * torch.finfo().eps
    assert (ladder >= -steps).all(), "not increasing"


def test_a_last_knot_rounded_below_the_box_edge_is_harmless():
    """The sum of 32 float32 bins is 5 to a few 1e-6; a last bin this steep magnifies that a million times."""
    short, flat, steep = 1e-5, [-BOUND, -BOUND, 9.99, 0.01, 1.0, 1.0], [4.99, -4.99, 0.01, 9.99, 1.0, 1.0]
    table = torch.tensor([flat, steep], dtype=torch.float64).T  # (6, 2)
    table[1, 1] -= short

    x, log_slope = spline_inverse(torch.tensor(BOUND, dtype=torch.float64), table)

    torch.testing.assert_close(x.item(), BOUND)
    assert log_slope.item() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("dim", [1, 5])
def test_a_float32_flow_finds_its_way_back(dim):
    belief, context = random_belief(dim, layers=3, scale=0.1).float(), normal(1000, CONTEXT).float()
    x = normal(1000, dim, seed=1).float()

    y, log_det = belief.flow(x, context)
    back, log_det_at_y = belief.flow.inverse(y, context)

    assert (back - x).abs().max() < 1e-4
    assert (log_det - log_det_at_y).abs().max() < 1e-3


@pytest.mark.parametrize("dim", [1, 8])
def test_a_unit_gain_coupling_keeps_its_inverse_in_float32(dim):
    """Where heights are shares of their own, half of the box is lost here, and a density is wrong by 400 nats."""
    torch.manual_seed(0)
    flow = FlowBelief(dim, 64, layers=1, coupling="spline").flow
    for parameter in flow.parameters():
        torch.nn.init.normal_(parameter, std=parameter.shape[-1] ** -0.5)
    x, context = 2 * normal(2000, dim, seed=1).float(), normal(2000, 64, seed=2).float()

    with torch.no_grad():
        y, _ = flow(x, context)
        back, _ = flow.inverse(y, context)

    rounding = 8 * BOUND * torch.finfo(torch.float32).eps
    assert (back - x).abs().max() < rounding * math.exp(-LOG_SLOPES[0])


def test_a_density_and_a_context_broadcast_either_way():
    for dim in (1, 3):
        belief = random_belief(dim)
        states, context = normal(4, 1, dim), normal(5, CONTEXT, seed=1)

        together = belief.log_prob(states, context)

        assert together.shape == (4, 5)
        torch.testing.assert_close(together[2], belief.log_prob(states[2, 0], context))
        torch.testing.assert_close(together[:, 3], belief.log_prob(states[:, 0], context[3]))


def test_splits_a_one_dimensional_belief_into_two_narrow_modes():
    """Fitted to N(±1, 0.1²) it comes within 0.05 nats; the best Gaussian has 1.6. A layer's slope is bounded."""
    torch.manual_seed(0)
    belief, context = FlowBelief(1, 1, layers=3, width=16, coupling="spline"), torch.ones(1)
    optimizer = torch.optim.Adam(belief.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1, 0, total_iters=400)
    for _ in range(400):
        sign = torch.randint(2, (256, 1)).mul(2).sub(1)
        loss = -belief.log_prob(sign + 0.1 * torch.randn(256, 1), context).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()

    grid = torch.linspace(-2, 2, 4001)
    modes = torch.distributions.Normal(torch.tensor([-1.0, 1.0]), 0.1)
    target = modes.log_prob(grid[:, None]).exp().mean(-1)  # (4001,)
    with torch.no_grad():
        log_ratio = target.log().clamp(min=-100) - belief.log_prob(grid[:, None], context)
    forward_kl = (target * log_ratio).sum() * (grid[1] - grid[0])

    assert forward_kl < 0.05


def test_refuses_a_spline_of_one_bin():
    with pytest.raises(ForbesError, match="bins is 1"):
        SplineCoupling(4, 8, False, bins=1)
