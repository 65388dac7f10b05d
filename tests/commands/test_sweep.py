"""`forbes compare --sweep`: a grid of one configuration, ranked by its validations."""

import re

import pandas as pd
import pytest
from command_line import error_of
from jobs_in_this_process import configuration_here, run_here

from forbes.commands import sweep as sweep_command
from forbes.commands import trainings
from forbes.commands.cli import main
from forbes.commands.sweep import grid
from forbes.runs.folder import read_metrics
from forbes.runs.naming import with_suffix


@pytest.fixture(scope="module", autouse=True)
def one_process():
    """A process of its own would spend most of a test on its imports."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_command, "run_jobs", run_here)
        patch.setattr(trainings, "complete_configuration", configuration_here)
        yield


def test_the_best_point_is_that_of_the_best_validation(tiny_config, tmp_path, capsys):
    swept = ["--sweep", "model.learning_rate=1e-3,1e-1", "model.state_dim=2,3"]

    assert main(["compare", str(tiny_config), *swept, "--seeds", "2", "-o", str(tmp_path)]) == 0

    best = {}
    for rate in ("1e-3", "1e-1"):
        for dimension in ("2", "3"):
            runs = [tmp_path / f"forbes,learning_rate={rate},state_dim={dimension}-{seed}" for seed in range(2)]
            metrics = [read_metrics(run) for run in runs]
            (name,) = {name for each in metrics for name in each if re.match(r"val/elbo\[", name)}
            best[rate, dimension] = sum(each[name].max() for each in metrics) / 2
    table = pd.read_csv(tmp_path / "sweep.csv", dtype=str)
    ranked = sorted(best, key=best.get, reverse=True)
    assert [*zip(table["model.learning_rate"], table["model.state_dim"], strict=True)] == ranked
    assert table["mean"].astype(float).tolist() == pytest.approx([best[point] for point in ranked])
    rate, dimension = ranked[0]
    line = f"best: forbes fit {tiny_config} --model.learning_rate={rate} --model.state_dim={dimension}"
    assert line in capsys.readouterr().out.splitlines()
    assert not [*tmp_path.rglob("evaluation.json")]  # nothing of the test split


def test_every_combination_is_one_point_and_its_name_has_the_values():
    points = grid("configs/strokes/forbes.yaml", ["model.state_dim=4,8", "data.length=20,30,40"])

    assert len(points) == 6
    assert points[1].name == "forbes,state_dim=4,length=30"
    assert points[1].flags == ("--model.state_dim=4", "--data.length=30")


@pytest.mark.parametrize(("config", "method"), [("rssm.yaml", "RSSM"), ("rssm_wide.yaml", "RSSM wide")])
def test_the_values_in_the_name_of_a_run_are_no_part_of_its_method(config, method):
    (point,) = grid(config, ["model.learning_rate=1e-3"])

    assert with_suffix("RSSM", f"runs/sweep/{point.name}-0") == method


def test_commas_inside_brackets_and_quotes_do_not_part_values():
    nested = "model.belief={class_path: FlowBelief, init_args: {layers: 2}},GaussianBelief"

    points = grid("tiny", [nested, "trainer.callbacks=[A,B],[]", "trainer.profiler='a,b'"])

    assert [*points[0].values.values()] == ["{class_path: FlowBelief, init_args: {layers: 2}}", "[A,B]", "'a,b'"]
    assert points[3].values == {
        "model.belief": "GaussianBelief",
        "trainer.callbacks": "[]",
        "trainer.profiler": "'a,b'",
    }
    assert points[0].name == "tiny,belief=_class_path_FlowBelief_init_args_layers_2_,callbacks=_A_B_,profiler=_a_b_"


def test_keys_with_the_same_last_part_keep_their_sections():
    (point,) = grid("tiny", ["model.length=1", "data.length=2"])

    assert point.name == "tiny,model.length=1,data.length=2"


def test_what_is_wrong_is_said_in_one_sentence_before_training(tiny_config, tmp_path, capsys):
    def error(*arguments):
        return error_of(capsys, "compare", *arguments, "-o", tmp_path / "runs")

    assert error(tiny_config, "--sweep", "model.learning_rate").startswith("--sweep model.learning_rate: expected KEY=")
    assert "expected KEY=V1,V2" in error(tiny_config, "--sweep", "model.learning_rate=1,,2")
    assert "expected KEY=V1,V2" in error(tiny_config, "--sweep", "model.learning_rate=[1,2")
    twice = error(tiny_config, "--sweep", "model.state_dim=2,2")
    assert twice.startswith("--sweep: two points of the grid are called forbes,state_dim=2. Remove or change")
    assert "a key is given twice" in error(tiny_config, "--sweep", "model.state_dim=2", "model.state_dim=3")
    assert "takes one configuration" in error(tiny_config, tiny_config, "--sweep", "model.state_dim=2")
    assert "nothing is evaluated. Remove --samples" in error(
        tiny_config, "--sweep", "model.state_dim=2", "--samples", "3"
    )
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("key", "sentence"),
    [
        ("model.learning_rat=1,2", "model.learning_rat: WorldModel has no such option, did you mean learning_rate?"),
        ("model.state_dim=2,x", "model.state_dim: is x, expected int"),
    ],
)
def test_a_wrong_key_or_value_is_refused_before_training(key, sentence, tiny_config, tmp_path, capsys):
    assert sentence in error_of(capsys, "compare", tiny_config, "--sweep", key, "-o", tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
