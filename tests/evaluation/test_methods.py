"""What a run is called, from its configuration."""

import pandas as pd
import pytest
from recorded_runs import write_agent, write_run

from forbes.errors import ForbesError
from forbes.evaluation.methods import group_by_method, read_run, returns_of


def titles(folders, always=()):
    grouped = group_by_method([read_run(folder) for folder in folders], always)
    return {task: {title: len(runs) for title, runs in of_task.items()} for task, of_task in grouped.items()}


@pytest.mark.parametrize(
    ("kind", "belief", "settings", "name"),
    [
        ("ImaginationActorCritic", "GaussianBelief", {}, "Dreamer"),
        ("ImaginationActorCritic", "FlowBelief", {}, "FORBES"),
        ("ImaginationActorCritic", "CategoricalBelief", {}, "Categorical"),
        ("PlanningAgent", "GaussianBelief", {}, "PlaNet"),
        ("ImaginationActorCritic", "CategoricalBelief", {"two_hot": True}, "DreamerV3"),
        ("WorldModel", "GaussianBelief", {}, "RSSM"),
        ("WorldModel", "GaussianBelief", {"prior": "{class_path: forbes.FlowBelief}"}, "FORBES"),
        ("WorldModel", "GaussianBelief", {"model": "{class_path: forbes.VectorModel}"}, "Vector"),
        ("WorldModel", "FlowBelief", {"model": "{class_path: forbes.StateSpaceModel}"}, "FORBES"),
        ("your_agents.Soloist", "GaussianBelief", {}, "Soloist"),
    ],
)
def test_a_configuration_has_its_published_name(kind, belief, settings, name, tmp_path):
    run = read_run(write_run(tmp_path / "run", kind, belief, "Strokes", {}, [], **settings))

    assert run.method == name
    assert run.task == "Strokes"


@pytest.mark.parametrize(("shows", "name"), [("exact_belief", "exact belief"), ("nothing", "no observation")])
def test_an_agent_that_observes_something_else_is_called_after_it(shows, name, tmp_path):
    run = read_run(write_agent(tmp_path / "run", "tiger", {}, options={"shows": shows}))

    assert (run.method, run.task) == (name, "tiger")


def test_a_store_of_episodes_is_called_like_its_folder(tmp_path):
    folder = write_run(tmp_path / "run", "WorldModel", "FlowBelief", "Replay", {"path": "/episodes/cartpole"}, [])

    assert read_run(folder).task == "cartpole"


def test_runs_that_differ_only_in_the_seed_are_one_method(tmp_path):
    folders = [write_agent(tmp_path / name, "hop", {}, seed=seed) for seed, name in enumerate(("any", "name"))]

    assert titles(folders) == {"hop": {"FORBES": 2}}


def test_methods_of_several_tasks_have_one_name(tmp_path):
    folders = [write_agent(tmp_path / task, task, {}, "GaussianBelief") for task in ("hop", "run")]

    assert titles(folders) == {"hop": {"Dreamer": 1}, "run": {"Dreamer": 1}}


def test_settings_are_in_the_title_if_they_differ_or_are_asked_for(tmp_path):
    folders = [
        write_agent(tmp_path / "one", "hop", {}, "GaussianBelief", 1),
        write_agent(tmp_path / "four", "hop", {}, "GaussianBelief", 4),
        write_agent(tmp_path / "deep", "run", {}, "GaussianBelief", 4, layers=3),
        write_agent(tmp_path / "flow", "hop", {}, "FlowBelief", 4),
    ]

    deep = {"Dreamer, N = 4, 3 layers": 1}
    dreamers = {"Dreamer, N = 1, 2 layers": 1, "Dreamer, N = 4, 2 layers": 1}
    assert titles(folders) == {"hop": dreamers | {"FORBES": 1}, "run": deep}
    assert titles(folders[3:]) == {"hop": {"FORBES": 1}}
    assert titles(folders[3:], ["trajectories"]) == {"hop": {"FORBES, N = 4": 1}}


def test_other_configurations_are_told_apart_by_their_folder(tmp_path):
    named = [write_agent(tmp_path / f"{name}-3", "hop", {}, horizon=name) for name in ("near", "far")]
    stamped = write_agent(tmp_path / "long" / "20251128-230000-0", "hop", {}, horizon="long")
    twin = write_agent(tmp_path / "other" / "far-0", "hop", {}, horizon="farther")

    assert titles([*named, stamped]) == {"hop": {"FORBES (near)": 1, "FORBES (far)": 1, "FORBES (long)": 1}}
    assert set(titles([*named, twin])["hop"]) == {"FORBES (near)", f"FORBES ({named[1]})", f"FORBES ({twin})"}


def test_returns_are_those_without_exploration(tmp_path):
    lines = [
        {"update": 1, "env_steps": 10.0, "return/exploring": 9.0},
        {"update": 2, "env_steps": 20.0, "return/acting": 3.0},
    ]
    run = read_run(write_run(tmp_path / "run", "PlanningAgent", "GaussianBelief", "Experience", {"task": "hop"}, lines))

    pd.testing.assert_series_equal(returns_of(run), pd.Series({20.0: 3.0}), check_names=False)


def test_what_is_no_run_of_an_agent_is_one_sentence(tmp_path):
    with pytest.raises(ForbesError, match=r"absent: not a run folder, config\.yaml is missing"):
        read_run(str(tmp_path / "absent"))
    with pytest.raises(ForbesError, match=r"metrics\.jsonl has no return/acting"):
        returns_of(read_run(write_agent(tmp_path / "run", "hop", {})))
