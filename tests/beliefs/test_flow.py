"""The flow belief against the Gaussian it starts as, and what it can do that a Gaussian cannot."""

import pytest
import torch

from forbes.beliefs import FlowBelief, GaussianBelief

CONTEXT = 6


@pytest.mark.parametrize("coupling", ["affine", "spline"])
def test_starts_as_the_gaussian_belief(coupling):
    torch.manual_seed(0)
    flow, gaussian = FlowBelief(30, CONTEXT, coupling=coupling), GaussianBelief(30, CONTEXT)
    flow.base.load_state_dict(gaussian.state_dict())
    context = torch.randn(7, CONTEXT)

    torch.manual_seed(1)
    state, log_prob = flow.rsample(context)
    torch.manual_seed(1)
    expected, expected_log_prob = gaussian.rsample(context)

    torch.testing.assert_close(state, expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(log_prob, expected_log_prob, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(flow.log_prob(state, context), gaussian.log_prob(state, context), rtol=1e-6, atol=1e-6)


def test_can_have_two_modes():
    """Fitted to N(±2, 0.3²) it leaves the middle empty; the Gaussian of that spread has 0.27 of its mass there."""
    torch.manual_seed(0)
    belief, context = FlowBelief(2, 1, layers=3, width=16), torch.ones(1)
    optimizer = torch.optim.Adam(belief.parameters(), lr=1e-2)
    for _ in range(200):
        centre = 2.0 * torch.randint(2, (128, 1)).mul(2).sub(1)
        loss = -belief.log_prob(centre + 0.3 * torch.randn(128, 2), context).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    samples = belief.rsample(context, (4000,))[0].mean(-1)

    assert (samples.abs() < 0.7).float().mean() < 0.15
    assert 0.35 < (samples > 0).float().mean() < 0.65
