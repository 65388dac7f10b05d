"""`--trainer.precision bf16-mixed`: encoder, decoder and heads in bfloat16, all that is a density in float32."""

from contextlib import nullcontext
from functools import partial

import pytest
import torch
from batches import batch_of

from forbes.beliefs import CategoricalBelief, FlowBelief, GaussianBelief, MixtureBelief
from forbes.commands.cli import main
from forbes.data import SequenceBatch
from forbes.models import Bernoulli, MLPDecoder, MLPEncoder, ParticleModel, StateSpaceModel, VectorModel
from forbes.pomdps import LinearGaussian
from forbes.runs.folder import read_metrics
from forbes.training import ImaginationActorCritic, KnownBelief, WorldModel

BATCH, TIME, SHAPE = 3, 4, (1, 6, 6)
FLOW = partial(FlowBelief, layers=2, width=4)
EPS = torch.finfo(torch.bfloat16).eps  # relative, of one rounding
SIZES = {
    "encoder": partial(MLPEncoder, width=8, layers=1),
    "decoder": partial(MLPDecoder, width=8, layers=1),
    "likelihood": Bernoulli(),
    "observation_shape": SHAPE,
    "action_dim": 2,
    "state_dim": 2,
    "hidden_dim": 6,
    "mlp_dim": 8,
    "mlp_layers": 1,
    "free_nats": 0.0,
}
MODELS = {
    "gaussian": {"belief": GaussianBelief},
    "flow": {"belief": FLOW},
    "spline flow": {"belief": partial(FLOW, coupling="spline", bins=3)},
    "mixture": {"belief": partial(MixtureBelief, components=2)},
    "categorical": {"belief": partial(CategoricalBelief, classes=2)},
    "particles": {"belief": FLOW, "model": partial(ParticleModel, particles=3, resampling="soft")},
    "vector": {"model": partial(VectorModel, overshoot=2), "state_dim": 0},
}


def mixed():
    return torch.autocast("cpu", torch.bfloat16)


def make(kind=WorldModel, **options):
    """A model with no weight where it starts: an untrained flow is the identity."""
    torch.manual_seed(0)
    module = kind(**{**SIZES, **options})
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.2 * torch.rand_like(parameter).sub(0.5)
    return module


def make_batch():
    generator = torch.Generator().manual_seed(0)
    observation = torch.randint(2, (BATCH, TIME, *SHAPE), generator=generator, dtype=torch.uint8)
    action, reward = torch.rand(BATCH, TIME, 2, generator=generator), torch.rand(BATCH, TIME, generator=generator)
    return batch_of(observation, action, reward)


def in_both(function):
    """What a function gives without and with mixed precision, for the same noise."""
    torch.manual_seed(1)
    full = function()
    torch.manual_seed(1)
    with mixed():
        return full, function()


@pytest.mark.parametrize("options", MODELS.values(), ids=MODELS)
def test_the_parts_of_the_bound_are_float32_and_almost_the_same(options):
    world, batch = make(**options), make_batch()

    full, terms = in_both(lambda: world.terms(batch))

    assert (terms.reconstruction.dtype, terms.kl.dtype) == (torch.float32, torch.float32)
    assert not torch.equal(terms.reconstruction, full.reconstruction)  # it is mixed
    torch.testing.assert_close(terms.reconstruction, full.reconstruction, rtol=4 * EPS, atol=4 * EPS)


@pytest.mark.parametrize("belief", [GaussianBelief, FLOW], ids=["gaussian", "flow"])
def test_beliefs_and_their_densities_are_those_of_float32(belief):
    """To the last bit, given what the encoder has said."""
    model: StateSpaceModel = make(belief=belief).model
    batch = make_batch()
    seen = model.encode(batch.observation, batch.action)

    def densities():
        filtered = model.filter(seen.embedding, seen.action)
        terms = model.bound(filtered, seen, batch.mask)
        rolled = model.imagine(filtered.at(-1), batch.action[:, :3])
        return [*filtered, terms.kl, terms.analytic_kl, model.prior_log_prob(filtered), *rolled]

    full, ours = in_both(densities)

    for a, b in zip(ours, full, strict=True):
        assert a is b is None or torch.equal(a, b)


def test_encoder_and_decoder_are_not():
    model = make().model
    batch = make_batch()
    features = torch.rand(BATCH, TIME, SIZES["hidden_dim"] + SIZES["state_dim"])

    with mixed():
        output = model.decode(features)
        log_likelihood = model.log_likelihood(features, batch.observation.float())

    assert output.dtype == torch.bfloat16
    assert torch.equal(log_likelihood, Bernoulli().log_prob(output.float(), batch.observation.float()))


@pytest.mark.parametrize(("belief", "trajectories"), [(GaussianBelief, 1), (FLOW, 3)], ids=["dreamer", "forbes"])
def test_updates_of_an_agent_go_the_way_of_float32(belief, trajectories, monkeypatch):
    for name in ("log", "log_dict"):  # without a trainer there is nowhere to log to
        monkeypatch.setattr(ImaginationActorCritic, name, lambda *args, **kwargs: None)

    def losses(precision):
        options = {"horizon": 3, "control_dim": 8, "trajectories": trajectories, "learning_rate": 1e-2}
        agent, found = make(ImaginationActorCritic, belief=belief, **options), []
        optimizer = agent.configure_optimizers()["optimizer"]
        for update in range(10):
            torch.manual_seed(update)
            optimizer.zero_grad()
            with precision():  # entered anew, as Lightning does: it remembers the weights it has rounded
                loss = agent.training_step(make_batch(), 0)
            loss.backward()
            optimizer.step()
            found.append(loss.detach())
        return torch.stack(found)

    full, ours = losses(nullcontext), losses(mixed)

    assert ours.dtype == torch.float32
    assert not torch.equal(ours, full)
    change = full[0] - full[-1]
    assert change > 4 * EPS * full[0]  # more than the roundings of a loss
    torch.testing.assert_close(ours, full, rtol=0, atol=4 * EPS * change.item())


@pytest.mark.parametrize("objective", ["state_nll", "elbo"])
def test_the_belief_of_a_known_process_has_float32_only(objective):
    process = LinearGaussian()
    torch.manual_seed(0)
    learner = KnownBelief(process, GaussianBelief, objective, hidden_dim=8, mlp_dim=8)
    state, observation, action = process.sample(3, 5, torch.Generator().manual_seed(0))
    mask = torch.ones(3, 5, dtype=torch.bool)
    batch = SequenceBatch(observation.float(), action.float(), torch.zeros(3, 5), mask, state.float(), ~mask)

    full, ours = in_both(lambda: learner.loss(batch))

    assert torch.equal(ours, full)


def test_trains_from_the_command_line(tiny_config, tiny_run, tmp_path):
    run = tmp_path / "mixed"
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(run), "--trainer.precision", "bf16-mixed"]) == 0

    ours, full = (read_metrics(folder)["train/elbo[bernoulli,S=1]"].dropna() for folder in (run, tiny_run))
    assert ours.tolist() != full.tolist()
    assert ours.tolist() == pytest.approx(full.tolist(), rel=4 * EPS)
