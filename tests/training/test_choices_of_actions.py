"""An agent of a few updates that makes several choices at a time, in environments of Gymnasium."""

import pytest

pytest.importorskip("gymnasium")

import toy_gymnasium  # noqa: F401
from small_agents import fit, forbes, write_config

from forbes.data.episodes.store import EpisodeStore
from forbes.factors import are_one_hot
from forbes.training.loading import load_run

CHOICES = {"Toy-Levers-v0": (3, 2), "Toy-Buttons-v0": (2, 2, 2)}
"""Environments of `toy_gymnasium`."""


@pytest.mark.parametrize("task", CHOICES)
def test_an_agent_of_gymnasium_makes_several_choices_at_a_time(task, tmp_path, capsys):
    sizes = CHOICES[task]
    options = ("--data.source.task", f"gymnasium:toy_gymnasium:{task}", "--data.source.options", "{}")
    assert fit("--config", write_config(tmp_path), *options, "--run_dir", tmp_path / "run") == 0

    store = EpisodeStore(tmp_path / "run" / "episodes")
    assert [record.policy for record in store.records.values()] == ["random"] * 2 + ["ImaginationActorCritic"] * 2
    assert {str(record.environment["discrete"]) for record in store.records.values()} == {str([*sizes])}
    for number in range(4):
        assert are_one_hot(store.episode(number).action[1:], sizes)
    agent, data = load_run(tmp_path / "run")
    data.source.close()
    assert (agent.discrete, agent.actor.sizes, data.discrete) == (sizes, sizes, sizes)
    assert forbes("evaluate", tmp_path / "run", "--episodes", 2, "--acting-samples", 3) == 0
    collect = ("data", "collect", "--policy", tmp_path / "run", "--episodes", 2, "-o", tmp_path / "more")
    assert forbes(*collect) == 0
    capsys.readouterr()
    assert forbes("data", "info", tmp_path / "more") == 0
    assert "action 1 = 1" in capsys.readouterr().out


def test_a_planner_says_that_it_makes_no_choices(tmp_path, capsys):
    task = ("--data.source.task", "gymnasium:toy_gymnasium:Toy-Levers-v0", "--data.source.options", "{}")

    assert fit("--config", write_config(tmp_path, "planet"), *task, "--run_dir", tmp_path / "run") == 2
    assert "actions are discrete, expected vectors. Use ImaginationActorCritic" in capsys.readouterr().err
