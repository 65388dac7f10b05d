"""What a training that was interrupted and continued must leave."""

import json

import pandas as pd
import torch

from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics

__all__ = ["assert_same_run", "starts"]


def assert_same_run(one, other):
    """Compare metrics, weights and moments of two runs bit for bit."""
    pd.testing.assert_frame_equal(read_metrics(one), read_metrics(other), check_exact=True)
    state, expected = (read_checkpoint(RunFolder(run).checkpoint) for run in (one, other))
    assert state["global_step"] == expected["global_step"]
    for part in ("state_dict", "optimizer_states"):
        torch.testing.assert_close(state[part], expected[part], rtol=0, atol=0)


def starts(run):
    """Return the update at which each start of a run began."""
    lines = map(json.loads, (run / "metrics.jsonl").read_text().splitlines())
    return [line["update"] for line in lines if line.get("start")]
