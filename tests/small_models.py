"""Small models of every kind in float64, and sequences for them."""

from functools import partial

import torch

from forbes.beliefs import (
    CategoricalBelief,
    FlowBelief,
    GaussianBelief,
    MixtureBelief,
)
from forbes.models import (
    Bernoulli,
    MLPDecoder,
    MLPEncoder,
    ParticleModel,
    State,
    StateSpaceModel,
    VectorModel,
)

BATCH, TIME, ACTION, STATE, HIDDEN = 5, 6, 2, 4, 7
SHAPE = (1, 6, 6)
FLOW = partial(FlowBelief, layers=3, width=8)
STATE_SPACE = {
    "gaussian": partial(StateSpaceModel, GaussianBelief),
    "flow": partial(StateSpaceModel, FLOW),
    "flow in the posterior": partial(StateSpaceModel, FLOW, prior=GaussianBelief),
    "flow in the prior": partial(StateSpaceModel, GaussianBelief, prior=FLOW),
    "spline flow": partial(StateSpaceModel, partial(FLOW, coupling="spline", bins=4)),
    "mixture": partial(StateSpaceModel, partial(MixtureBelief, components=3)),
    "categorical": partial(StateSpaceModel, partial(CategoricalBelief, classes=2)),
}
MODELS = STATE_SPACE | {
    "particles": partial(ParticleModel, GaussianBelief, particles=3),
    "soft particles": partial(ParticleModel, FLOW, particles=3, resampling="soft"),
    "vector": partial(VectorModel, GaussianBelief, overshoot=2, state_dim=0),
}


class Bernoulli64(Bernoulli):
    """Pixels for a model in float64."""

    def target(self, observation):
        return observation.double()


def make_model(kind, action_dim=ACTION, width=9, seed=0):
    state_dim = MODELS[kind].keywords.get("state_dim", STATE)
    torch.manual_seed(seed)
    return MODELS[kind](
        encoder=MLPEncoder(SHAPE, width, layers=1),
        decoder=MLPDecoder(HIDDEN + state_dim, SHAPE, width, layers=1),
        likelihood=Bernoulli64(),
        action_dim=action_dim,
        state_dim=state_dim,
        hidden_dim=HIDDEN,
        mlp_dim=width,
        mlp_layers=2,
    ).double()


def random_model(kind, seed=0):
    """A model with no weight where it starts: an untrained flow is the identity and would hide mistakes."""
    model = make_model(kind, seed=seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.rand_like(parameter).sub(0.5)
        if kind == "categorical":  # what changes a probability by little changes no draw
            model.posterior.logits_of.weight *= 50
    return model


def sequences(seed=0):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randint(2, (BATCH, TIME, *SHAPE), generator=generator, dtype=torch.uint8)
    action = torch.rand(BATCH, TIME, ACTION, generator=generator, dtype=torch.float64)
    return observation, action, torch.ones(BATCH, TIME, dtype=torch.bool)


def random_state(model, batch=BATCH):
    """Something a model could carry."""
    return State(*(torch.rand_like(values) for values in model.initial(batch)))
