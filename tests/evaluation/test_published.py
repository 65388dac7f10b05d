"""The bundled table of published numbers, against the files that it was made from."""

import gzip
import json
from pathlib import Path

import pandas as pd
import pytest

from forbes.data.download import curves_paths
from forbes.errors import ForbesError
from forbes.evaluation import published
from forbes.evaluation.published import SPREAD, at_step, published_curves, published_numbers, published_returns

EXCERPT = Path(__file__).with_name("dreamer_excerpt.json")
"""Points around 500,000 and 1,000,000 env steps of two tasks of danijar/dreamer's scores/dreamer.json (MIT licence)."""
TASKS = ("cartpole_swingup", "finger_spin", "cheetah_run", "walker_walk", "walker_run", "hopper_stand")


def of_dreamer(task, step, metric):
    table = published_numbers().set_index(["task", "method", "env_steps", "metric"])
    return table.loc[(task, "Dreamer", step, metric), "value"]


def rows_of_dreamer(tasks):
    return [(task, step) for task in tasks for step in (500_000, 1_000_000)]


@pytest.mark.parametrize(("task", "step"), rows_of_dreamer(("cartpole_swingup", "hopper_stand")))
def test_dreamers_rows_are_its_curves_at_their_nearest_points(task, step):
    mean, spread = at_step(published_curves(str(EXCERPT), task)["dreamer"], step)

    assert of_dreamer(task, step, "return") == pytest.approx(mean, abs=0.05 + 1e-9)  # one decimal
    assert of_dreamer(task, step, SPREAD) == pytest.approx(spread, abs=0.05 + 1e-9)


@pytest.mark.skipif(not curves_paths()[0].is_file(), reason="needs `forbes data fetch curves`")
@pytest.mark.parametrize(("task", "step"), rows_of_dreamer(TASKS))
def test_dreamers_rows_are_those_of_the_fetched_curves(task, step):
    mean, spread = at_step(published_curves(None, task)["dreamer"], step)

    assert of_dreamer(task, step, "return") == pytest.approx(mean, abs=0.05 + 1e-9)
    assert of_dreamer(task, step, SPREAD) == pytest.approx(spread, abs=0.05 + 1e-9)


def test_the_episodes_of_one_evaluation_are_one_point_of_a_compressed_file(tmp_path):
    episodes = {"xs": [8002, 8006, 16_000, 24_000], "ys": [1, 3, 5, 7]}
    path = tmp_path / "curves.json.gz"
    path.write_bytes(
        gzip.compress(json.dumps([{"task": "dmc_x", "method": "dreamerv3", "seed": 0} | episodes]).encode())
    )

    (curve,) = published_curves(str(path), "x")["dreamerv3"]

    assert dict(curve) == {8004: 2, 16_000: 5, 24_000: 7}


def test_a_step_between_two_points_is_that_of_the_nearer_one():
    curves = [pd.Series({0: 0.0, 10: 1.0, 20: 2.0}), pd.Series({0: 4.0, 12: 5.0})]

    assert at_step(curves, 11) == pytest.approx((3.0, 8**0.5))  # 1 and 5


def test_the_baselines_are_those_of_the_papers_table():
    """The means over 18 tasks are printed on Dreamer's poster: 243 for A3C, 786 for D4PG."""
    table = published_numbers()
    means = table[table["metric"] == "return"].groupby("method")["value"].agg(["mean", "size"])

    assert means.loc["A3C"].tolist() == [pytest.approx(243.7, abs=0.01), 18]
    assert means.loc["D4PG"].tolist() == [pytest.approx(786.33, abs=0.01), 18]


def test_every_number_has_task_steps_unit_and_source():
    table = published_numbers()

    required = ["task", "method", "env_steps", "metric", "value", "unit", "source"]
    assert list(table.columns) == [*required[:6], "seeds", "source", "note"]
    assert not table[required].isna().any(axis=None)
    assert not table.duplicated(["task", "method", "env_steps", "metric"]).any()
    assert set(TASKS) <= set(table["task"])
    returns = table[table["metric"] == "return"]
    assert returns["value"].between(0, 1000).all()


def test_tasks_have_our_names():
    suite = pytest.importorskip("dm_control.suite")
    table = published_numbers()

    assert set(table[table["metric"] == "return"]["task"]) <= {f"{domain}_{task}" for domain, task in suite.ALL_TASKS}


def test_a_task_has_its_numbers_with_their_spread():
    table = published_returns("walker_run").set_index(["method", "env_steps"])

    assert table.loc[("D4PG", 100_000_000), "value"] == 567.2
    assert table.loc[("Dreamer", 1_000_000), ["value", "spread"]].tolist() == [718.0, 49.7]
    assert published_returns("mountain_hike").empty


@pytest.mark.parametrize(("content", "sentence"), [(None, "no such file"), (b"task\n", "truncated or not a table")])
def test_a_damaged_table_is_one_sentence(content, sentence, tmp_path, monkeypatch):
    path = tmp_path / "published.csv"
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setattr(published, "published_path", lambda: path)

    with pytest.raises(ForbesError, match=f"published.csv: {sentence}"):
        published_numbers()


def test_the_excerpt_is_small():
    assert len(json.loads(EXCERPT.read_text())) == 10
    assert EXCERPT.stat().st_size < 3000
