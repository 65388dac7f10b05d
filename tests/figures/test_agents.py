"""The figures of agents: learning curves from run folders, seeds joined, next to what is published."""

import gzip
import json
from functools import partial

import numpy as np
import pandas as pd
import pytest
from dm_control import suite
from matplotlib.colors import to_hex
from recorded_runs import write_agent, write_run

from forbes.commands.cli import main
from forbes.envs.dm_control import DOMAINS
from forbes.errors import ForbesError
from forbes.figures.agents import (
    PAPER_TASKS,
    draw_layers,
    draw_returns,
    draw_returns_1m,
    draw_trajectories,
    draw_trajectories_n,
    summarise_returns,
    variant_styles,
)
from forbes.figures.catalogue import draw
from forbes.figures.returns import join_seeds
from forbes.figures.style import METHODS


@pytest.fixture(autouse=True)
def _no_fetched_curves(tmp_path, monkeypatch):
    monkeypatch.setenv("FORBES_DATA", str(tmp_path / "data"))


def only(figures, name):
    assert list(figures) == [name]
    return figures[name]


def panels(figure):
    return {axes.get_title(): axes for axes in figure.axes}


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def line(axes, label):
    return next(each for each in axes.lines if each.get_label() == label)


@pytest.fixture
def agents(tmp_path):
    """The runs of the paper's ablations on one task, and FORBES alone on another."""
    steps = (100_000, 500_000, 900_000)
    kinds = {
        "forbes": ("FlowBelief", 4, 2, "ImaginationActorCritic"),
        "dreamer": ("GaussianBelief", 1, 2, "ImaginationActorCritic"),
        "dreamer_n4": ("GaussianBelief", 4, 2, "ImaginationActorCritic"),
        "forbes_n1": ("FlowBelief", 1, 2, "ImaginationActorCritic"),
        "dreamer_plus1": ("GaussianBelief", 1, 3, "ImaginationActorCritic"),
        "planet": ("GaussianBelief", 1, 2, "PlanningAgent"),
    }
    made = {
        name: write_agent(tmp_path / name, "walker_walk", {step: 100 * k + step / 1e4 for step in steps}, *kind)
        for k, (name, kind) in enumerate(kinds.items())
    }
    return made | {"alone": write_agent(tmp_path / "alone", "walker_run", {100_000: 1.0})}


@pytest.fixture
def fetched_curves(tmp_path):
    """Curves of two methods and two seeds on one task."""
    (tmp_path / "data").mkdir()
    for method, name in (("dreamer", "dreamer-curves.json"), ("dreamerv3", "dreamerv3-curves.json.gz")):
        curves = [
            {"task": "dmc_walker_walk", "method": method, "seed": seed, "xs": [5000, 405_000, 605_000], "ys": ys}
            for seed, ys in enumerate(([0, 10, 20], [20, 30, 40]))
        ]
        content = json.dumps(curves).encode()
        (tmp_path / "data" / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)


def test_seeds_meet_at_all_steps_that_all_have_reached():
    joined = join_seeds([pd.Series({10: 0.0, 30: 4.0}), pd.Series({10: 2.0, 20: 8.0, 40: 0.0})])

    assert joined.index.tolist() == [10, 20, 30]
    np.testing.assert_allclose(joined.mean(axis=1), [1, 5, 4])  # (0, 2), (2, 8), (4, 4)


def test_seeds_of_a_method_are_a_mean_and_a_range(tmp_path):
    folders = [
        write_agent(tmp_path / f"any-{seed}", "gymnasium:some_package:hike", {10: seed, 20: 3 + 2 * seed}, seed=seed)
        for seed in (0, 1)
    ]
    folders.append(write_agent(tmp_path / "gauss", "gymnasium:some_package:hike", {10: 7}, "GaussianBelief", 1))

    figure = only(draw_returns(folders), "returns")

    (axes,) = figure.axes
    assert axes.get_title() == "hike"  # the whole task would be cut off
    assert legend(figure) == ["FORBES, 2 seeds", "Dreamer"]
    mean = line(axes, "FORBES, 2 seeds")
    np.testing.assert_allclose(mean.get_xydata(), [[10, 0.5], [20, 4]])
    assert set(axes.collections[0].get_paths()[0].vertices[:, 1]) == {0, 1, 3, 5}
    assert to_hex(mean.get_color()) == METHODS["FORBES"].colour
    assert line(axes, "Dreamer").get_marker() == METHODS["Dreamer"].marker  # measured once
    assert figure.get_supxlabel() == "env steps (frames)"


def test_figure_6_has_the_papers_six_panels_and_says_which_have_no_run(agents):
    figure = only(draw_returns([agents["forbes"], agents["alone"]]), "returns")

    shown = panels(figure)
    assert list(shown) == list(PAPER_TASKS)
    empty = {task for task, axes in shown.items() if "no run" in [text.get_text() for text in axes.texts]}
    assert empty == {*PAPER_TASKS} - {"walker_walk", "walker_run"}
    assert all(axes.get_xlim() == (0, 1.02 * 500_000) for axes in figure.axes)


@pytest.mark.parametrize(("names", "tasks"), [(["forbes"], ["walker_walk"]), (["forbes", "alone"], PAPER_TASKS)])
def test_a_single_task_is_one_panel_and_the_whole_legend_is_seen(names, tasks, agents, fetched_curves):
    figure = only(draw_returns([agents[name] for name in names]), "returns")

    assert list(panels(figure)) == list(tasks)
    figure.canvas.draw()
    seen, whole = figure.legends[0].get_window_extent(), figure.bbox
    assert whole.x0 <= seen.x0 < seen.x1 <= whole.x1
    assert whole.y0 <= seen.y0 < seen.y1 <= whole.y1


def test_what_is_published_is_drawn_as_levels_and_dreamer_as_points(agents):
    figure = only(draw_returns([agents["forbes"], agents["alone"]]), "returns")

    shown = panels(figure)
    levels = {
        each.get_label(): each.get_ydata()[0] for each in shown["walker_walk"].lines if len(each.get_ydata()) == 2
    }
    assert levels.items() >= {
        ("PlaNet, published, 1M steps", 951.0),
        ("D4PG, published, 100M steps", 968.3),
        ("A3C, published, 100M steps", 311.0),
    }
    (points,) = shown["walker_run"].containers
    np.testing.assert_allclose(points[0].get_xydata(), [[500_000, 463.6]], atol=0.1)
    assert "PlaNet, published, 1M steps" not in [each.get_label() for each in shown["walker_run"].lines]  # has none
    assert legend(figure)[0] == "FORBES"


def test_fetched_curves_are_drawn_up_to_the_last_step(agents, fetched_curves):
    axes = panels(only(draw_returns([agents["forbes"]]), "returns"))["walker_walk"]

    for title in ("Dreamer", "DreamerV3"):
        curve = line(axes, f"{title}, published, 2 seeds")
        np.testing.assert_allclose(curve.get_xydata(), [[5000, 10], [405_000, 20]])
    assert not axes.containers


def test_the_appendix_goes_on_to_a_million_steps(agents):
    half = panels(only(draw_returns([agents["forbes"]]), "returns"))["walker_walk"]
    whole = panels(only(draw_returns_1m([agents["forbes"]]), "returns-1m"))["walker_walk"]

    assert line(half, "FORBES").get_xdata().tolist() == [100_000, 500_000]
    assert line(whole, "FORBES").get_xdata().tolist() == [100_000, 500_000, 900_000]
    assert whole.get_xlim()[1] == pytest.approx(1.02 * 900_000)


def test_other_tasks_are_drawn_to_their_end(agents, tmp_path):
    gym = write_agent(tmp_path / "gym", "gymnasium:Walk-v1", {1_000: 3, 2_000_000: 4_000})
    hike = write_agent(tmp_path / "hike", "mountain_hike", {10: -100, 20: -90})

    shown = panels(only(draw_returns([agents["forbes"], agents["alone"], gym, hike]), "returns"))

    assert list(shown) == [*PAPER_TASKS, "Walk-v1", "mountain_hike"]
    ends = {task: axes.get_xlim()[1] / 1.02 for task, axes in shown.items()}
    assert ends["Walk-v1"] == pytest.approx(2_000_000)
    assert ends["mountain_hike"] == pytest.approx(20)
    assert ends["walker_run"] == pytest.approx(500_000)


@pytest.mark.parametrize(
    ("draw", "name", "labels"),
    [
        (draw_trajectories, "trajectories", ["FORBES, N = 4", "Dreamer, N = 1", "Dreamer, N = 4"]),
        (draw_trajectories_n, "trajectories-n", ["FORBES, N = 4", "FORBES, N = 1"]),
        (draw_layers, "layers", ["Dreamer, 2 layers", "Dreamer, 3 layers", "FORBES"]),
    ],
)
def test_an_ablation_shows_what_it_compares_and_nothing_else(draw, name, labels, agents):
    figure = only(draw(list(agents.values())), name)

    assert legend(figure) == labels
    assert list(panels(figure)) == ["walker_walk"]  # there is nothing to compare on walker_run
    (axes,) = figure.axes
    assert len({to_hex(line(axes, label).get_color()) for label in labels}) == len(labels)


def test_methods_may_have_different_numbers_of_layers(tmp_path):
    """Only a method's own deeper variants belong to the ablation of layers."""
    flat = write_agent(tmp_path / "flat", "hop", {10: 1}, "GaussianBelief", 1, layers=1)
    deep = write_agent(tmp_path / "deep", "hop", {10: 2}, "FlowBelief", 4, layers=2)
    elsewhere = [
        write_agent(tmp_path / "one", "swim", {10: 1}, "GaussianBelief", 1, layers=3),
        write_agent(tmp_path / "four", "swim", {10: 2}, "GaussianBelief", 4, layers=3),
    ]

    figure = only(draw_trajectories([flat, deep, *elsewhere]), "trajectories")

    assert {name: len(axes.lines) for name, axes in panels(figure).items()} == {"hop": 2, "swim": 2}


def test_a_run_is_not_two_seeds(agents, tmp_path):
    twice = [agents["planet"], f"{agents['planet']}/"]

    for summarise in (partial(draw, "returns", folder=tmp_path), summarise_returns):
        with pytest.raises(ForbesError, match=r"is named twice\. Name each run once"):
            summarise(runs=twice)


def test_every_task_of_the_suite_has_its_scale(tmp_path):
    """Those without published returns, too."""
    runs = [
        write_agent(tmp_path / f"{task}-{belief}", task, {10: 1, 600_000: 2}, belief)
        for task in ("humanoid_walk", "walker_walk", "hop")
        for belief in ("FlowBelief", "GaussianBelief")
    ]

    assert {*DOMAINS} == {domain for domain, _ in suite.ALL_TASKS}
    control, other = summarise_returns(runs)
    assert "(humanoid_walk at 10, walker_walk at 10 env steps)" in control
    assert "(hop at 600,000 env steps)" in other


def test_the_first_variant_of_a_method_is_drawn_like_the_method():
    styles = variant_styles({"Dreamer, N = 1": "Dreamer", "FORBES": "FORBES", "Dreamer, N = 4": "Dreamer"})

    assert styles["FORBES"] == METHODS["FORBES"]
    assert styles["Dreamer, N = 1"] == METHODS["Dreamer"]
    assert styles["Dreamer, N = 4"].colour != METHODS["Dreamer"].colour
    assert styles["Dreamer, N = 4"].line != METHODS["Dreamer"].line


def test_the_summary_compares_at_the_last_common_step(tmp_path, capsys):
    """On tasks of one scale together, without a task that not all have."""
    runs = [
        write_agent(tmp_path / "f0", "walker_walk", {100: 0, 200: 100, 300: 900}),
        write_agent(tmp_path / "f1", "walker_walk", {100: 0, 300: 400}, seed=1),
        write_agent(tmp_path / "d0", "walker_walk", {100: 20, 200: 150}, "GaussianBelief"),
        write_agent(tmp_path / "f2", "walker_run", {100: 8}),
        write_agent(tmp_path / "d2", "walker_run", {100: 7}, "GaussianBelief"),
        write_agent(tmp_path / "f3", "finger_spin", {100: 8}),
    ]

    draw_returns(runs)

    out = capsys.readouterr().out
    assert "(walker_walk at 200, walker_run at 100 env steps)" in out
    assert f"FORBES   {(100 + 200 + 8) / 3:.2f} [" in out
    assert f"Dreamer  {(150 + 7) / 2:.2f} [78.50, 78.50], 2 runs" in out  # one seed each has no spread
    assert "P(FORBES > Dreamer) = 0.75 [0.50, 1.00]" in out  # (0 + 1)/2 + 1, over two tasks
    (title,) = summarise_returns(runs)
    assert title in out


def test_one_agent_is_not_summarised(agents, capsys):
    draw_returns([agents["forbes"]])

    assert capsys.readouterr().out == ""


def test_a_run_that_was_trained_is_drawn(small_agent, tmp_path, capsys):
    assert main(["figures", "returns", "--runs", str(small_agent), "-o", str(tmp_path / "figures")]) == 0

    assert capsys.readouterr().out.split() == [str(tmp_path / f"figures/returns.{kind}") for kind in ("png", "pdf")]


def test_what_cannot_be_drawn_is_one_sentence(agents, tmp_path, capsys):
    world = write_run(tmp_path / "world", "WorldModel", "FlowBelief", "Strokes", {}, [{"update": 1}])
    apart, late = (
        [write_agent(tmp_path / f"{task}-{seed}", task, {10 + seed: 3}, seed=seed) for seed in (0, 1)]
        for task in ("hop", "walker_run")
    )
    for name, runs, sentence in [
        ("returns", [str(tmp_path / "absent")], "absent: not a run folder, config.yaml is missing"),
        ("returns", [world], "metrics.jsonl has no return/acting"),
        ("returns", apart, "FORBES on hop: no step was reached by all its 2 seeds. Train them further"),
        ("returns", late, "FORBES on walker_run: no step up to 500,000 was reached by all its 2 seeds. Train them"),
        ("layers", [agents["planet"]], "--runs: none is an agent of Dreamer with N = 1, or FORBES with N = 4"),
        ("trajectories-n", [agents["dreamer"]], "--runs: none is an agent of FORBES, which this figure compares"),
    ]:
        assert main(["figures", name, "--runs", *runs, "-o", str(tmp_path / "figures")]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert error.count("\n") == 1
    assert not (tmp_path / "figures").exists()


def test_a_figure_of_no_return_raises(tmp_path):
    with pytest.raises(ForbesError, match="has no return/acting"):
        draw_returns([write_agent(tmp_path / "run", "hop", {})])
