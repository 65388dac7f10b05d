"""What `forbes fit` prints at its end: commands that exist, for the kind of model that was trained."""

import importlib
import shlex
from pathlib import Path

import pytest
from lightning import LightningModule

from forbes.commands.next_steps import next_steps
from forbes.runs.folder import RunFolder
from forbes.training import ImaginationActorCritic, KnownBelief, PlanningAgent, WorldModel

COMMANDS = {
    WorldModel: ["runs", "evaluate", "figures"],
    ImaginationActorCritic: ["runs", "evaluate", "rollout"],
    PlanningAgent: ["runs", "evaluate", "rollout"],
    KnownBelief: ["runs", "beliefs"],
    LightningModule: ["runs"],
}


@pytest.mark.parametrize("kind", COMMANDS, ids=lambda kind: kind.__name__)
def test_a_run_that_ended_says_where_it_is_and_what_is_next(kind, in_tmp_path):
    Path("my run").mkdir()  # the parsers refuse a run that does not exist
    where, *commands = next_steps(RunFolder("my run"), object.__new__(kind)).splitlines()

    assert where == "trained: 'my run'. Next:"
    words = [shlex.split(command) for command in commands]
    assert [word[:2] for word in words] == [["forbes", name] for name in COMMANDS[kind]]
    for _, name, *arguments in words:
        assert "my run" in arguments
        importlib.import_module(f"forbes.commands.parsers.{name}").parser().parse_args(arguments)
