"""`forbes figures returns`: learning curves from run folders, seeds joined."""

import json

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from small_agents import fit, write_config

from forbes.commands.cli import main
from forbes.errors import ForbesError
from forbes.figures.returns import returns_against_env_steps
from forbes.figures.style import BLUE, ORANGE


@pytest.fixture
def runs(tmp_path):
    """Two seeds of one agent, and another agent, as their folders say it."""

    def make(name, task="Parrot", returns=((10, 1.0), (20, 3.0))):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        lines = [{"update": step, "env_steps": step, "return/acting": value} for step, value in returns]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        source = f"{{class_path: Experience, init_args: {{task: {task}}}}}"
        data = f"{{class_path: SequenceDataModule, init_args: {{source: {source}}}}}"
        (folder / "config.yaml").write_text(f"model: {{class_path: ImaginationActorCritic}}\ndata: {data}\n")
        return str(folder)

    return make


def test_seeds_meet_at_all_steps_that_all_have_reached():
    one, two = pd.Series({10: 0.0, 30: 4.0}), pd.Series({10: 2.0, 20: 8.0, 40: 0.0})

    axes = returns_against_env_steps("hike", {"forbes": [one, two], "dreamer": [one]}).axes[0]

    forbes, dreamer = axes.lines
    np.testing.assert_allclose(forbes.get_xdata(), [10, 20, 30])
    np.testing.assert_allclose(forbes.get_ydata(), [1, 5, 4])  # (0, 2), (2, 8), (4, 4)
    np.testing.assert_allclose(dreamer.get_ydata(), [0, 4])
    assert [to_hex(line.get_color()) for line in (forbes, dreamer)] == [BLUE, ORANGE]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["FORBES, 2 seeds", "Dreamer"]
    assert axes.get_title() == "hike"


def test_an_agent_that_was_measured_once_is_a_dot():
    one = pd.Series({10: 3.0})

    axes = returns_against_env_steps("hike", {"forbes": [one], "dreamer": [one, one + 1]}).axes[0]

    assert [line.get_marker() for line in axes.lines] == ["o", "s"]
    np.testing.assert_allclose([line.get_ydata() for line in axes.lines], [[3.0], [3.5]])


def test_curves_without_a_common_step_are_one_sentence():
    with pytest.raises(ForbesError, match="forbes: no step was reached by all its 2 seeds"):
        returns_against_env_steps("hike", {"forbes": [pd.Series({10: 3.0}), pd.Series({11: 3.0})]})


def test_folders_that_differ_in_the_number_are_seeds(runs, tmp_path, capsys):
    folders = [runs("forbes-0"), runs("forbes-1", returns=((10, 5.0), (20, 7.0))), runs("dreamer_n4-0")]

    assert main(["figures", "returns", "--runs", *folders, "-o", str(tmp_path / "figures")]) == 0

    assert capsys.readouterr().out.split() == [str(tmp_path / f"figures/returns.{kind}") for kind in ("png", "pdf")]
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"returns.png", "returns.pdf"}


def test_a_run_that_was_trained_is_drawn(tmp_path):
    run = tmp_path / "forbes-0"
    assert fit("--config", write_config(tmp_path), "--run_dir", run) == 0

    assert main(["figures", "returns", "--runs", str(run), "-o", str(tmp_path / "figures")]) == 0


def test_what_cannot_be_drawn_is_one_sentence(runs, tmp_path, capsys):
    for arguments, sentence in [
        ([runs("a-0"), runs("b-0", task="Slide")], "--runs: the tasks are Parrot and Slide, expected one task"),
        ([str(tmp_path / "absent")], "absent/metrics.jsonl: no such file"),
        ([runs("c-0", returns=())], "metrics.jsonl has no return/acting"),
    ]:
        assert main(["figures", "returns", "--runs", *arguments, "-o", str(tmp_path / "figures")]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1
    assert not (tmp_path / "figures").exists()
