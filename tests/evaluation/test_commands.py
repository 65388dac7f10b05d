"""`forbes evaluate`, as a user calls it."""

import json
import shutil

import numpy as np
import pytest
import torch

from forbes.cli import main
from forbes.evaluation.elbo import evaluate_elbo
from forbes.evaluation.runs import load_runs, split_batches
from forbes.training.run_folder import RunFolder

NAME = "test/elbo[bernoulli,S=2]"
RSSM = ["--model.init_args.belief", "GaussianBelief"]


def fit(config, run, *arguments):
    assert main(["fit", "--config", str(config), "--run_dir", str(run), *arguments]) == 0
    return run


@pytest.fixture(scope="module")
def trained(tiny_run, tiny_config, tmp_path_factory):
    """A run of FORBES and one of RSSM."""
    folder = tmp_path_factory.mktemp("evaluated")
    shutil.copytree(tiny_run, folder / "forbes")
    return folder / "forbes", fit(tiny_config, folder / "rssm_wide", *RSSM)


@pytest.fixture
def runs(trained, tmp_path):
    """Copies that a test may change."""
    return [str(shutil.copytree(run, tmp_path / run.name)) for run in trained]


def evaluate(*arguments):
    return main(["evaluate", *arguments, "--samples", "2"])


def record(run):
    return json.loads((RunFolder(run).path / "evaluation.json").read_text())


def record_is_missing(run):
    return not (RunFolder(run).path / "evaluation.json").exists()


def error_of(capsys, *arguments):
    """What a wrong call prints: one line, with exit code 2."""
    capsys.readouterr()
    assert evaluate(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("forbes: ")
    return line


def test_records_the_mean_over_the_whole_split_and_every_sequence(runs):
    assert evaluate(*runs, "--batch-size", "5") == 0

    for run in load_runs(runs):
        bound = evaluate_elbo(run.model, split_batches(run.data, "test", 12, 5), samples=2)
        metrics = record(run.path)["test"]["metrics"]
        assert metrics[NAME]["mean"] == pytest.approx(bound.elbo.mean().item(), rel=1e-12)
        assert metrics[NAME]["standard_error"] == pytest.approx(bound.elbo.numpy().std(ddof=1) / 12**0.5)
        with np.load(RunFolder(run.path).path / "evaluation.npz") as arrays:
            assert arrays["test/elbo"].dtype == np.float64
            np.testing.assert_array_equal(arrays["test/elbo"], bound.elbo.numpy())
            per_step = arrays["test/elbo"].sum() / arrays["test/steps"].sum()
        assert metrics["test/elbo_per_step[bernoulli,S=2]"]["mean"] == pytest.approx(per_step)


def test_records_where_the_numbers_come_from(runs):
    evaluate(*runs, "--seed", "3")
    entry = record(runs[0])["test"]
    assert entry["command"] == f"forbes evaluate {runs[0]} {runs[1]} --seed 3 --samples 2"
    assert {"commit", "date", "seconds", "device"} <= entry.keys()
    assert (entry["sequences"], entry["samples"], entry["seed"]) == (12, 2, 3)
    assert entry["data"]["name"].startswith("Strokes(origin=bundled")
    assert entry["data"]["sha256"] == record(runs[1])["test"]["data"]["sha256"]


def test_both_runs_record_the_same_paired_difference(runs, capsys):
    evaluate(*runs)

    (mine,), (theirs,) = (record(run)["test"]["paired"] for run in runs)
    first, second = (np.load(RunFolder(run).path / "evaluation.npz")["test/elbo"] for run in runs)
    assert mine["minus"] == runs[1]
    assert mine["elbo"] == pytest.approx((first - second).mean()) == -theirs["elbo"]
    assert mine["standard_error"] == pytest.approx((first - second).std(ddof=1) / 12**0.5)
    assert f"{mine['elbo']:+.2f} ± {mine['standard_error']:.2f}" in capsys.readouterr().out


def test_more_than_four_runs_are_compared_with_the_first_only(runs, tmp_path):
    copies = [str(shutil.copytree(runs[0], tmp_path / f"copy{number}")) for number in range(4)]
    evaluate(runs[1], *copies)
    assert len(record(runs[1])["test"]["paired"]) == 4
    assert [pair["minus"] for pair in record(copies[2])["test"]["paired"]] == [runs[1]]


def test_the_same_command_gives_the_same_numbers(runs):
    evaluate(runs[0])
    first = record(runs[0])["test"]["metrics"]
    evaluate(runs[0])
    assert record(runs[0])["test"]["metrics"] == first


def test_each_split_and_subset_keeps_its_own_entry(runs):
    evaluate(runs[0])
    evaluate(runs[0], "--split", "validation")
    evaluate(runs[0], "--digits", "5")

    assert record(runs[0]).keys() == {"test", "validation", "test[:5]"}
    assert "validation/elbo[bernoulli,S=2]" in record(runs[0])["validation"]["metrics"]
    assert "test[:5]/elbo[bernoulli,S=2]" in record(runs[0])["test[:5]"]["metrics"]
    with np.load(RunFolder(runs[0]).path / "evaluation.npz") as arrays:
        np.testing.assert_allclose(arrays["test[:5]/steps"], arrays["test/steps"][:5])


def test_the_table_names_families_and_the_metric_with_its_likelihood(runs, capsys):
    evaluate(*runs)
    out = capsys.readouterr().out
    assert NAME in out
    assert "FORBES" in out
    assert "RSSM wide" in out  # from the experiment's name


def test_its_help_shows_an_example(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--help"])
    assert stop.value.code == 0
    assert "forbes evaluate runs/compare/forbes runs/compare/rssm" in capsys.readouterr().out


def test_runs_of_different_data_are_not_compared(runs, tiny_config, tmp_path, capsys):
    other = fit(tiny_config, tmp_path / "other", "--data.init_args.source.init_args.points_per_step", "2")
    assert "points_per_step=2" in error_of(capsys, runs[0], str(other))
    assert record_is_missing(runs[0])


def test_runs_of_different_likelihoods_are_not_compared(runs, tiny_config, tmp_path, capsys):
    other = fit(tiny_config, tmp_path / "other", "--model.init_args.likelihood", "Normal")
    assert "its likelihood is normal(1)" in error_of(capsys, runs[0], str(other))


def test_a_broken_model_fails_and_names_run_and_sequence(runs, capsys):
    path = RunFolder(runs[0]).checkpoint
    checkpoint = torch.load(path, weights_only=True)
    checkpoint["state_dict"]["model.gru.weight_hh"].fill_(torch.nan)
    torch.save(checkpoint, path)

    assert f"{runs[0]}, test split: the ELBO of sequence 0 is nan" in error_of(capsys, runs[0])
    assert record_is_missing(runs[0])


def test_wrong_arguments_are_named(runs, tmp_path, capsys):
    assert "--samples" in error_of(capsys, runs[0], "--samples", "0")
    assert "at least 2" in error_of(capsys, runs[0], "--digits", "1")
    assert "the test split" in error_of(capsys, runs[0], "--digits", "13")
    assert "--digits" in error_of(capsys, runs[0], "--digits", "most")
    assert "--device moon" in error_of(capsys, runs[0], "--device", "moon")
    assert "no such run folder" in error_of(capsys, str(tmp_path / "nowhere"))
    (RunFolder(runs[0]).path / "evaluation.json").write_text("{")
    assert "not JSON" in error_of(capsys, runs[0])
