"""Damaged files: every reader returns what it can read or says one sentence, whatever the bytes are."""

import dataclasses
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from forbes.cli import main
from forbes.data.episode_store import EpisodeStore
from forbes.data.stroke_file import load_strokes
from forbes.errors import ForbesError
from forbes.evaluation.record import read_arrays, read_record
from forbes.figures.returns import published_curves
from forbes.training.checkpoint import AtomicCheckpointIO, read_checkpoint
from forbes.training.provenance import read_provenance
from forbes.training.run_folder import read_config, read_metrics

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


@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
@pytest.mark.filterwarnings("ignore")  # of a parser, on bytes it was not made for
def test_a_damaged_file_is_read_or_one_sentence(kind, tmp_path):
    path, generator = tmp_path / kind.name, random.Random(0)
    kind.write(path)
    whole = path.read_bytes()
    assert read_or_sentence(kind.read, path) is None

    sentences = set()
    for _ in range(300):
        path.write_bytes(damaged(whole, generator))
        sentences.add(read_or_sentence(kind.read, path))

    assert len(sentences) > 2


@pytest.mark.filterwarnings("ignore")
def test_a_damaged_stroke_file_is_read_or_one_sentence(strokes_file, tmp_path):
    path, whole, generator = tmp_path / "strokes.npz", strokes_file.read_bytes(), random.Random(0)
    for _ in range(300):
        path.write_bytes(damaged(whole, generator))
        read_or_sentence(lambda path: load_strokes(path, "Rebuild it"), path)


@pytest.mark.filterwarnings("ignore")
def test_a_damaged_configuration_is_read_or_one_sentence(tiny_run, tmp_path):
    path, whole, generator = tmp_path / "config.yaml", (tiny_run / "config.yaml").read_bytes(), random.Random(0)
    for _ in range(60):
        path.write_bytes(damaged(whole, generator))
        read_or_sentence(read_config, path)


CONFIGURATIONS = [
    b"",
    b"\xff\xfe\x00",
    b"[1, 2]",
    b"model: 3\ndata: 4\n",
    b"? [a]\n: 1\n",
    b"a: 2001-99-99\n",
    b"model: {class_path: WorldModel, init_args: 3}\ndata: {class_path: SequenceDataModule}\n",
    b"model: {class_path: ''}\ndata: {class_path: SequenceDataModule}\n",
]


@pytest.mark.parametrize("content", CONFIGURATIONS)
@pytest.mark.parametrize("command", ["evaluate", "resume", "config"])
def test_a_configuration_of_another_kind_is_one_sentence(command, content, tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    (run / "config.yaml").write_bytes(content)
    arguments = {
        "evaluate": ["evaluate", str(run)],
        "resume": ["fit", "--resume", str(run)],
        "config": ["fit", "--config", str(run / "config.yaml"), "--run_dir", str(tmp_path / "new")],
    }

    assert main(arguments[command]) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("forbes: ")
    assert len(line.replace(str(tmp_path), "")) < 300


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("class_path: forbes.beliefs.FlowBelief", "class_path: ''"),
        ("layers: 2", "layers: -3"),
        ("width: 8", "width: -1"),
    ],
)
def test_an_error_inside_a_named_class_is_one_sentence(old, new, tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    text = (run / "config.yaml").read_text()
    assert old in text
    (run / "config.yaml").write_text(text.replace(old, new))

    for arguments in (["evaluate", str(run)], ["fit", "--resume", str(run)]):
        assert main(arguments) == 2
        *_, line = capsys.readouterr().err.splitlines()
        assert line.startswith("forbes: ")
        assert len(line.replace(str(tmp_path), "")) < 300


@pytest.mark.parametrize("content", [b"", b"\xff", b"3", b'{"a": 1}', b"[1]"])
def test_a_broken_provenance_is_said_before_a_training_goes_on(content, tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    (run / "provenance.json").write_bytes(content)

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 2

    assert "provenance.json: " in capsys.readouterr().err
    assert (run / "provenance.json").read_bytes() == content


@pytest.mark.parametrize("name", ["evaluation.json", "evaluation.npz"])
def test_a_broken_record_is_said_before_anything_is_measured(name, tiny_run, tmp_path, monkeypatch, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    (run / name).write_bytes(b"PK\x03\x04")
    monkeypatch.setattr("forbes.evaluation.commands.load_runs", lambda *_: pytest.fail("measured"))

    assert main(["evaluate", str(run)]) == 2

    assert f"{name}: truncated or not" in capsys.readouterr().err
