"""The distance from the nearest Gaussian: 0 of every Gaussian, and the true one of a belief with two modes."""

import math

import pytest
import torch
from small_agents import fit, forbes, write_config

from forbes.beliefs import BeliefHead, FlowBelief, GaussianBelief
from forbes.evaluation.agent_beliefs import non_gaussianity
from forbes.evaluation.record import read_record

CONTEXTS = torch.randn(200, 5, generator=torch.Generator().manual_seed(0))


class TwoModes(BeliefHead):
    """Half of N(-a, 1) and half of N(a, 1)."""

    def __init__(self, apart):
        super().__init__(1, 5)
        self.apart = apart

    def rsample(self, context, sample_shape=()):
        shape = (*sample_shape, *context.shape[:-1], 1)
        state = torch.randn(shape) + self.apart * (2.0 * torch.randint(2, shape) - 1)
        return state, self.log_prob(state, context)

    def log_prob(self, state, context):
        modes = [torch.distributions.Normal(mean, 1.0).log_prob(state) for mean in (-self.apart, self.apart)]
        return (torch.stack(modes).logsumexp(0) - math.log(2)).sum(-1)

    def distance(self):
        """By a sum over a grid."""
        grid = torch.linspace(-20, 20, 100_001, dtype=torch.float64)
        log_prob = self.log_prob(grid[:, None], None)
        nearest = torch.distributions.Normal(0.0, math.sqrt(1 + self.apart**2)).log_prob(grid)
        return torch.trapezoid(log_prob.exp() * (log_prob - nearest), grid).item()


@pytest.mark.parametrize("state_dim", [1, 4, 30])
def test_a_gaussian_is_none_away_from_itself(state_dim):
    torch.manual_seed(0)

    away = non_gaussianity(GaussianBelief(state_dim, 5), CONTEXTS)

    # What is left of n = 1024 draws is of second order, about D / n, of each of 200 contexts.
    assert away.shape == (200,)
    assert away.mean().item() == pytest.approx(0, abs=5 * state_dim / 1024 / math.sqrt(200))


def test_nor_is_one_whose_numbers_are_correlated():
    """Affine layers of a flow turn and stretch: another Gaussian, which no diagonal one is."""
    torch.manual_seed(0)
    flow = FlowBelief(3, 5, layers=2, width=4)
    with torch.no_grad():
        flow.flow.mixings[0].factors.copy_(torch.randn(3, 3))

    state, _ = flow.rsample(CONTEXTS[:1], (4096,))
    correlated = torch.corrcoef(state[:, 0].T).triu(1).abs().max()
    away = non_gaussianity(flow, CONTEXTS)

    assert correlated > 0.3
    assert away.mean().item() == pytest.approx(0, abs=5 * 3 / 1024 / math.sqrt(200))


@pytest.mark.parametrize("apart", [2.0, 4.0])
def test_two_modes_are_as_far_away_as_a_grid_says(apart):
    torch.manual_seed(0)
    belief = TwoModes(apart)

    away = non_gaussianity(belief, CONTEXTS).mean().item()

    assert belief.distance() > 0.05
    assert away == pytest.approx(belief.distance(), abs=5 / math.sqrt(1024 * 200) * (1 + apart))


@pytest.mark.parametrize("kind", ["forbes", "dreamer"])
def test_evaluate_says_it_of_prior_and_posterior(kind, tmp_path, capsys):
    """After a few updates neither has left the Gaussian it began as."""
    run = tmp_path / "run"
    assert fit("--config", write_config(tmp_path, kind), "--trainer.max_epochs", 1, "--run_dir", run) == 0
    assert forbes("evaluate", run, "--episodes", 2) == 0

    assert "KL from the nearest Gaussian" in capsys.readouterr().out
    for which in ("prior", "posterior"):
        entry = read_record(str(run))[f"{which}_non_gaussianity[episodes=2]"]
        assert entry["mean"] == pytest.approx(0, abs=0.01)


def test_a_categorical_state_has_no_such_distance(tmp_path, capsys):
    config = tmp_path / "categorical.yaml"
    config.write_text(
        write_config(tmp_path, "dreamer")
        .read_text()
        .replace("GaussianBelief", "CategoricalBelief, init_args: {classes: 2}")
    )
    assert fit("--config", config, "--trainer.max_epochs", 1, "--run_dir", tmp_path / "run") == 0
    assert forbes("evaluate", tmp_path / "run", "--episodes", 2) == 0

    assert "nearest Gaussian" not in capsys.readouterr().out
    assert not any("gaussianity" in name for name in read_record(str(tmp_path / "run")))
