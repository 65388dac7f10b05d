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
    ModelParts,
    ParticleModel,
    State,
    StateSpaceModel,
    VectorModel,
)

BATCH, TIME, ACTION, STATE, HIDDEN = 5, 6, 2, 4, 7
SHAPE = (1, 6, 6)
FLOW = partial(FlowBelief, layers=3, width=8)
BELIEFS = {
    "gaussian": GaussianBelief,
    "flow": FLOW,
    "spline flow": partial(FLOW, coupling="spline", bins=4),
    "mixture": partial(MixtureBelief, components=3),
    "categorical": partial(CategoricalBelief, classes=2),
}
STATE_SPACE = [*BELIEFS, "flow in the posterior", "flow in the prior"]
MODELS = dict.fromkeys(STATE_SPACE, StateSpaceModel) | {
    "particles": partial(ParticleModel, particles=3),
    "soft particles": partial(ParticleModel, particles=3, resampling="soft"),
    "vector": partial(VectorModel, overshoot=2),
}
PARTS = {
    kind: {"belief": belief} for kind, belief in BELIEFS.items()
} | {  # where they differ from those of `make_model`
    "flow in the posterior": {"belief": FLOW, "prior": GaussianBelief},
    "flow in the prior": {"belief": GaussianBelief, "prior": FLOW},
    "particles": {},
    "soft particles": {"belief": FLOW},
    "vector": {"state_dim": 0},
}


def make_model(kind, action_dim=ACTION, width=9, seed=0):
    changes = PARTS[kind]
    torch.manual_seed(seed)
    parts = ModelParts(
        belief=GaussianBelief,
        encoder=MLPEncoder(SHAPE, width, layers=1),
        decoder=MLPDecoder(HIDDEN + changes.get("state_dim", STATE), SHAPE, width, layers=1),
        likelihood=Bernoulli(),
        action_dim=action_dim,
        state_dim=STATE,
        hidden_dim=HIDDEN,
        mlp_dim=width,
        mlp_layers=2,
    )
    return MODELS[kind](parts._replace(**changes)).double()


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
