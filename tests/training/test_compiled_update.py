"""The whole update of an agent is one graph, and nothing in it waits for the device."""

from functools import partial

import pytest
import torch
from batches import batch_of
from torch._subclasses.fake_tensor import FakeTensorMode

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.models import ConvDecoder, ConvEncoder, MLPDecoder, MLPEncoder, Normal, VectorNormal
from forbes.training import ImaginationActorCritic, PlanningAgent
from forbes.training.acting import WorldModelAgent

BATCH, TIME = 3, 2


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Without a trainer there is nowhere to log to."""
    for name in ("log", "log_dict"):
        monkeypatch.setattr(WorldModelAgent, name, lambda *args, **kwargs: None)


@pytest.fixture(autouse=True)
def fresh_compiler():
    torch.compiler.reset()
    yield
    torch.compiler.reset()


VECTORS = {
    "encoder": partial(MLPEncoder, width=8, layers=1),
    "decoder": partial(MLPDecoder, width=8, layers=1),
    "likelihood": VectorNormal(),
    "observation_shape": (3,),
}
IMAGES = {
    "encoder": partial(ConvEncoder, channels=1),
    "decoder": partial(ConvDecoder, channels=1),
    "likelihood": Normal(bits=5),
    "observation_shape": (3, 28, 28),
}
ACTOR_CRITIC = partial(ImaginationActorCritic, trajectories=2, horizon=2)
FLOW = partial(FlowBelief, layers=2, width=4)
AGENTS = {
    "dreamer": partial(ACTOR_CRITIC, belief=GaussianBelief, **VECTORS),
    "forbes": partial(ACTOR_CRITIC, belief=FLOW, **VECTORS),
    "forbes, images": partial(ACTOR_CRITIC, belief=FLOW, **IMAGES),
    "discrete": partial(
        ACTOR_CRITIC, belief=GaussianBelief, discrete=True, continuation=True, actor_entropy=0.1, **VECTORS
    ),
    "planet, images": partial(PlanningAgent, belief=GaussianBelief, **IMAGES),
}


def make_agent(kind):
    torch.manual_seed(0)
    sizes = {"action_dim": 2, "state_dim": 2, "hidden_dim": 6, "mlp_dim": 8, "mlp_layers": 1, "control_dim": 8}
    return AGENTS[kind](**sizes)


def make_batch(kind):
    shape = AGENTS[kind].keywords["observation_shape"]
    generator = torch.Generator().manual_seed(0)
    observation = torch.rand(BATCH, TIME, *shape, generator=generator)
    if len(shape) == 3:
        observation = (255 * observation).to(torch.uint8)
    action = torch.rand(BATCH, TIME, 2, generator=generator)
    return batch_of(observation, action, action[..., 0])


@pytest.mark.parametrize("kind", AGENTS)
def test_update_losses_are_one_graph_with_the_same_gradients(kind):
    """A break of the graph is an error, by `fullgraph`."""
    agent, results = make_agent(kind), []
    compiled = torch.compile(lambda batch: agent.training_step(batch, 0), fullgraph=True, backend="eager")

    for loss_of in (lambda batch: agent.training_step(batch, 0), compiled):
        torch.manual_seed(1)
        loss = loss_of(make_batch(kind))
        results.append((loss, *torch.autograd.grad(loss, [p for group in agent.groups() for p in group.parameters])))

    torch.testing.assert_close(results[0], results[1])


@pytest.mark.parametrize("kind", AGENTS)
def test_an_update_never_asks_for_the_value_of_a_tensor(kind):
    """From the batch to the step of Adam it runs on tensors that have none; on a GPU nothing in it can wait for one."""
    with FakeTensorMode():
        agent = make_agent(kind)
        optimizer = agent.configure_optimizers()["optimizer"]

        agent.training_step(make_batch(kind), 0).backward()
        agent.configure_gradient_clipping(optimizer)
        optimizer.step()

        assert all(p.grad.shape == p.shape for group in agent.groups() for p in group.parameters)


@pytest.mark.parametrize(
    "ask",
    [
        lambda x: x.sum().item(),
        lambda x: bool(x.any()),
        lambda x: x.tolist(),
        lambda x: x.numpy(),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: x.masked_select(x > 0),
        lambda x: x.unique(),
    ],
)
def test_asking_for_a_value_or_dependent_shape_is_caught(ask):
    with FakeTensorMode(), pytest.raises(RuntimeError):
        ask(torch.rand(3))
