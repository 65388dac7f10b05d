"""`forbes evaluate`, as a user calls it."""

import json
import shutil
from argparse import Namespace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import error_of
from rich.console import Console
from small_models import make_model

from forbes.commands import tables
from forbes.commands.cli import main
from forbes.commands.evaluate import evaluate as measure
from forbes.data.strokes.file import StrokeArrays, load_strokes, save_strokes
from forbes.errors import ForbesError
from forbes.evaluation import scoring
from forbes.evaluation.metrics import EvaluatedRun, compare_pairs
from forbes.evaluation.record import results_folders
from forbes.evaluation.references import references
from forbes.evaluation.runs import load_runs, split_batches
from forbes.evaluation.scoring import PartialScores, make_scorer, score_split
from forbes.evaluation.scoring import evaluate as evaluate_model
from forbes.runs.folder import RunFolder
from forbes.training.loading import load_run

NAME = "test/elbo[bernoulli,S=2]"


def fit(config, run, *arguments):
    assert main(["fit", "--config", str(config), "--run_dir", str(run), *arguments]) == 0
    return run


@pytest.fixture
def runs(tiny_run, tiny_rssm, tmp_path):
    """A run of FORBES and one of RSSM, which a test may change."""
    named = {"forbes": tiny_run, "rssm_wide": tiny_rssm}
    return [str(shutil.copytree(run, tmp_path / name)) for name, run in named.items()]


@pytest.fixture(scope="module")
def other_filters(tiny_vector, tiny_particle, tmp_path_factory):
    """A run of each model whose filter is another; not to be changed but by evaluations."""
    folder = tmp_path_factory.mktemp("filters")
    return [str(shutil.copytree(run, folder / run.name)) for run in (tiny_vector, tiny_particle)]


def test_python_gives_the_numbers_that_the_command_records(runs):
    options = {"sequences": 6, "samples": 2, "particles": 3, "futures": 4, "context": 2, "batch_size": 4, "seed": 5}
    flags = [part for name, value in options.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    assert main(["evaluate", runs[0], *flags]) == 0
    recorded = json.loads((Path(runs[0]) / "evaluation.json").read_text())

    world, data = load_run(runs[0])
    found = evaluate_model(world.model, data, ("elbo", "pll", "fivo", "open-loop"), **options)

    means = {name.partition("/")[2].partition("[")[0]: entry for name, entry in recorded.items() if "mean" in entry}
    assert set(found) == {
        "elbo",
        "reconstruction",
        "kl",
        "iwae",
        "pll",
        "fivo",
        "ess",
        "open_loop",
        "open_loop_marginal",
    }
    for metric, estimate in found.items():
        assert estimate.mean == means[metric]["mean"]
        assert estimate.standard_error == means[metric]["standard_error"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"scores": ["elbow"]}, "there is no score elbow, expected some of elbo, pll, fivo, open-loop"),
        ({"sequences": 1}, "a standard error needs at least 2 sequences, found 1"),
        ({"samples": 0}, "samples is 0, expected at least 1"),
        ({"scores": ["open-loop"], "context": 0}, "context is 0, expected at least 1"),
        ({"scores": ["open-loop"], "context": 5}, "sequence 2 has 5 steps, expected more than the context of 5"),
        ({"scores": ["open-loop"], "context": 99}, "expected more than the context of 99"),
    ],
)
def test_a_score_that_cannot_be_had_in_python_is_one_sentence(runs, options, sentence):
    world, data = load_run(runs[0])

    with pytest.raises(ForbesError, match=sentence):
        evaluate_model(world.model, data, **options)


def evaluate(*arguments):
    return main(["evaluate", *arguments, "--samples", "2", *([] if "--scores" in arguments else ["--scores", "elbo"])])


def record(run):
    """Its scores; the round trip of its flows has tests of its own."""
    entries = json.loads((RunFolder(run).path / "evaluation.json").read_text())
    return {name: entry for name, entry in entries.items() if not name.endswith("/round_trip")}


def record_is_missing(run):
    return not (RunFolder(run).path / "evaluation.json").exists()


def refusal(capsys, *arguments):
    """What `forbes evaluate` says of these arguments, which it refuses."""
    scores = [] if "--scores" in arguments else ["--scores", "elbo"]
    return error_of(capsys, "evaluate", "--samples", "2", *arguments, *scores)


def arrays_of(run):
    with np.load(RunFolder(run).path / "evaluation.npz") as arrays:
        return dict(arrays)


def test_records_the_mean_of_the_split_and_every_sequence(runs):
    assert evaluate(*runs, "--batch-size", "5") == 0

    for run in load_runs(runs):
        scores = score_split(run.model, split_batches(run.data, "test", 12, 5), make_scorer("elbo", 2, 5, 1))
        elbo, entry, array = scores.values["elbo"].sum(1), record(run.path)[NAME], arrays_of(run.path)[NAME]
        assert entry["mean"] == pytest.approx(elbo.mean().item(), rel=1e-12)
        assert entry["standard_error"] == pytest.approx(elbo.numpy().std(ddof=1) / 12**0.5)
        assert entry["interval_95"][0] < entry["mean"] < entry["interval_95"][1]
        assert array.dtype == np.float64
        np.testing.assert_array_equal(array, elbo.numpy())
        assert entry["per_step"]["mean"] == pytest.approx(array.sum() / entry["steps"])
        counts = scores.mask.sum(0)
        assert (torch.tensor(entry["curve"]) * counts).sum().item() == pytest.approx(array.sum(), rel=1e-5)


def test_records_where_the_numbers_come_from(runs):
    evaluate(*runs, "--seed", "3")
    entry = record(runs[0])[NAME]
    assert entry["command"] == f"forbes evaluate {runs[0]} {runs[1]} --seed 3 --samples 2 --scores elbo"
    assert {"commit", "date", "seconds", "device"} <= entry.keys()
    assert (entry["sequences"], entry["seed"]) == (12, 3)
    assert entry["data"]["name"].startswith("Strokes(origin=bundled")
    assert entry["data"]["sha256"] == record(runs[1])[NAME]["data"]["sha256"]


def test_a_record_names_the_checkpoint_that_was_measured(runs, overwritten):
    assert evaluate(*runs) == 0

    for run in map(RunFolder, runs):
        entries = json.loads((run.path / "evaluation.json").read_text())
        assert {entry["checkpoint"] for entry in entries.values()} == {overwritten[str(run.checkpoint)]}


def test_all_scores_are_default_and_named_with_their_numbers(runs, capsys):
    numbers = ["--samples", "2", "--particles", "3", "--futures", "4", "--context", "2", "--digits", "5"]
    assert main(["evaluate", *runs, *numbers]) == 0

    names = [
        *("elbo[bernoulli,S=2]", "reconstruction[bernoulli,S=2]", "kl[bernoulli,S=2]"),
        *("iwae[bernoulli,K=3]", "pll[bernoulli,K=3]", "fivo[bernoulli,K=3]", "ess[bernoulli,K=3]"),
        *("open_loop[bernoulli,K=4,c=2]", "open_loop_marginal[bernoulli,K=4,c=2]"),
        *("psnr[bernoulli,K=4,c=2]", "ssim[bernoulli,K=4,c=2]"),
    ]
    entries = record(runs[0])
    assert list(entries) == [f"test[:5]/{name}" for name in names]
    assert [name for name in entries if "paired" in entries[name]] == [f"test[:5]/{names[i]}" for i in (0, 3, 4, 5, 7)]
    ess = entries["test[:5]/ess[bernoulli,K=3]"]
    assert all(1 / 3 <= share <= 1 for share in (ess["mean"], ess["per_step"]["mean"], *ess["interval_95"]))
    open_loop, elbo = (entries[f"test[:5]/{name}"] for name in ("open_loop[bernoulli,K=4,c=2]", "elbo[bernoulli,S=2]"))
    assert not any(open_loop["curve"][:2])
    assert open_loop["steps"] == elbo["steps"] - 5 * 2
    assert open_loop["per_step"]["mean"] == pytest.approx(5 * open_loop["mean"] / open_loop["steps"])
    psnr = entries["test[:5]/psnr[bernoulli,K=4,c=2]"]
    assert psnr["unit"] == "dB"
    assert len(psnr["model"]) == len(psnr["last frame"]) == len(open_loop["curve"]) - 2
    out = capsys.readouterr().out
    assert "test[:5]/psnr[bernoulli,K=4,c=2]: score of the mean prediction as an image in dB" in out
    assert "test[:5]/degradation[bernoulli,K=4,c=2]" in out
    assert all(name in out for name in ("elbo", "iwae", "pll", "fivo", "open_loop", "[bernoulli,K=4,c=2]"))


@pytest.mark.parametrize("flags", [["MixtureBelief"], ["CategoricalBelief", "--model.belief.classes", "2"]])
def test_every_belief_family_has_every_score(runs, tiny_config, tmp_path, capsys, flags):
    run = str(fit(tiny_config, tmp_path / "run", "--model.belief", *flags))
    numbers = ["--samples", "2", "--particles", "3", "--futures", "2", "--context", "2", "--digits", "3"]
    assert main(["evaluate", run, runs[0], *numbers]) == 0

    assert list(record(run)) == list(record(runs[0]))
    assert flags[0].removesuffix("Belief") in capsys.readouterr().out


def test_a_score_that_a_model_does_not_have_is_left_out_and_said(runs, other_filters, capsys):
    vector, particle = other_filters
    numbers = ["--samples", "2", "--particles", "4", "--futures", "4", "--context", "2", "--digits", "5"]
    assert main(["evaluate", vector, runs[1], particle, *numbers]) == 0

    full, of_vector, of_particle = (record(run) for run in (runs[1], vector, particle))
    assert list(of_particle) == list(full)
    assert list(of_vector) == [name for name in full if any(s in name for s in ("pll", "open_loop", "psnr", "ssim"))]
    assert {pair["minus"] for pair in full["test[:5]/pll[bernoulli,K=4]"]["paired"]} == {vector, particle}
    assert {pair["minus"] for pair in full["test[:5]/fivo[bernoulli,K=4]"]["paired"]} == {particle}
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[-1].split(",")[0].strip() for line in lines[:3]] == ["Vector", "RSSM wide", "Particle"]
    rows = [line for line in lines if line.startswith("│ test[:5]/")]
    without = [row.split("│")[1].strip() for row in rows if row.count("n/a") == 1]  # in the first column only
    missing = ["elbo", "reconstruction", "kl", "iwae", "fivo", "ess"]
    over_reference = ["elbo", "iwae", "fivo"]
    assert without == [f"test[:5]/{score}" for score in [*missing, *over_reference]]
    assert len([row for row in rows if row.count("n/a") == 2]) == 3  # elbo, iwae, fivo: differences to both others

    module, data = load_run(vector)
    batch = data.sequences("test", torch.arange(5))
    with torch.no_grad():
        log_p = module.model.lower_bound(batch.observation, batch.action, batch.mask).elbo
    np.testing.assert_allclose(arrays_of(vector)["test[:5]/pll[bernoulli,K=4]"], log_p.numpy(), rtol=1e-6)


def test_one_sequence_at_a_time_gives_the_same_exact_score(other_filters):
    """A batch of one is no evaluation of one sequence, which has no standard error."""
    vector, _ = other_filters
    means = []
    for batch_size in ("1", "4"):
        assert main(["evaluate", vector, "--scores", "pll", "--batch-size", batch_size]) == 0
        means.append(record(vector)["test/pll[bernoulli,K=128]"]["mean"])

    assert means[0] == pytest.approx(means[1], rel=1e-5)


def test_impossible_scores_and_numbers_are_one_sentence(other_filters, capsys):
    vector, particle = other_filters
    expected = "a Vector model has no elbo or fivo score, since it has no density of a posterior. Ask for --scores pll "
    expected += "or open-loop"
    assert expected in refusal(capsys, vector, "--scores", "elbo", "fivo")
    message = refusal(capsys, particle, "--scores", "pll", "--particles", "3")
    assert "3 particles or futures, expected whole sets of 2" in message
    assert evaluate(particle, "--scores", "fivo", "--particles", "3", "--digits", "2") == 0  # of any number


def test_data_of_a_known_process_add_its_exact_likelihood(tmp_path, capsys):
    config = Path(__file__).parents[2] / "configs" / "pomdp" / "linear_gaussian" / "rssm.yaml"
    small = [
        "--data.updates_per_epoch=1",
        "--trainer.max_epochs=1",
        "--trainer.log_every_n_steps=1",
        "--data.source.init_args.test=40",
    ]
    run = fit(config, tmp_path / "run", *small)

    assert main(["evaluate", str(run), "--particles", "3", "--futures", "3", "--context", "5"]) == 0

    source = load_runs([str(run)])[0].data.source
    drawn = source.trajectories("test", 15)
    exact = source.process.log_likelihood(drawn.observation.float(), drawn.action)
    np.testing.assert_allclose(arrays_of(run)["test/log_p[exact]"], exact.numpy())
    scores = {name: entry["mean"] for name, entry in record(run).items()}
    bounds = [name for name in scores if name.startswith(("test/elbo[", "test/iwae[", "test/pll[", "test/fivo["))]
    assert len(bounds) == 4
    assert all(scores[name] < scores["test/log_p[exact]"] for name in bounds)  # nothing was learned yet
    assert "log_p" in capsys.readouterr().out


@pytest.mark.parametrize("process", ["linear_gaussian", "ungm", "tiger", "mountain_hike"])
def test_bounds_of_a_model_lie_in_order_below_log_p(process, tmp_path):
    """Paired over sequences, each difference at least 0 within four standard errors; whatever the weights are."""
    config = Path(__file__).parents[2] / "configs" / "pomdp" / process / "rssm.yaml"
    small = ["--data.length=10", "--data.updates_per_epoch=10", "--trainer.max_epochs=1", "--model.warmup=2"]
    small += ["--model.kl_warmup=0", "--data.source.init_args.test=200", "--trainer.callbacks=[]"]
    run = fit(config, tmp_path / "run", *small, "--trainer.log_every_n_steps=10")
    numbers = ["--samples", "4", "--particles", "16", "--futures", "2", "--context", "3"]
    assert main(["evaluate", str(run), "--scores", "elbo", "pll", "fivo", *numbers]) == 0

    scores = {name.partition("/")[2].partition("[")[0]: values for name, values in arrays_of(run).items()}
    for lower, upper in [("elbo", "iwae"), ("elbo", "fivo"), ("iwae", "log_p"), ("fivo", "log_p"), ("pll", "log_p")]:
        gap = scores[upper] - scores[lower]
        assert gap.mean() > -4 * gap.std(ddof=1) / len(gap) ** 0.5, (lower, upper)


def test_both_runs_record_the_same_paired_difference(runs, capsys):
    evaluate(*runs)

    (mine,), (theirs,) = (record(run)[NAME]["paired"] for run in runs)
    first, second = (arrays_of(run)[NAME] for run in runs)
    assert mine["minus"] == runs[1]
    assert mine["mean"] == pytest.approx((first - second).mean()) == -theirs["mean"]
    assert mine["standard_error"] == pytest.approx((first - second).std(ddof=1) / 12**0.5)
    assert f"{mine['mean']:+.2f} ± {mine['standard_error']:.2f}" in capsys.readouterr().out


def test_too_many_particles_for_memory_are_named_after_a_retry(runs, capsys):
    assert evaluate(runs[0], "--scores", "fivo", "--particles", "1000000000000", "--digits", "2") == 2

    error = capsys.readouterr().err.splitlines()[-1]
    assert f"{runs[0]}, test split: no memory for one sequence with K=1000000000000. Choose fewer particles" in error
    assert record_is_missing(runs[0])


@pytest.mark.parametrize(("code", "left"), [("same", 1), ("another", 3)])
def test_an_interrupted_evaluation_goes_on_where_it_stopped(runs, monkeypatch, code, left):
    """By changed code it starts again: a score must be of the code that its record names."""
    monkeypatch.setattr("forbes.commands.evaluate.code_sha256", lambda: "same")
    evaluate(runs[0], "--batch-size", "5")
    whole, calls = record(runs[0])[NAME], []

    def counted(*arguments, stop_at=10**9):
        calls.append(1)
        if len(calls) == stop_at:
            raise KeyboardInterrupt
        return score(*arguments)

    score = scoring._score
    monkeypatch.setattr(scoring, "_score", partial(counted, stop_at=3))
    assert evaluate(runs[0], "--batch-size", "5") == 130
    monkeypatch.setattr(scoring, "_score", counted)
    monkeypatch.setattr("forbes.commands.evaluate.code_sha256", lambda: code)
    assert evaluate(runs[0], "--batch-size", "5") == 0

    assert len(calls) == 3 + left  # two batches and the stop, then what is left of three batches
    assert record(runs[0])[NAME]["curve"] == whole["curve"]
    assert (RunFolder(runs[0]).path / "evaluation-parts").exists() == (code == "another")


def test_partial_scores_serve_only_their_seed_and_checkpoint(runs, monkeypatch):
    monkeypatch.setattr(PartialScores, "remove", lambda self: None)
    evaluate(runs[0])
    first = record(runs[0])[NAME]["mean"]
    evaluate(runs[0], "--seed", "1")
    assert record(runs[0])[NAME]["mean"] != first

    path = RunFolder(runs[0]).checkpoint
    checkpoint = torch.load(path, weights_only=True)
    checkpoint["state_dict"]["model.gru.bias_hh"] += 1
    torch.save(checkpoint, path)
    evaluate(runs[0])
    assert record(runs[0])[NAME]["mean"] != first


def test_more_than_four_runs_are_compared_with_the_first_only(runs, tmp_path):
    copies = [str(shutil.copytree(runs[0], tmp_path / f"copy{number}")) for number in range(4)]
    evaluate(runs[1], *copies)
    assert len(record(runs[1])[NAME]["paired"]) == 4
    assert [pair["minus"] for pair in record(copies[2])[NAME]["paired"]] == [runs[1]]


def test_the_same_command_gives_the_same_numbers(runs):
    evaluate(runs[0])
    first = record(runs[0])[NAME]
    evaluate(runs[0])
    assert record(runs[0])[NAME]["curve"] == first["curve"]


def test_each_split_and_subset_keeps_its_own_entry(runs):
    evaluate(runs[0])
    evaluate(runs[0], "--split", "validation")
    evaluate(runs[0], "--digits", "5")

    names = [NAME, "validation/elbo[bernoulli,S=2]", "test[:5]/elbo[bernoulli,S=2]"]
    assert [name for name in record(runs[0]) if "/elbo[" in name] == names
    assert [len(arrays_of(runs[0])[name]) for name in names] == [12, 20, 5]


def test_the_table_names_families_metrics_and_likelihoods(runs, capsys):
    evaluate(*runs)
    out = capsys.readouterr().out
    assert all(part in out for part in ("test", "elbo", "[bernoulli,S=2]"))
    assert "FORBES" in out
    assert "RSSM wide" in out  # from the experiment's name


def test_every_score_stands_beside_its_references(runs, capsys):
    numbers = ["--samples", "2", "--particles", "2", "--futures", "2", "--context", "2", "--sequences", "5"]
    assert main(["evaluate", *runs, *numbers]) == 0

    out, entries, run = capsys.readouterr().out, record(runs[0]), load_runs(runs)[0]
    expected = references(run.data, run.model.likelihood, "test", 5)
    for name, entry in entries.items():
        score = name.partition("/")[2].partition("[")[0]
        if score not in ("elbo", "iwae", "pll", "fivo", "open_loop"):
            assert "references" not in entry
            continue
        skipped = 2 if score == "open_loop" else 0
        assert {reference: each["mean"] for reference, each in entry["references"].items()} == {
            reference: pytest.approx(values[:, skipped:].sum(1).mean().item()) for reference, values in expected.items()
        }
        for reference, values in expected.items():
            paired = torch.from_numpy(arrays_of(runs[0])[name]) - values[:, skipped:].sum(1)
            difference = entry["references"][reference]["difference"]
            assert difference["mean"] == pytest.approx(paired.mean().item())
            assert difference["standard_error"] == pytest.approx(paired.std().item() / 5**0.5)
    assert "5-gram" in out
    assert out.count("/elbo, iwae, pll, fivo ") == 1  # these are of the same steps
    lowest = min(expected, key=lambda reference: expected[reference].sum(1).mean())
    assert out.count(f"< {lowest}") >= 4  # hardly trained: below all of them


@pytest.mark.parametrize("number", [1, 2, 6])
@pytest.mark.parametrize("width", [80, 120, 200])
def test_the_tables_fit_the_terminal_and_cut_no_name(runs, capsys, monkeypatch, number, width):
    monkeypatch.setattr(tables, "console", lambda _: Console(width=width))
    measured = evaluated(runs, number, "elbo")
    name = "test[:1000]/open_loop_marginal[normal(0.5,scale=1),K=1000,c=15]"
    for one in measured:
        one.entries[name] = one.entries[NAME]

    tables.print_runs(measured)
    tables.print_references(measured)
    tables.print_pairs(compare_pairs(measured))

    lines = capsys.readouterr().out.splitlines()
    table = [line for line in lines if line[:1] in "┏┃┡│└├"]
    assert max(map(len, table)) <= width
    assert "…" not in "".join(lines)
    head, tag = name.split("[normal")
    assert sum(head in line for line in lines) == sum(f"[normal{tag}" in line for line in lines) >= 1
    assert [line[0] for line in lines[:number]] == [str(k + 1) for k in range(number)]


def evaluated(runs, number, score):
    """So many measurements of the two runs, the first as it is and the others by other names."""
    args = Namespace(
        sequences=5, samples=2, particles=2, futures=2, context=2, batch_size=5, seed=0, device="cpu", split="test",
        scores=[score],
    )  # fmt: skip
    found = measure(load_runs(runs[:1]), args, "", results_folders(runs[:1]))
    one = found[0]
    entry = next(values for name, values in one.entries.items() if "/elbo[" in name)
    names = [runs[0], *(f"runs/compare/a-rather-long-name-of-a-run-{k}" for k in range(1, number))]
    return [
        EvaluatedRun(
            one.run._replace(path=name), {NAME: dict(entry)}, {NAME: one.totals["test[:5]/elbo[bernoulli,S=2]"]}
        )
        for name in names
    ]


def test_its_help_shows_an_example(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", "--help"])
    assert stop.value.code == 0
    assert "forbes evaluate runs/compare/forbes-0 runs/compare/rssm-0" in capsys.readouterr().out


def test_runs_of_different_data_are_not_compared(runs, tiny_config, tmp_path, capsys):
    other = fit(tiny_config, tmp_path / "other", "--data.init_args.source.init_args.points_per_step", "2")
    assert "points_per_step=2" in refusal(capsys, runs[0], str(other))
    assert record_is_missing(runs[0])


def test_splits_of_different_sizes_are_compared_on_what_they_share(runs, strokes_file, tmp_path, capsys):
    """The larger one is named first, then second."""
    splits = load_strokes(strokes_file, "")
    points, pen_up, offsets, labels = splits["test"]
    few = StrokeArrays(points[: offsets[8]], pen_up[: offsets[8]], offsets[:9], labels[:8])
    save_strokes(tmp_path / "few.npz", splits | {"test": few})
    config = RunFolder(runs[1]).config
    config.write_text(config.read_text().replace(str(strokes_file), str(tmp_path / "few.npz")))

    for order in (runs, runs[::-1]):
        assert evaluate(*order) == 0
        assert all("paired" in record(run)["test[:8]/elbo[bernoulli,S=2]"] for run in runs)


def test_runs_of_different_likelihoods_are_not_compared(runs, tiny_config, tmp_path, capsys):
    other = fit(tiny_config, tmp_path / "other", "--model.init_args.likelihood", "Normal")
    assert "its likelihood is normal(1)" in refusal(capsys, runs[0], str(other))


def test_a_broken_model_fails_and_names_run_and_sequence(runs, capsys):
    path = RunFolder(runs[0]).checkpoint
    checkpoint = torch.load(path, weights_only=True)
    checkpoint["state_dict"]["model.gru.weight_hh"].fill_(torch.nan)
    torch.save(checkpoint, path)

    assert f"{runs[0]}, test split: the elbo of sequence 0 is nan" in refusal(capsys, runs[0])
    assert record_is_missing(runs[0])


def test_wrong_arguments_are_named(runs, tmp_path, capsys):
    assert "--samples" in refusal(capsys, runs[0], "--samples", "0")
    assert "--sequences 1: a standard error needs at least 2" in refusal(capsys, runs[0], "--digits", "1")
    assert "the test split" in refusal(capsys, runs[0], "--digits", "13")
    assert "--sequences" in refusal(capsys, runs[0], "--sequences", "most")
    short = refusal(capsys, runs[0], "--scores", "open-loop", "--context", "5")
    assert "test split: sequence 2 has 5 steps, expected more than the context of 5. Choose a smaller" in short
    assert f"{runs[0]}/: is named twice. Name each run once" in refusal(capsys, f"{runs[0]}/", runs[0])
    assert "--episodes: is for agents, and none is named" in refusal(capsys, runs[0], "--episodes", "3")
    agent = str(Path(__file__).parents[1] / "old_runs" / "agent")
    assert "--split: is for world models" in error_of(capsys, "evaluate", agent, "--split", "train")
    assert "is named twice" in error_of(capsys, "evaluate", agent, f"{agent}/")
    assert "--checkpoint: is of a run" in error_of(capsys, "evaluate", "--model", "m:M", "--checkpoint", "best.ckpt")
    assert "invalid choice: 'bleu'" in refusal(capsys, runs[0], "--scores", "bleu")
    assert "--device moon" in refusal(capsys, runs[0], "--device", "moon")
    assert "no such run folder" in refusal(capsys, str(tmp_path / "nowhere"))
    (RunFolder(runs[0]).path / "evaluation.json").write_text("{")
    assert "not JSON" in refusal(capsys, runs[0])


@pytest.mark.parametrize(
    ("path", "family"),
    [
        ("runs/compare/rssm_wide-0", "RSSM wide"),
        ("runs/rssm_wide/7-0", "RSSM wide"),
        ("long-rssm_wide-0", "RSSM wide"),
        ("r-1", "RSSM"),
    ],
)
def test_the_folder_of_a_run_adds_to_its_family(runs, path, family):
    assert load_runs(runs[1:])[0]._replace(path=path).family == family


@pytest.mark.parametrize(
    ("kind", "family"),
    [
        ("gaussian", "RSSM"),
        ("flow", "FORBES"),
        ("flow in the prior", "FORBES"),
        ("mixture", "Mixture"),
        ("categorical", "Categorical"),
        ("particles", "Particle"),
        ("vector", "Vector"),
    ],
)
def test_a_family_has_its_published_name_or_that_of_its_class(runs, kind, family):
    assert load_runs(runs[:1])[0]._replace(path="r-1", model=make_model(kind)).family == family
