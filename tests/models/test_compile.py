"""The training loss is one graph: nothing in it makes torch.compile fall back to Python."""

from functools import partial

import pytest
import torch

from forbes.beliefs import CategoricalBelief, FlowBelief, GaussianBelief, MixtureBelief
from forbes.models import (
    Bernoulli,
    MLPDecoder,
    MLPEncoder,
    ModelParts,
    ParticleModel,
    StateSpaceModel,
    VectorModel,
    elbo_loss,
)

SHAPE = (1, 4, 4)
MODELS = {  # the model, its belief, and D
    "gaussian": (StateSpaceModel, GaussianBelief, 2),
    "flow": (StateSpaceModel, partial(FlowBelief, layers=2, width=4), 2),
    "spline flow": (StateSpaceModel, partial(FlowBelief, layers=1, width=4, coupling="spline", bins=3), 2),
    "mixture": (StateSpaceModel, partial(MixtureBelief, components=2), 2),
    "categorical": (StateSpaceModel, partial(CategoricalBelief, classes=2), 2),
    "particles": (partial(ParticleModel, particles=3, resampling="soft"), GaussianBelief, 2),
    "vector": (partial(VectorModel, overshoot=1), GaussianBelief, 0),
}


@pytest.fixture(params=MODELS, name="model")
def model_fixture(request):
    torch.manual_seed(0)
    build, belief, state_dim = MODELS[request.param]
    encoder, decoder = MLPEncoder(SHAPE, 8, 1), MLPDecoder(6 + state_dim, SHAPE, 8, 1)
    sizes = {"action_dim": 1, "state_dim": state_dim, "hidden_dim": 6, "mlp_dim": 8, "mlp_layers": 1}
    return build(ModelParts(belief, encoder, decoder, Bernoulli(), **sizes))


@pytest.fixture(autouse=True)
def fresh_compiler():
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def inputs(steps=2):
    observation = torch.randint(2, (3, steps, *SHAPE), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    return observation, torch.zeros(3, steps, 1), torch.ones(3, steps, dtype=torch.bool)


def test_the_loss_is_one_graph_with_the_same_value_and_gradients(model):
    """`fullgraph` lets no break pass; with free nats as without."""

    def loss_of(*batch):
        terms = model.lower_bound(*batch)
        return elbo_loss(terms) + elbo_loss(terms, free_nats=3.0)

    results = []
    for function in (loss_of, torch.compile(loss_of, fullgraph=True, backend="aot_eager")):
        torch.manual_seed(0)
        loss = function(*inputs())
        results.append((loss, *torch.autograd.grad(loss, list(model.parameters()))))

    torch.testing.assert_close(results[0], results[1])
