"""The round trip of a flow: what is measured, on which beliefs, and how it is told."""

import json
import math
import shutil

import pytest
import torch
from small_models import make_model, random_model, sequences

from forbes.beliefs import FlowBelief
from forbes.commands.cli import main
from forbes.data import SequenceBatch
from forbes.evaluation.round_trip import LIMIT, model_round_trip, print_round_trip, round_trip


def batch():
    observation, action, mask = sequences()
    return SequenceBatch(observation, action, torch.zeros(mask.shape), mask, torch.zeros(*mask.shape, 0), ~mask)


def wild(dim=4, layers=5):
    """A flow whose mixing layers shrink one dimension a thousand times each."""
    torch.manual_seed(0)
    belief = FlowBelief(dim, 3, layers, width=8)
    with torch.no_grad():
        for mixing in belief.flow.mixings:
            mixing.raw_diagonal[0] = -20
            mixing.bias += 1
    return belief


def test_a_flow_in_float64_comes_back():
    found = model_round_trip(random_model("flow"), batch(), seed=0)

    assert set(found) == {"prior", "posterior"}
    assert all(0 <= error < 1e-10 for errors in found.values() for error in errors.values())


def test_a_flow_that_has_lost_its_inverse_is_found_out():
    """Four factors of 1e-3 leave nothing of float32 beside a shift of 1, and 1e-4 of float64."""
    context = torch.randn(100, 3, generator=torch.Generator().manual_seed(0))
    belief = wild()

    single = round_trip(belief, context)
    double = round_trip(belief.double(), context.double())

    assert single["log_prob"] > 1
    assert double["log_prob"] < LIMIT < single["state"]


@pytest.mark.parametrize(
    ("kind", "heads"),
    [
        ("flow in the prior", {"prior"}),
        ("flow in the posterior", {"posterior"}),
        ("spline flow", {"prior", "posterior"}),
        ("particles", set()),
        ("mixture", set()),
        ("vector", set()),
    ],
)
def test_only_flows_are_measured(kind, heads):
    assert set(model_round_trip(make_model(kind), batch(), seed=0)) == heads


@pytest.mark.parametrize(("error", "loud"), [(LIMIT / 2, False), (2 * LIMIT, True), (math.nan, True)])
def test_a_disagreement_above_the_limit_is_told_loudly(capsys, error, loud):
    print_round_trip("runs/one", {"prior": {"state": 0.0, "log_prob": error}})

    said = capsys.readouterr()
    assert "runs/one: prior flow, round trip" in said.err
    assert ("WARNING: runs/one" in said.err) == loud


def test_evaluate_records_the_round_trip_of_a_flow(tiny_run, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)

    assert main(["evaluate", str(run), "--scores", "elbo", "--samples", "2"]) == 0

    entry = json.loads((run / "evaluation.json").read_text())["test/round_trip"]
    assert {*entry} == {"prior", "posterior", "sequences", "seed", "checkpoint"}
    assert entry["posterior"]["log_prob"] < LIMIT
    assert "posterior flow, round trip" in capsys.readouterr().err
