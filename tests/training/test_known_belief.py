"""What the two objectives of a known process lead to, and what is refused."""

import math

import pytest
import torch
from lightning import Trainer

from forbes.beliefs import CategoricalBelief, FlowBelief, GaussianBelief
from forbes.commands.cli import main
from forbes.data import SequenceDataModule, Simulated
from forbes.errors import ForbesError
from forbes.evaluation.belief_errors import belief_errors
from forbes.evaluation.theorem import ClosedFormProcess, belief_scores, exact_filter, factorised_optimum
from forbes.pomdps import LightDark, LinearGaussian, MirrorSensor, MountainHike, Tiger
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.training import KnownBelief

# Lightning 2.6 uses what torch 2.13 deprecates, and has its opinion on loaders without workers.
pytestmark = [
    pytest.mark.filterwarnings(f"ignore:.*{text}")
    for text in ("LeafSpec", "does not have many workers", "IterableDataset", "dataloader is not resumable")
]

STEPS, TESTED = 15, 1000


def data_of(process, length=STEPS):
    source = Simulated(process, train=5000, validation=100, test=TESTED)
    return SequenceDataModule(source, batch_size=200, length=length, updates_per_epoch=300)


@pytest.fixture(scope="module", params=["state_nll", "elbo"])
def trained(request):
    """A Gaussian belief of the random walk, after 300 updates."""
    torch.manual_seed(0)
    sizes = {"hidden_dim": 32, "mlp_dim": 32}
    module = KnownBelief(LinearGaussian(), GaussianBelief, objective=request.param, learning_rate=1e-2, **sizes)
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = Trainer(accelerator="cpu", max_epochs=1, enable_model_summary=False, limit_val_batches=0, **quiet)
    trainer.fit(module, data_of(LinearGaussian()))
    return module.double().eval()


@pytest.fixture(scope="module")
def measured(trained):
    """Its objective, errors, and log p - ELBO of each sequence of the test split."""
    drawn = data_of(LinearGaussian()).source.trajectories("test", STEPS)
    exact = trained.process.exact_filter(drawn.observation, drawn.action)
    torch.manual_seed(0)
    with torch.no_grad():
        belief = trained.model.belief(drawn.observation, drawn.action)
        errors = belief_errors(exact.belief, belief, drawn.state, None, 50, torch.Generator().manual_seed(0))
        bound = trained.model.elbo(drawn.observation, drawn.action, torch.ones(TESTED, STEPS)).elbo
    return trained.objective, errors, exact.log_likelihood - bound


def test_state_nll_finds_the_kalman_filter_but_elbo_does_not(measured):
    objective, errors, gap = measured
    optimum = belief_scores(ClosedFormProcess(steps=STEPS), factorised_optimum(ClosedFormProcess(steps=STEPS)))
    filter_gap = belief_scores(ClosedFormProcess(steps=STEPS), exact_filter(ClosedFormProcess(steps=STEPS))).elbo_gap
    middle = errors["variance_ratio"][:, STEPS // 2].mean().item()
    error = 4 * gap.std() / math.sqrt(TESTED)

    assert gap.mean() > optimum.elbo_gap - error  # no factorised belief of the past is above that, all are below log p
    if objective == "state_nll":
        assert errors["forward_kl"].mean() < 0.01  # 0.002 was reached
        assert middle == pytest.approx(1, abs=0.05)
    else:
        assert gap.mean() < filter_gap - error  # better than the exact filter by its ELBO, and worse as a belief
        assert errors["forward_kl"].mean() > 0.08  # the optimum has 1.35 / 15
        assert optimum.variance_ratio == pytest.approx(0.539, abs=5e-4)
        assert middle == pytest.approx(0.539, abs=0.05)


def test_the_noise_of_an_update_depends_on_seed_and_update_only():
    data = data_of(MirrorSensor(cells=401), length=4)
    batch = data.sequences("train", torch.arange(3))
    torch.manual_seed(0)
    module = KnownBelief(MirrorSensor(cells=401), GaussianBelief, objective="elbo")
    losses = []
    for seed, disturbance in ((0, 1), (0, 2), (1, 1)):
        module.seed = seed
        torch.manual_seed(disturbance)
        module.on_train_batch_start(batch, 0)
        losses.append(module.loss(batch).item())

    assert losses[0] == losses[1] != losses[2]


def test_a_probability_is_no_belief_of_a_real_state():
    with pytest.raises(ForbesError, match="a CategoricalBelief has no density"):
        KnownBelief(LinearGaussian(), CategoricalBelief.configured(classes=1))


@pytest.mark.parametrize(
    ("process", "options", "sentence"),
    [
        (Tiger(), {}, r"the states of Tiger are finite, expected a density\. Train a WorldModel on it"),
        (LightDark(2), {"objective": "elbo", "action_dim": 1}, r"the steps of LightDark are certain.*state_nll"),
        (MirrorSensor(401.0, 401), {"action_dim": 2}, r"observations of shape \(1,\) and 2 actions.*its MirrorSensor"),
        (MountainHike(), {"observation_shape": (1, 28, 28)}, r"observations of shape \(1, 28, 28\) and 0 actions"),
    ],
)
def test_a_process_that_does_not_fit_is_one_sentence(process, options, sentence):
    with pytest.raises(ForbesError, match=sentence):
        KnownBelief(process, GaussianBelief, **options)


@pytest.mark.parametrize(
    ("process", "found"),
    [
        (LinearGaussian(0.9), r"those of LinearGaussian\(transition=0\.9, .*"),
        (MirrorSensor(cells=401), "those of MirrorSensor"),
    ],
)
def test_data_of_another_process_are_refused(process, found):
    module = KnownBelief(LinearGaussian(), GaussianBelief)

    module.require_data(data_of(LinearGaussian()))
    with pytest.raises(
        ForbesError, match=rf"the data are {found}.*expected those of its LinearGaussian\(transition=1\.0, "
    ):
        module.require_data(data_of(process))


def test_light_dark_has_the_proper_score_but_no_bound():
    torch.manual_seed(0)
    module = KnownBelief(LightDark(2), lambda *dims: FlowBelief(*dims, coupling="spline"), action_dim=1)
    loss = module.loss(data_of(LightDark(2), length=4).sequences("train", torch.arange(3)))
    loss.backward()

    assert loss.isfinite()
    assert all(parameter.grad is not None for parameter in module.parameters())


CONFIG = """\
model:
  class_path: KnownBelief
  init_args:
    process: {class_path: LinearGaussian}
    belief: {class_path: GaussianBelief}
    objective: elbo
    hidden_dim: 4
    mlp_dim: 4
data:
  class_path: SequenceDataModule
  init_args:
    source: {class_path: Simulated, init_args: {process: {class_path: LinearGaussian}, train: 20, test: 6}}
    batch_size: 4
    length: 3
    updates_per_epoch: 5
trainer: {accelerator: cpu, max_epochs: 2, log_every_n_steps: 1}
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("known") / "known.yaml"
    path.write_text(CONFIG)
    return str(path)


def test_a_stopped_run_resumes_exactly_and_other_loops_work(config, tmp_path, monkeypatch):
    straight, resumed = tmp_path / "straight", tmp_path / "resumed"
    assert main(["fit", "--config", config, "--run_dir", str(straight)]) == 0
    calls = []

    def interrupted(self, batch, batch_idx):
        calls.append(batch_idx)
        if len(calls) == 8:  # in the second epoch
            raise KeyboardInterrupt
        return step(self, batch, batch_idx)

    step = KnownBelief.training_step
    with monkeypatch.context() as patch:
        patch.setattr(KnownBelief, "training_step", interrupted)
        assert main(["fit", "--config", config, "--run_dir", str(resumed)]) != 0
    assert main(["fit", "--resume", str(resumed)]) == 0

    for command in ("validate", "test", "predict"):
        assert (
            main([command, "--config", f"{straight}/config.yaml", "--ckpt_path", str(RunFolder(straight).checkpoint)])
            == 0
        )
    states = [read_checkpoint(RunFolder(run).checkpoint)["state_dict"] for run in (straight, resumed)]
    torch.testing.assert_close(*states, rtol=0, atol=0)
    assert {"train/loss", "val/loss", "val/state_nll"} <= set(read_metrics(resumed).columns)


def test_a_resumed_run_learns_at_the_rate_it_is_given(config, tmp_path):
    """At one that is lost in a float it stays what it was."""
    run = tmp_path / "run"
    assert main(["fit", "--config", config, "--run_dir", str(run)]) == 0
    before = read_checkpoint(RunFolder(run).checkpoint)["state_dict"]
    flags = ["--model.learning_rate", "1e-30", "--trainer.max_epochs", "3"]
    assert main(["fit", "--resume", str(run), *flags]) == 0

    checkpoint = read_checkpoint(RunFolder(run).checkpoint)
    assert checkpoint["epoch"] == 2
    torch.testing.assert_close(checkpoint["state_dict"], before, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--model.process", "LightDark", "--data.source.process", "LightDark"], "the steps of LightDark are certain"),
        (["--model.process", "Tiger", "--data.source.process", "Tiger"], "the states of Tiger are finite"),
        (["--model.process", "MirrorSensor"], "the data are those of LinearGaussian"),
        (["--data.source", "Strokes", "--data.batch_size", "4"], "the data are observations of shape (1, 28, 28)"),
        (["--model.hidden_dim", "0"], "KnownBelief: hidden_dim is 0, expected more than 0"),
        (["--model.learning_rate", "-1"], "KnownBelief: learning_rate is -1.0, expected more than 0"),
        (["--model.belief", "FlowBelief"], "state_dim is 1, expected at least 2 to split. Use coupling: spline"),
    ],
)
def test_a_wrong_configuration_is_one_sentence(flags, sentence, config, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    assert main(["fit", "--config", config, *flags]) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("forbes: ")
    assert sentence in line
