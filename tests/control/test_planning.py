"""The planner on problems whose best actions are known."""

import pytest
import torch

from forbes.beliefs import FlowBelief, GaussianBelief
from forbes.control.planning import CrossEntropy, plan
from forbes.models import ModelParts, Rollout, State, StateSpaceModel
from forbes.models.likelihoods import VectorNormal
from forbes.models.networks import MLPDecoder, MLPEncoder


def test_maximises_a_quadratic_in_each_situation():
    goal = torch.tensor([[0.5, -0.3], [-0.9, 0.1]], dtype=torch.float64)[:, None]  # (B, 1, A), the same at each step
    search = CrossEntropy(horizon=4)
    torch.manual_seed(0)

    found = search.maximise(lambda action: -(action - goal).square().sum((-2, -1)), torch.zeros(2, 4, 2).double())

    torch.testing.assert_close(found, goal.expand(2, 4, 2), rtol=0, atol=1e-2)


def test_a_goal_out_of_reach_gives_the_nearest_actions():
    torch.manual_seed(0)

    found = CrossEntropy(horizon=3).maximise(lambda action: action.sum((-2, -1)), torch.zeros(1, 3, 2))

    assert (found <= 1).all()
    assert (found > 0.95).all()


class Walker:
    """A place on a line that moves by the action; enough of a model to plan with."""

    def imagine(self, start, action):
        place = start.state[:, None] + action.cumsum(1)  # (J B, H, 1)
        return Rollout(hidden=place[..., :0], state=place, log_prob=place[..., 0])


def near(goal):
    return lambda features: -(features[..., 0] - goal).square()


def test_reaches_a_goal_from_where_it_is():
    search = CrossEntropy(horizon=3)
    place = torch.tensor([[0.0], [0.6]], dtype=torch.float64).repeat(search.candidates, 1)  # (J B, 1)
    torch.manual_seed(0)

    action = plan(Walker(), near(0.4), State(place[:, :0], place), 1, search)

    torch.testing.assert_close(action, torch.tensor([[0.4], [-0.2]], dtype=torch.float64), rtol=0, atol=0.02)


def test_weighs_what_the_belief_holds_possible():
    """At -0.5 or 0.5, equally likely: whoever trusts one sample runs, whoever asks the belief stays."""
    search = CrossEntropy(horizon=1)
    place = torch.tensor([-0.5, 0.5], dtype=torch.float64).repeat(search.candidates // 2)[:, None]  # (J, 1)
    torch.manual_seed(0)

    action = plan(Walker(), lambda features: 10 * near(0.0)(features), State(place[:, :0], place), 1, search)

    assert action.abs() < 0.1


@pytest.mark.parametrize("belief", [GaussianBelief, FlowBelief])
def test_plans_on_the_beliefs_of_any_family(belief):
    torch.manual_seed(0)
    networks = {"encoder": MLPEncoder((3,), 8, 1), "decoder": MLPDecoder(16 + 4, (3,), 8, 1)}
    sizes = {"action_dim": 2, "state_dim": 4, "hidden_dim": 16, "mlp_dim": 8, "mlp_layers": 1}
    model = StateSpaceModel(ModelParts(belief, likelihood=VectorNormal(), **networks, **sizes))
    search = CrossEntropy(horizon=5, iterations=2, candidates=20, best=5)

    beliefs = model.sample_beliefs(model.encode(torch.randn(3, 6, 3), torch.randn(3, 6, 2)), 20)
    action = plan(model, lambda features: features.sum(-1), beliefs, 2, search)

    assert action.shape == (3, 2)
    assert (action.abs() <= 1).all()
    assert not action.requires_grad
