"""`forbes beliefs`, as a user calls it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import error_of

from forbes.commands.cli import main
from forbes.training.loading import load_known_belief

CONFIG = """\
model:
  class_path: KnownBelief
  init_args:
    process: {process}
    belief: {{class_path: MixtureBelief, init_args: {{components: 2}}}}
    hidden_dim: 4
    mlp_dim: 4
data:
  class_path: SequenceDataModule
  init_args:
    source: {{class_path: Simulated, init_args: {{process: {process}, train: 20, validation: 5, test: 12}}}}
    batch_size: 4
    length: 3
    updates_per_epoch: 2
    validation_sequences: 4
trainer: {{accelerator: cpu, max_epochs: 1, log_every_n_steps: 1}}
"""
HIKE = "{class_path: MountainHike, init_args: {start: multi, observation_std: 1.5}}"
LIGHT_DARK = "{class_path: LightDark, init_args: {cells_per_step: 10}}"
METRICS = ["forward_kl", "reverse_kl", "state_nll_regret", "variance_ratio", "mode_mass_error"]


def fit(folder, process, *flags):
    (folder / "known.yaml").write_text(CONFIG.format(process=process))
    run = folder / "run"
    assert main(["fit", "--config", str(folder / "known.yaml"), "--run_dir", str(run), *flags]) == 0
    return run


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return fit(tmp_path_factory.mktemp("hike"), HIKE)


@pytest.fixture
def run(trained, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(trained, tmp_path / "run")


def beliefs(*arguments):
    return main(["beliefs", *map(str, arguments), "--samples", "5"])


def record(run):
    return json.loads((run / "evaluation.json").read_text())


def test_a_record_names_the_checkpoint_that_was_measured(run, overwritten):
    assert beliefs(run, "--sequences", "12") == 0

    (read,) = overwritten.values()
    assert {entry["checkpoint"] for entry in record(run).values()} == {read}


def test_prints_and_records_errors_next_to_the_best_gaussian(run, capsys):
    assert beliefs(run, "--sequences", "12") == 0

    module, data, *_ = load_known_belief(run)
    batch = data.sequences("test", torch.arange(12))
    exact = module.process.exact_filter(batch.observation, batch.action).belief
    belief = module.double().model.belief(batch.observation.double(), batch.action.double())
    regret = (exact.log_prob(batch.state.double()) - belief.log_prob(batch.state.double())).detach()
    entry = record(run)["test/state_nll_regret[S=5]"]
    assert list(record(run)) == [f"test/{metric}[S=5]" for metric in (*METRICS, "elbo_gap")]
    assert entry["per_step"]["mean"] == pytest.approx(regret.mean().item(), rel=1e-12)
    assert entry["curve"] == pytest.approx(regret.mean(0).tolist(), rel=1e-12)
    assert entry["command"] == f"forbes beliefs {run} --sequences 12 --samples 5"
    assert {"commit", "date", "checkpoint", "data", "seconds"} <= entry.keys()
    with np.load(run / "evaluation.npz") as arrays:
        np.testing.assert_allclose(arrays["test/state_nll_regret[S=5]"], regret.sum(1).numpy(), rtol=1e-12)
    out = capsys.readouterr().out
    assert all(text in out for text in (*METRICS, "elbo_gap", "MixtureBelief, state_nll", "moment-matched Gaussian"))
    assert f"{regret.mean():.3f}" in out


def test_results_go_elsewhere_and_the_run_stays_as_it_was(run, tmp_path):
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}

    assert beliefs(run, "--sequences", "4", "--output", tmp_path / "out") == 0

    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    assert len(record(tmp_path / "out" / "run")) == len(METRICS) + 1
    assert (tmp_path / "out" / "run" / "evaluation.npz").is_file()


def test_a_run_that_cannot_be_written_to_asks_for_another_folder(run, monkeypatch, capsys):
    monkeypatch.setattr("os.access", lambda path, mode: False)

    assert "cannot be written to. Let the results go elsewhere: --output DIR" in error_of(capsys, "beliefs", run)


def test_a_seed_fixes_the_numbers_and_ten_can_be_scored_alone(run):
    curves = []
    for flags in (["--sequences", "10"], ["--sequences", "10"], ["--sequences", "10", "--seed", "1"]):
        assert beliefs(run, *flags) == 0
        curves.append(record(run)["test[:10]/forward_kl[S=5]"]["curve"])
    assert beliefs(run, "--sequences", "12") == 0

    with np.load(run / "evaluation.npz") as arrays:
        first, whole = arrays["test[:10]/reverse_kl[S=5]"], arrays["test/reverse_kl[S=5]"]
    assert curves[0] == curves[1] != curves[2]
    assert len(first) == 10
    assert len(whole) == 12


def test_certain_steps_leave_the_bound_out(tmp_path, capsys):
    run = fit(tmp_path, LIGHT_DARK)

    assert beliefs(run, "--sequences", "4") == 0

    assert list(record(run)) == [f"test[:4]/{metric}[S=5]" for metric in METRICS]


def test_what_cannot_be_measured_is_one_sentence(run, tiny_run, tmp_path, capsys):
    other = shutil.copytree(run, tmp_path / "other")
    config = other / "config.yaml"
    config.write_text(config.read_text().replace("observation_std: 1.5", "observation_std: 1.25"))
    mixed = shutil.copytree(run, tmp_path / "mixed")
    config = mixed / "config.yaml"
    config.write_text(config.read_text().replace("observation_std: 1.5", "observation_std: 1.25", 1))
    bare = shutil.copytree(run, tmp_path / "bare")
    shutil.rmtree(bare / "checkpoints")
    few = ["--sequences", "12"]

    for arguments, sentence in [
        (
            ["beliefs", tiny_run],
            f"{tiny_run}: a run of WorldModel, expected one of KnownBelief. Use instead: forbes",
        ),
        (
            ["evaluate", run],
            f"{run}: a run of KnownBelief, expected one of WorldModel. Use instead: forbes beliefs",
        ),
        (
            ["figures", "elbo", "--runs", bare],
            f"{bare}: a run of KnownBelief, expected one of WorldModel. Use instead: forbes beliefs",
        ),
        (["beliefs", run], f"--sequences 200: the test split of {run} has 12, expected 2 to 12"),
        (["beliefs", run, "--sequences", "1"], "--sequences 1: "),
        (["beliefs", run, other, *few], f"{other}: its data are Simulated("),
        (
            ["beliefs", mixed, *few],
            "those of MountainHike(start=multi, observation_std=1.5), expected those of its MountainHike(start=multi, ",
        ),
        (["beliefs", tmp_path / "absent"], "absent: no such run folder"),
    ]:
        assert sentence in error_of(capsys, *arguments)


def test_a_belief_that_is_not_finite_is_named(run, capsys):
    path = run / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(path, weights_only=True)
    checkpoint["state_dict"]["model.head.parameters_of.bias"][:] = torch.nan
    torch.save(checkpoint, path)

    sentence = error_of(capsys, "beliefs", run, "--sequences", "12")

    assert f"{run}: the state_nll_regret of sequence 0 is nan" in sentence


def test_an_infinite_reverse_kl_is_reported_as_a_share(tmp_path, capsys):
    """A Gaussian reaches beyond an exact belief of bounded support: infinite is the answer, not a diverged training."""
    allow = ["--allow-module", "bounded_process"]
    run = fit(tmp_path, "{class_path: bounded_process.Box}", *allow)
    capsys.readouterr()

    assert beliefs(run, "--sequences", "12", *allow) == 0

    entries, out = record(run), capsys.readouterr().out
    with np.load(run / "evaluation.npz") as arrays:
        infinite = np.isinf(arrays["test/reverse_kl[S=5]"]).mean()
        assert all(np.isfinite(arrays[f"test/{metric}[S=5]"]).all() for metric in ("forward_kl", "variance_ratio"))
    assert infinite > 0
    reverse, forward = (entries[f"test/{metric}[S=5]"] for metric in ("reverse_kl", "forward_kl"))
    assert (reverse["mean"], reverse["per_step"]["mean"], reverse["infinite"]) == (None, None, infinite)
    assert forward["infinite"] == 0
    assert f"inf in {infinite:.1%}" in out
    matched = next(line for line in out.splitlines() if "moment-matched" in line)
    forward_kl, reverse_kl, regret, ratio = (cell.strip() for cell in matched.split("│")[3:7])
    assert reverse_kl.startswith("inf in ")
    assert all("±" in cell for cell in (forward_kl, regret, ratio))
    assert "nan" not in out


def test_a_flow_learns_two_modes_where_the_best_gaussian_cannot(tmp_path, capsys):
    """The goal on the mirror sensor: at most 0.05 nats a step from the exact belief, by a proper score."""
    config = str(Path(__file__).parents[2] / "configs" / "pomdp" / "mirror_sensor" / "known_spline.yaml")
    short = ["--data.length", "8", "--trainer.max_epochs", "3"]
    assert main(["fit", "--config", config, *short, "--run_dir", str(tmp_path / "run")]) == 0

    assert main(["beliefs", str(tmp_path / "run"), "--samples", "2", "--sequences", "100"]) == 0

    assert record(tmp_path / "run")["test[:100]/forward_kl[S=2]"]["per_step"]["mean"] < 0.05
    matched = next(line for line in capsys.readouterr().out.splitlines() if "moment-matched" in line)
    assert float(matched.split("│")[3].split("±")[0]) > 1
