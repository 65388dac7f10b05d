"""Kinds of files that forbes reads, and damage done to them."""

import dataclasses
import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from small_strokes import write_strokes

from forbes.data.episodes.store import EpisodeStore
from forbes.data.strokes.file import load_strokes
from forbes.errors import ForbesError
from forbes.evaluation.published import published_curves
from forbes.evaluation.record import read_arrays, read_record
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import read_config, read_metrics
from forbes.runs.provenance import read_provenance
from forbes.runs.saving import AtomicCheckpointIO

__all__ = ["KINDS", "TYPES", "damaged", "read_or_sentence"]

ENTRY = {
    "mean": -1.5,
    "standard_error": 0.5,
    "per_step": {"mean": -0.5, "standard_error": 0.1},
    "curve": [-0.5, -1.0],
    "sequences": 2,
    "seed": 0,
    "checkpoint": "0" * 64,
    "data": {"name": "Strokes", "sha256": "1" * 64},
    "references": {"frequency": {"mean": -3.0, "standard_error": 0.5}},
}
EPISODE = {
    **{"number": 0, "steps": 3, "frames": 6, "total_reward": 1.5, "terminated": False, "seed": 7, "policy": "random"},
    **{"environment": {"task": "Parrot", "observation_shape": [2], "action_dim": 1, "discrete": False}},
    **{"size": 100, "sha256": "0" * 64},
}
INDEX = [EPISODE, EPISODE | {"number": 1}, {"quarantined": 0}, {"set_aside_from": 1}, {"forgotten_before": 1}]
INDEX += [{"compacted": {"watermark": 2, "first": 1, "forgotten_steps": 3, "forgotten_frames": 6}}]
CONFIG = """\
seed_everything: 0
model:
  class_path: forbes.training.WorldModel
  init_args:
    belief: {class_path: forbes.beliefs.FlowBelief, init_args: {layers: 2}}
    state_dim: 2
data:
  class_path: forbes.data.SequenceDataModule
  init_args: {batch_size: 4, length: 6}
"""
TYPES = ["", "null", "[]", "3", '""', "true", '{"": null}', "[[1], 2]", "1e999", "NaN"]
"""What can stand in the place of a whole file or of a value."""


@dataclasses.dataclass
class Kind:
    """A kind of file: how it is written whole, and read."""

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]


def write_lines(path, lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def write_checkpoint(path):
    content = {"state_dict": {"a": torch.arange(30.0), "b": torch.ones(2, 3)}, "global_step": 3, "loops": {"n": [1]}}
    AtomicCheckpointIO().save_checkpoint(content, path)


def write_arrays(path):
    np.savez(path, **{"test/elbo[S=2]": np.arange(5.0), "test/kl[S=2]": np.ones(5)})


KINDS = [
    Kind("strokes.npz", write_strokes, lambda path: load_strokes(path, "Rebuild it")),
    Kind("config.yaml", lambda path: path.write_text(CONFIG), read_config),
    Kind("last.ckpt", write_checkpoint, read_checkpoint),
    Kind("evaluation.npz", write_arrays, lambda path: read_arrays(path.parent)),
    Kind(
        "evaluation.json",
        lambda path: path.write_text(json.dumps({"test/elbo[S=2]": ENTRY}, indent=1)),
        lambda path: read_record(path.parent),
    ),
    Kind(
        "metrics.jsonl",
        lambda path: write_lines(path, [{"update": n, "epoch": 0, "train/elbo": -1.5 * n} for n in range(9)]),
        lambda path: read_metrics(path.parent),
    ),
    Kind("index.jsonl", lambda path: write_lines(path, INDEX), lambda path: EpisodeStore(path.parent)),
    Kind(
        "provenance.json",
        lambda path: path.write_text(json.dumps([{"command": "forbes fit", "versions": {"torch": "2"}}])),
        read_provenance,
    ),
    Kind(
        "curves.json",
        lambda path: write_lines(path, [[{"task": "t", "method": "m", "seed": 0, "xs": [0, 5], "ys": [1.5, 2]}]]),
        lambda path: published_curves(str(path), "t"),
    ),
    Kind(
        "curves.json.gz",
        lambda path: path.write_bytes(gzip.compress(b'[{"task": "t", "method": "m", "xs": [0, 5], "ys": [1.5, 2]}]')),
        lambda path: published_curves(str(path), "t"),
    ),
]


def damaged(content, generator):
    """Change some bytes, cut some out or off, repeat some, or put a value of another type in the place of one."""
    place, size = generator.randrange(len(content) + 1), generator.choice([1, 1, 2, 8, 64])
    before, there, after = content[:place], content[place : place + size], content[place + size :]
    return generator.choice(
        [
            lambda: before + bytes(byte ^ (1 << generator.randrange(8)) for byte in there) + after,
            lambda: before + generator.randbytes(len(there)) + after,
            lambda: before + after,
            lambda: before,
            lambda: before + there + there + after,
            lambda: before + generator.choice(TYPES).encode() + after,
            lambda: generator.choice(TYPES).encode() + b"\n",
            lambda: (
                before + generator.choice([b"{", b"[", b'"', b",", b":", b"-", b"\n", b"\x00", b"\xff"]) + there + after
            ),
        ]
    )()


def read_or_sentence(read, path):
    """Read a file; an error is one sentence of ours, no longer than one reads."""
    try:
        read(path)
    except ForbesError as error:
        sentence = str(error).replace(str(path.parent), "")
        assert "\n" not in sentence
        assert len(sentence) < 300
        return sentence
