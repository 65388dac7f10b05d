"""The whole update of an agent is one graph, and nothing in it waits for the device."""

from functools import partial

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.data import SequenceBatch
from forbes.models import MLPDecoder, MLPEncoder, VectorNormal
from forbes.training import ImaginationActorCritic

BATCH, TIME = 3, 2


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Without a trainer there is nowhere to log to."""
    for name in ("log", "log_dict"):
        monkeypatch.setattr(ImaginationActorCritic, name, lambda *args, **kwargs: None)


@pytest.fixture(autouse=True)
def fresh_compiler():
    torch.compiler.reset()
    yield
    torch.compiler.reset()


@pytest.fixture(
    params=[
        {"belief": GaussianBelief},
        {"belief": partial(FlowBelief, layers=2, width=4)},
        {"belief": GaussianBelief, "discrete": True, "continuation": True, "actor_entropy": 0.1},
    ],
    ids=["dreamer", "forbes", "discrete"],
    name="agent",
)
def agent_fixture(request):
    torch.manual_seed(0)
    return ImaginationActorCritic(
        trajectories=2,
        horizon=2,
        control_dim=8,
        encoder=partial(MLPEncoder, width=8, layers=1),
        decoder=partial(MLPDecoder, width=8, layers=1),
        likelihood=VectorNormal(),
        observation_shape=(3,),
        action_dim=2,
        state_dim=2,
        hidden_dim=6,
        mlp_dim=8,
        mlp_layers=1,
        **request.param,
    )


def make_batch():
    generator = torch.Generator().manual_seed(0)
    observation, action = torch.rand(2, BATCH, TIME, 3, generator=generator)
    mask = torch.ones(BATCH, TIME, dtype=torch.bool)
    return SequenceBatch(observation, action[..., :2], observation[..., 0], mask, torch.zeros(BATCH, TIME, 0), ~mask)


class Waits(TorchDispatchMode):
    """Counts how often the program asks for the value of a tensor: on a GPU it would wait for all work so far."""

    number = 0

    def __torch_dispatch__(self, operation, types, arguments=(), options=None):
        self.number += operation is torch.ops.aten._local_scalar_dense.default
        return operation(*arguments, **(options or {}))


def test_the_losses_of_an_update_are_one_graph_with_the_same_gradients(agent):
    compiled = torch.compile(lambda batch: agent.training_step(batch, 0), fullgraph=True, backend="eager")
    results = []

    for loss_of in (lambda batch: agent.training_step(batch, 0), compiled):
        torch.manual_seed(1)
        loss = loss_of(make_batch())
        results.append((loss, *torch.autograd.grad(loss, list(agent.parameters()))))

    torch.testing.assert_close(results[0], results[1])


def test_no_operation_of_an_update_waits_for_a_value(agent):
    optimizer = agent.configure_optimizers()["optimizer"]

    with Waits() as waits:
        agent.training_step(make_batch(), 0).backward()
        agent.configure_gradient_clipping(optimizer)
        optimizer.step()

    assert waits.number == 0


def test_a_wait_is_noticed():
    with Waits() as waits:
        torch.ones(()).item()

    assert waits.number == 1
