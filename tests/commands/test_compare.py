"""`forbes compare`: trains, measures and puts side by side; interrupted, it goes on."""

import json
import os
import platform
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from jobs_in_this_process import configuration_here, run_here
from small_agents import forbes, write_config

from forbes.commands import compare as compare_command
from forbes.commands import trainings
from forbes.commands.cli import main
from forbes.commands.jobs import Ended, run_jobs
from forbes.commands.trainings import Training, training_job
from forbes.evaluation.comparison import Comparison, Family, compare, markdown
from forbes.evaluation.metrics import score_of
from forbes.evaluation.record import read_arrays, read_record
from forbes.figures.comparison import draw_differences, draw_per_step, draw_scores
from forbes.files import locked
from forbes.runs.configuration import allow_modules
from forbes.runs.folder import RunFolder, read_metrics

ELBO = "test/elbo[bernoulli,S=2]"
ONE_EPOCH = ["--", "--trainer.max_epochs", "1"]
MEASURES = ["--samples", "2", "--particles", "2", "--futures", "2", "--context", "2"]
CONFIGURATION = trainings.complete_configuration
"""The one in a process of its own."""


@pytest.fixture(scope="module", autouse=True)
def one_process():
    """A process of its own would spend most of a test on its imports."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare_command, "run_jobs", run_here)
        for module in (compare_command, trainings):
            patch.setattr(module, "complete_configuration", configuration_here)
        yield


@pytest.fixture(scope="module")
def configs(tiny_config, tmp_path_factory):
    """The tiny configuration, and one of an RSSM beside it."""
    rssm = tmp_path_factory.mktemp("configs") / "rssm.yaml"
    text = tiny_config.read_text().replace(
        "{class_path: FlowBelief, init_args: {layers: 2, width: 4}}", "GaussianBelief"
    )
    rssm.write_text(text)
    return [str(rssm), str(tiny_config)]


@pytest.fixture(scope="module")
def compared(configs, tmp_path_factory):
    """The folder of a comparison of two families with two seeds each."""
    folder = tmp_path_factory.mktemp("compared")
    arguments = ["compare", *configs, "--seeds", "2", "-o", str(folder), *MEASURES]
    assert main([*arguments, *ONE_EPOCH]) == 0
    return folder


@pytest.fixture(scope="module")
def families(compared):
    return [Family(n, {seed: str(compared / f"{n}-{seed}") for seed in range(2)}, 9) for n in ("rssm", "forbes")]


def test_each_config_trains_with_each_seed_and_the_flags(compared):
    for name in ("rssm", "forbes"):
        for seed in range(2):
            provenance = json.loads((compared / f"{name}-{seed}" / "provenance.json").read_text())
            assert str(seed) in json.dumps(provenance)
            metrics = (compared / f"{name}-{seed}" / "metrics.jsonl").read_text().splitlines()
            assert json.loads(metrics[-1])["update"] == 5  # one epoch instead of two


def test_tables_hold_every_score_and_paired_seed_differences(compared):
    table = pd.read_csv(compared / "comparison.csv")
    assert set(table["family"]) == {"rssm", "forbes"}
    assert {"elbo", "iwae", "pll", "fivo", "open_loop"} <= {name[5:].split("[")[0] for name in table["metric"]}

    record = json.loads((compared / "comparison.json").read_text())
    elbo = {row["seed"]: row for row in record["differences"] if row["metric"] == ELBO}
    for seed in range(2):
        forbes, rssm = (read_arrays(str(compared / f"{name}-{seed}"))[ELBO] for name in ("forbes", "rssm"))
        assert elbo[seed]["mean"] == pytest.approx((forbes - rssm).mean())
        assert elbo[seed]["standard_error"] == pytest.approx((forbes - rssm).std(ddof=1) / np.sqrt(len(rssm)))
        assert f"{(forbes - rssm).mean():.2f} ±" in (compared / "comparison.md").read_text()


def test_the_pictures_are_there_and_show_the_values(compared, families):
    assert {path.name for path in compared.glob("*.png")} == {"scores.png", "per-step.png", "differences.png"}
    comparison = compare(families, [ELBO])

    (panel,) = draw_scores(comparison).axes
    own = comparison.scores.groupby("family", sort=False)["mean"]
    bars = [line.get_xdata()[0] for line in panel.lines if len(line.get_xdata()) == 2 and line.get_marker() == "None"]
    assert bars == pytest.approx(own.mean().tolist())
    assert [text.get_text() for text in panel.get_yticklabels()] == ["RSSM", "FORBES"]

    (panel,) = draw_per_step(comparison).axes
    assert panel.lines[1].get_ydata() == pytest.approx(comparison.curves[ELBO]["forbes"])

    (panel,) = draw_differences(comparison, "rssm").axes
    assert panel.texts[0].get_text() == f"{comparison.differences['mean'].mean():+.2f}"


@pytest.fixture(scope="module")
def vector(configs, tmp_path_factory):
    """The configuration of a model without bounds."""
    path = tmp_path_factory.mktemp("configs") / "vector.yaml"
    flows = "{class_path: FlowBelief, init_args: {layers: 2, width: 4}}"
    text = Path(configs[1]).read_text().replace(f"belief: {flows}", "model: VectorModel")
    path.write_text(text.replace("state_dim: 2", "state_dim: 0"))
    return str(path)


def test_a_score_that_a_family_does_not_have_is_empty(configs, vector, compared, tmp_path):
    folder = shutil.copytree(compared, tmp_path / "compared")

    assert main(["compare", vector, *configs, "-o", str(folder), *MEASURES, *ONE_EPOCH]) == 0

    table = pd.read_csv(folder / "comparison.csv").set_index(["metric", "family"])
    pll = next(name for name in table.index.levels[0] if "/pll[" in name)
    record = json.loads((folder / "comparison.json").read_text())  # which has no NaN
    text = (folder / "comparison.md").read_text()
    rows = {
        line.split("|")[1].strip(" `"): line for line in text.split("Models without")[0].splitlines() if line[:1] == "|"
    }
    assert np.isnan(table.loc[(ELBO, "vector"), "mean"])
    assert np.isfinite(table.loc[(pll, "vector"), "mean"])
    assert table.loc[(ELBO, "vector"), "parameters"] == table.loc[(pll, "vector"), "parameters"] > 0
    blank = [row for row in record["scores"] if row["mean"] is None]
    assert {row["family"] for row in blank} == {"vector"}
    assert ELBO in {row["metric"] for row in blank}
    assert "n/a" in rows[ELBO]
    assert "n/a" not in rows[pll]
    assert {score_of(row["metric"]) for row in record["differences"]} == {"pll", "open_loop"}

    families = [Family(n, {0: str(folder / f"{n}-0")}, 9, lacks) for n, lacks in [("rssm", []), ("vector", [ELBO])]]
    comparison = compare(families, [ELBO, pll])
    elbo, of_pll = draw_per_step(comparison).axes
    assert [line.get_label() for line in elbo.lines] == ["RSSM"]
    assert {line.get_label(): line.get_color() for line in of_pll.lines}["RSSM"] == elbo.lines[0].get_color()
    legend = draw_per_step(comparison).legends[0]
    assert [entry.get_text() for entry in legend.get_texts()] == ["RSSM", "Vector"]


def test_an_outlier_is_labelled_and_the_exact_line_is_drawn():
    means = {"a": -1.0, "b": -1.2, "c": -1.1, "far": -40.0}
    rows = [(f, "test/elbo[S=1]", v) for f, v in means.items()] + [(f, "test/log_p[exact]", -0.5) for f in means]
    table = pd.DataFrame([{"family": f, "metric": m, "seed": 0, "mean": v, "standard_error": 0.1} for f, m, v in rows])

    (panel,) = draw_scores(Comparison(table, table, {}, {})).axes

    assert [text.get_text() for text in panel.texts] == ["← −40.0"]
    assert panel.get_xlim()[0] > -3
    assert panel.lines[-1].get_xdata()[0] == -0.5


def test_the_exact_line_is_that_of_the_same_sequences():
    """The exact score is of the whole split, the others may be of its first thousand sequences."""
    rows = [("a", "test[:1000]/pll[K=1]", -8.5), ("a", "test/log_p[exact]", -9.0)]
    table = pd.DataFrame([{"family": f, "metric": m, "seed": 0, "mean": v, "standard_error": 0.1} for f, m, v in rows])

    figure = draw_scores(Comparison(table, table, {}, {}))

    assert all(line.get_linestyle() != "--" for line in figure.axes[0].lines)
    assert "dashed" not in figure.get_supxlabel()


def test_a_difference_that_two_families_do_not_have_says_so():
    rows = [("a", "test/elbo[S=1]", 1.0), ("a", "test/pll[K=1]", 2.0), ("b", "test/pll[K=1]", -1.0)]
    table = pd.DataFrame([{"family": f, "metric": m, "seed": 0, "mean": v, "standard_error": 0.1} for f, m, v in rows])

    (panel,) = draw_differences(Comparison(table, table, {}, {}), "first").axes

    assert [text.get_text() for text in panel.texts] == ["+1.00", "+2.00", "n/a", "-1.00"]


def test_given_again_it_trains_and_measures_nothing(configs, compared, monkeypatch, capfd):
    measured = []
    monkeypatch.setattr(compare_command, "evaluate", lambda *arguments: measured.append(arguments))
    before = {path: path.read_bytes() for path in compared.rglob("evaluation.json")}

    assert main(["compare", *configs, "--seeds", "2", "-o", str(compared), *MEASURES, *ONE_EPOCH]) == 0

    assert measured == []
    assert {path: path.read_bytes() for path in compared.rglob("evaluation.json")} == before


def test_other_noise_is_measured_anew(configs, compared, tmp_path):
    folder = shutil.copytree(compared, tmp_path / "compared")
    command = ["compare", *configs, "--scores", "elbo", "-o", str(folder), *MEASURES, "--seed", "1", *ONE_EPOCH]

    assert main(command) == 0

    for run, other in [(folder / "rssm-0", compared / "rssm-0"), (folder / "forbes-0", compared / "forbes-0")]:
        assert json.loads((run / "evaluation.json").read_text())[ELBO]["seed"] == 1
        assert not np.array_equal(read_arrays(str(run))[ELBO], read_arrays(str(other))[ELBO])


def test_a_record_of_other_sequences_is_measured_anew(configs, compared, tmp_path):
    """Episodes were added to a store, for example."""
    folder = shutil.copytree(compared, tmp_path / "compared")
    path = folder / "rssm-0" / "evaluation.json"
    found = json.loads(path.read_text())
    sha256, found[ELBO]["data"]["sha256"] = found[ELBO]["data"]["sha256"], "of others"
    path.write_text(json.dumps(found))

    assert main(["compare", *configs, "--scores", "elbo", "-o", str(folder), *MEASURES, *ONE_EPOCH]) == 0

    assert json.loads(path.read_text())[ELBO]["data"]["sha256"] == sha256


def test_it_goes_on_where_it_was_stopped(configs, tmp_path, monkeypatch):
    """Killed in the second training, then between the measurement of one run and that of another."""
    command = ["compare", *configs, "--scores", "elbo", "-o", str(tmp_path), *MEASURES, *ONE_EPOCH]
    measure = compare_command.evaluate

    def killed_in_the_second(jobs, launcher):
        return [*run_here(jobs[:1], launcher), Ended(jobs[1], 143, 0.0, "stopped at update 0")]

    monkeypatch.setattr(compare_command, "run_jobs", killed_in_the_second)
    assert main(command) == 2
    monkeypatch.setattr(compare_command, "run_jobs", run_here)
    monkeypatch.setattr(compare_command, "evaluate", lambda runs, *rest: measure(runs[:1], *rest) and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(command)
    measured = []
    monkeypatch.setattr(compare_command, "evaluate", lambda runs, *rest: measured.append(runs) or measure(runs, *rest))

    assert main(command) == 0

    assert [[run.path for run in runs] for runs in measured] == [[str(tmp_path / "forbes-0")]]
    assert len((tmp_path / "comparison.md").read_text().splitlines()) > 4
    for name in ("rssm", "forbes"):
        metrics = (tmp_path / f"{name}-0" / "metrics.jsonl").read_text().splitlines()
        assert json.loads(metrics[-1])["update"] == 5


@pytest.mark.parametrize("scores", [["elbo"], ["fivo"]])
def test_a_family_without_any_of_the_scores_has_a_row_of_its_own(scores, configs, vector, compared, tmp_path, capsys):
    folder = shutil.copytree(compared, tmp_path / "compared")

    assert main(["compare", configs[0], vector, "-o", str(folder), "--scores", *scores, *MEASURES, *ONE_EPOCH]) == 0

    table = pd.read_csv(folder / "comparison.csv").set_index("family")
    assert table.loc["vector", "mean"].isna().all()
    assert table.loc["rssm", "mean"].notna().all()
    assert (table.loc["vector", "parameters"] > 0).all()
    assert (folder / "per-step.png").exists()


def test_degradation_is_what_open_loop_loses_at_each_step(compared, families):
    metrics = list(pd.read_csv(compared / "comparison.csv")["metric"].unique())

    comparison = compare(families, metrics)

    (degradation,) = [metric for metric in comparison.curves if score_of(metric) == "degradation"]
    pll, marginal = (
        next(metric for metric in metrics if score_of(metric) == name) for name in ("pll", "open_loop_marginal")
    )
    for name in ("rssm", "forbes"):
        records = [read_record(run) for run in runs_of(families, name)]
        closed, opened = (np.mean([record[metric]["curve"] for record in records], 0) for metric in (pll, marginal))
        expected = np.where(np.arange(len(closed)) < 2, 0, closed - opened)
        assert comparison.curves[degradation][name] == pytest.approx(expected.tolist())
    text = markdown(comparison, families)
    assert f"`{degradation}`" in text
    assert f"| forbes | {comparison.curves[degradation]['forbes'][2]:.2f} |" in text
    assert len(draw_per_step(comparison).axes) == 5


def runs_of(families, name):
    return next(family for family in families if family.name == name).runs.values()


def test_references_stand_below_the_table_and_in_the_picture(compared, families):
    metrics = list(pd.read_csv(compared / "comparison.csv")["metric"].unique())

    comparison = compare(families, metrics)

    bounds = [metric for metric in metrics if score_of(metric) in ("elbo", "iwae", "pll", "fivo", "open_loop")]
    assert [*comparison.references] == bounds
    names = [f"{order}-gram" for order in range(1, 6)]
    assert all([*means] == names for means in comparison.references.values())
    text = markdown(comparison, families)
    means = comparison.references[ELBO]
    numbers = " | ".join(f"{mean:.2f}" for mean in means.values())
    (row,) = [line for line in text.splitlines() if line.endswith(f" | {numbers} |")]  # one for all of the same steps
    assert row.split("`")[1].partition("/")[2].split(", ") == [*filter("open_loop".__ne__, map(score_of, bounds))]
    lowest = min(names, key=means.__getitem__)
    (row,) = [line for line in text.splitlines() if line.startswith(f"| `{ELBO}` |") and "<" in line]
    assert row.count(f"< {lowest}") == 2  # hardly trained: below all of them
    axes = draw_scores(comparison._replace(references={ELBO: {"below": -1e9, "above": 1e9}})).axes[0]
    labels = [text.get_text() for text in axes.texts]
    assert "above 1000000000.0 →" in labels
    assert not any("below" in label for label in labels)


def test_a_run_that_was_trained_otherwise_is_refused_and_the_others_finish(configs, compared, tmp_path, capsys):
    folder = shutil.copytree(compared / "rssm-0", tmp_path / "rssm-0").parent

    assert main(["compare", *configs, "-o", str(folder), *MEASURES]) == 2

    out, error = capsys.readouterr()
    reason = "was trained with trainer.max_epochs = 1, expected 2. Use its configuration"
    assert f"not finished: {folder}/rssm-0 {reason}" in out
    assert f"1 of 2 trainings are not finished, for the reasons above: {folder}/rssm-0. Fix them" in error
    assert read_metrics(folder / "forbes-0").index.max() == 10


def test_finished_trainings_are_not_begun_again(configs, compared, tmp_path, monkeypatch):
    folder, begun = shutil.copytree(compared, tmp_path / "again"), []
    monkeypatch.setattr(compare_command, "run_jobs", lambda jobs, launcher: begun.extend(jobs) or [])

    assert main(["compare", *configs, "--seeds", "2", "-o", str(folder), *MEASURES, *ONE_EPOCH]) == 0

    assert begun == []


@pytest.mark.parametrize(
    ("callbacks", "refused"),
    [
        ("[{class_path: Collect, init_args: {seed_episodes: 5}}, ReturnCurve]", ""),
        ("[{class_path: Collect, init_args: {seed_episodes: 3}}]", "seed_episodes = 5, expected 3. Use its"),
        ("[Collect, CudaGraph]", "expected ['Collect', 'CudaGraph']"),
    ],
    ids=["picture", "other episodes", "other updates"],
)
def test_a_run_with_other_callbacks_is_refused_if_they_change_the_training(callbacks, refused, tmp_path):
    config = write_config(tmp_path)
    config.write_text(config.read_text().partition("  callbacks:")[0])
    run = RunFolder(tmp_path / "run")
    run.checkpoint.parent.mkdir(parents=True)
    run.checkpoint.touch()
    allow_modules(["toy_environments"])
    trained = "[{class_path: Collect, init_args: {seed_episodes: 5}}]"
    run.config.write_text(configuration_here(str(config), "--trainer.callbacks", trained))

    reason = training_job(Training(str(config), ("--trainer.callbacks", callbacks), 0, str(run))).refused

    assert refused in reason
    assert bool(refused) == bool(reason)


def test_a_folder_that_another_process_holds_is_named_with_it(configs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(compare_command, "run_jobs", run_jobs)
    with locked(tmp_path / "rssm-0", "trains here"):
        assert main(["compare", *configs, "-o", str(tmp_path), *MEASURES, *ONE_EPOCH]) == 2

    out = capsys.readouterr().out
    holder = f"process {os.getpid()} on {platform.node()} trains here. Choose another --run_dir"
    assert f"not finished: {tmp_path}/rssm-0 ended with status 2: forbes: {tmp_path}/rssm-0: {holder}" in out
    assert read_metrics(tmp_path / "forbes-0").index.max() == 5


def test_what_could_not_be_compared_is_refused_before_it_is_trained(configs, tmp_path, capsys):
    def error_of(*arguments):
        assert main(["compare", *arguments, "-o", str(tmp_path / "out")]) == 2
        return capsys.readouterr().err.splitlines()[-1]

    shorter = tmp_path / "shorter.yaml"
    shorter.write_text(Path(configs[0]).read_text().replace("length: 6", "length: 5"))

    assert "sequence 2 has 5 steps, expected more than the context of 100" in error_of(
        *configs, *MEASURES, "--context", "100"
    )
    assert "shorter.yaml: its data are" in error_of(*configs, str(shorter), *MEASURES)
    assert not (tmp_path / "out").exists()


def test_what_is_wrong_is_said_in_one_sentence(configs, compared, families, tmp_path, monkeypatch, capsys):
    def error_of(*arguments):
        capsys.readouterr()
        assert main(["compare", *arguments, "-o", str(tmp_path)]) == 2
        return capsys.readouterr().err.splitlines()[-1]

    assert "absent.yaml: no such configuration" in error_of("absent.yaml")
    twin = tmp_path / "rssm.yaml"
    twin.write_text(Path(configs[0]).read_text())
    assert "another configuration is called rssm" in error_of(configs[0], str(twin))
    monkeypatch.setattr(compare_command, "complete_configuration", CONFIGURATION)
    assert "no_such_key" in error_of(configs[0], "--", "--model.no_such_key", "1")
    with pytest.raises(Exception, match=r"rssm-0: evaluation.json has no test/bleu"):
        compare(families, ["test/bleu"])


def test_agents_are_compared_by_their_returns(tmp_path, capsys):
    """They have no held-out sequences: the comparison ended with an error after all trainings."""
    configs = [str(write_config(tmp_path, kind)) for kind in ("dreamer", "forbes")]
    compare = ["compare", *configs, "--seeds", "2", "-o", str(tmp_path / "runs")]

    assert forbes(*compare, *ONE_EPOCH) == 0

    printed = capsys.readouterr().out
    assert "return" in printed
    for run in ("dreamer-0", "dreamer-1", "forbes-0", "forbes-1"):
        assert any(name.startswith("return") for name in read_record(tmp_path / "runs" / run))


def test_what_cannot_be_compared_is_refused_before_any_training(configs, tmp_path, capsys):
    agent = str(write_config(tmp_path))
    refused = {
        "an agent is compared by its return, a world model by its scores": [configs[0], agent],
        "--context: agents are compared by their returns. Remove --context": [agent, "--context", "3"],
        "Use forbes beliefs": ["pomdp/linear_gaussian/known_gaussian"],
    }
    for sentence, named in refused.items():
        assert forbes("compare", *named, "-o", str(tmp_path / "runs")) == 2
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
