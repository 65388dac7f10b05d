"""The index of a store: bounded, restored where it is lost, and never at odds with the files for want of one line."""

import json
import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from forked import run_in_a_fork

from forbes.commands.cli import main
from forbes.data import Replay
from forbes.data.episodes.episode import DamagedEpisodeError, Episode
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.errors import ForbesError

ENVIRONMENT = {"task": "Counting", "observation_shape": [2], "action_dim": 1, "discrete": False}


def append(writer, steps=5):
    """Every observation says (number, time)."""
    time = np.arange(steps + 1, dtype=np.float32)
    observation = np.stack([np.full_like(time, writer.watermark), time], 1)
    whole = Episode(observation, time[:, None] / 100, time, terminated=False, frames=2 * steps)
    return writer.append(whole, seed=1, policy="test", environment=ENVIRONMENT)


@pytest.fixture
def store(tmp_path):
    """The path of a store of four episodes, of which the first is forgotten."""
    with EpisodeWriter(tmp_path / "store") as writer:
        for _ in range(4):
            append(writer)
        writer.forget(1)
    return tmp_path / "store"


@dataclass
class Said:
    """All that a store says of itself."""

    records: dict
    watermark: int
    forgotten: tuple

    @classmethod
    def by(cls, path):
        index = EpisodeStore(path).index
        return cls(index.records, index.watermark, (index.first, index.forgotten_steps, index.forgotten_frames))


def whole(path):
    """The numbers of the episodes that are there and hold what they must."""
    opened = EpisodeStore(path)
    assert all((opened.episode(number).observation[:, 0] == number).all() for number in opened.records)
    return list(opened.records)


def test_the_index_of_a_store_with_a_capacity_does_not_grow(tmp_path, monkeypatch):
    monkeypatch.setattr("forbes.data.episodes.index._SPARE", 6)
    sizes = []
    with EpisodeWriter(tmp_path) as writer:
        for _ in range(100):
            append(writer)
            writer.forget(writer.watermark - 3)
            sizes.append(len((tmp_path / "index.jsonl").read_text().splitlines()))
            assert Said.by(tmp_path) == Said(
                writer.records, writer.watermark, (writer.index.first, 5 * writer.index.first, 10 * writer.index.first)
            )

    assert max(sizes) <= 2 * 3 + 6 + 2
    assert whole(tmp_path) == [97, 98, 99]


def test_a_compacted_index_says_the_same(store):
    with EpisodeWriter(store) as writer:
        writer.quarantine(3)
        before = Said.by(store)
        writer.index.compact()

    assert Said.by(store) == before
    assert before.watermark == 4  # though its last episode is gone
    with EpisodeWriter(store) as writer:
        assert append(writer).number == 4


def at_each_sync(store, monkeypatch, act):
    """Compact an index and act before every step of it that reaches the disk."""

    def acting(step):
        return lambda *arguments: (act(), step(*arguments))[1]

    monkeypatch.setattr(os, "fsync", acting(os.fsync))
    monkeypatch.setattr(Path, "replace", acting(Path.replace))
    with EpisodeWriter(store) as writer:
        writer.index.compact()
    monkeypatch.undo()


def test_a_reader_sees_the_same_throughout_a_compaction(store, monkeypatch):
    before, seen = Said.by(store), []
    at_each_sync(store, monkeypatch, lambda: seen.append(Said.by(store)))

    assert seen == [before] * 3  # the file is synced, renamed, and its folder synced
    assert Said.by(store) == before


@pytest.mark.parametrize("when", [1, 2, 3])
def test_a_kill_while_the_index_is_compacted_loses_nothing(store, monkeypatch, when):
    before, calls = Said.by(store), []

    def kill():
        calls.append(1)
        if len(calls) == when:
            os.kill(os.getpid(), signal.SIGKILL)

    assert run_in_a_fork(at_each_sync, store, monkeypatch, kill) == -signal.SIGKILL
    assert Said.by(store) == before
    with EpisodeWriter(store) as writer:
        append(writer)
    assert whole(store) == [1, 2, 3, 4]
    assert not [path for path in store.iterdir() if path.name.startswith(".index")]


@pytest.mark.parametrize("line", range(5))
def test_a_line_repeated_at_the_end_overwrites_no_episode(store, line):
    index, before = store / "index.jsonl", Said.by(store)
    lines = index.read_text().splitlines()
    assert len(lines) == 5
    index.write_text("\n".join([*lines, lines[line]]) + "\n")

    assert Said.by(store) == before
    with EpisodeWriter(store) as writer:
        assert append(writer).number == 4
    assert whole(store) == [1, 2, 3, 4]


def test_a_line_repeated_after_resuming_overwrites_no_episode(store):
    index = store / "index.jsonl"
    with EpisodeWriter(store) as writer:
        writer.set_aside(2)
        append(writer)
    for line in index.read_text().splitlines():
        index.write_text(index.read_text() + line + "\n")

    assert whole(store) == [1, 2]
    with EpisodeWriter(store) as writer:
        append(writer)
    assert whole(store) == [1, 2, 3]


LOST = {
    "missing": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "zeros at its end": lambda path: path.write_bytes(path.read_bytes()[:600].ljust(path.stat().st_size, b"\0")),
}


@pytest.mark.parametrize("how", LOST)
def test_a_lost_index_is_rebuilt_from_episodes_with_a_warning(tmp_path, how, capsys):
    with EpisodeWriter(tmp_path) as writer:
        records = {number: append(writer) for number in range(4)}
    LOST[how](tmp_path / "index.jsonl")

    with EpisodeWriter(tmp_path) as writer:
        assert writer.records == records
        assert append(writer).number == 4

    said = capsys.readouterr().err
    assert f"WARNING: {tmp_path / 'index.jsonl'}: lost or overwritten with zeros" in said
    assert said.count("\n") == 1
    assert whole(tmp_path) == [0, 1, 2, 3, 4]
    with EpisodeWriter(tmp_path):
        assert not capsys.readouterr().err


def test_what_cannot_restore_a_lost_index_is_moved_and_counted(store, capsys):
    (store / "000002.npz").write_bytes(b"damaged")
    (store / "000001.npz").rename(store / "000007.npz")
    (store / "index.jsonl").unlink()

    with EpisodeWriter(store) as writer:
        assert list(writer.records) == [3]

    assert "; 1 of 3 episodes are restored" in capsys.readouterr().err
    assert sorted(path.name for path in (store / "set_aside").iterdir()) == ["000002.npz", "000007.npz"]


def test_a_reader_of_a_lost_index_says_how_it_is_rebuilt(store, capsys):
    (store / "index.jsonl").unlink()
    with pytest.raises(ForbesError, match=r"lost, but there are the files of 3 .*: forbes data check .*store$"):
        Replay(str(store))

    assert main(["data", "check", str(store)]) == 0

    assert "3 episodes read, 3 intact" in capsys.readouterr().out
    assert whole(store) == [1, 2, 3]


def test_a_new_store_is_no_lost_one(tmp_path, capsys):
    with EpisodeWriter(tmp_path):
        pass
    assert not capsys.readouterr().err


WRONG = {
    "number": [-1, 1.5, True, "1", 2**70],
    "steps": [0, -3, None],
    "total_reward": [float("nan"), float("inf"), "1", None],
    "terminated": [0, None],
    "policy": [3],
    "sha256": [None],
    "environment": [[], "x"],
}
OF_ENVIRONMENT = {
    "task": [3, None],
    "observation_shape": [[], [2, 2], [-1], "2", [2.0], None, 2],
    "action_dim": [0, "1", None],
    "discrete": [0, None, [3, 2], [1], [], [0, 1], [True, 0], "x"],
    "made_by": ["that", None],
}
CHANGES = [({name: value}, name) for name, values in WRONG.items() for value in values]
CHANGES += [
    ({"environment": ENVIRONMENT | {name: value}}, name) for name, values in OF_ENVIRONMENT.items() for value in values
]
CHANGES += [
    ({"environment": {key: value for key, value in ENVIRONMENT.items() if key != name}}, name) for name in ENVIRONMENT
]


@pytest.mark.parametrize(("change", "name"), CHANGES)
def test_a_line_whose_values_cannot_be_is_one_sentence(store, change, name):
    index = store / "index.jsonl"
    lines = index.read_text().splitlines()
    lines[2] = json.dumps(json.loads(lines[2]) | change)
    index.write_text("\n".join(lines) + "\n")

    sentence = rf"index\.jsonl: line 3 is not a line of the index \(it.* {'step' if name == 'steps' else name}"
    with pytest.raises(ForbesError, match=sentence):
        EpisodeStore(store)


def test_a_line_of_another_environment_is_one_sentence(store):
    index = store / "index.jsonl"
    lines = index.read_text().splitlines()
    lines[3] = lines[3].replace('"action_dim": 1', '"action_dim": 2')
    index.write_text("\n".join(lines) + "\n")

    with pytest.raises(ForbesError, match=r"line 4 is not .*\(its action_dim is not that of the previous episodes\)"):
        EpisodeStore(store)


def test_a_line_that_is_not_of_its_file_is_damage(store):
    """Lines of other shapes or lengths than the files: drawn from, they would be errors of numpy."""
    index, text = store / "index.jsonl", (store / "index.jsonl").read_text()
    for old, new, problem in (
        ('"steps": 5', '"steps": 7', r"it has 5 steps, expected 7"),
        ('"observation_shape": [2]', '"observation_shape": [3]', r"its environment's observation_shape is \[3\]"),
    ):
        index.write_text(text.replace(old, new))
        opened = EpisodeStore(store)
        with pytest.raises(DamagedEpisodeError, match=problem):
            opened.episode(1)
