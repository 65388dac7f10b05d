"""The merged flow of a time loop is the plain flow: values and gradients, in float64."""

from functools import partial

import pytest
import torch

from forbes.beliefs.coupling import AffineCoupling, ConditionalFlow
from forbes.beliefs.splines import SplineCoupling
from forbes.performance.time_loop import TimeLoop

STEPS, BATCH, CONTEXT = 3, 4, 5
FLOWS = {
    "affine, 2 dimensions": (2, AffineCoupling),
    "affine, odd": (7, AffineCoupling),
    "affine, 30 dimensions": (30, AffineCoupling),
    "spline, 1 dimension": (1, partial(SplineCoupling, bins=4)),
    "spline, odd": (5, partial(SplineCoupling, bins=8)),
}


@pytest.mark.parametrize("learns", [True, False], ids=["learns", "frozen"])
@pytest.mark.parametrize("layers", [1, 4])
@pytest.mark.parametrize("kind", FLOWS)
def test_the_merged_flow_is_the_plain_flow(kind, layers, learns):
    dim, coupling = FLOWS[kind]
    torch.manual_seed(0)
    flow = ConditionalFlow(dim, CONTEXT, layers, width=8, coupling=coupling).double()
    for parameter in flow.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    x = torch.randn(STEPS, BATCH, dim, dtype=torch.float64, requires_grad=True)
    context = torch.randn(STEPS, BATCH, CONTEXT, dtype=torch.float64, requires_grad=True)
    flow.requires_grad_(learns)
    wanted = [x, context, *filter(lambda parameter: parameter.requires_grad, flow.parameters())]

    results = []
    for transform in (flow, flow.prepare(TimeLoop(STEPS, BATCH))):
        y, log_det = (torch.stack(values) for values in zip(*map(transform, x, context), strict=True))
        gradients = torch.autograd.grad(y.square().sum() + (log_det * y.detach().sum(-1)).sum(), wanted)
        results.append((y, log_det, *gradients))

    assert all(values.any() for values in results[0][:4])
    for plain, merged in zip(*results, strict=True):
        assert (plain - merged).abs().max() <= 1e-12 * max(1, plain.abs().max())
