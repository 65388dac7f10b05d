"""The episode store: what was stored stays whole, whatever happens to the process, the disk or a file."""

import errno
import hashlib
import json
import os
import signal
import time

import numpy as np
import pytest
from forked import run_in_a_fork

from forbes.data.episodes.episode import DamagedEpisodeError, Episode, map_episode, stamp_of
from forbes.data.episodes.index import first_held
from forbes.data.episodes.replay import Replay
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.errors import ForbesError

ENVIRONMENT = {"task": "Counting", "observation_shape": [2], "action_dim": 1, "discrete": False}
ENVIRONMENT["made_by"] = {"machine": "this"}


def episode(number, steps=5):
    """Every observation says (number, time); the action and the reward that led there are number + time / 100."""
    time = np.arange(steps + 1, dtype=np.float32)
    observation = np.stack([np.full_like(time, number), time], 1)
    reward = np.where(time > 0, number + time / 100, 0).astype(np.float32)
    return Episode(observation, reward[:, None].copy(), reward, terminated=False, frames=2 * steps)


def append(writer, number=None, **changes):
    number = writer.watermark if number is None else number
    return writer.append(episode(number), **{"seed": 1, "policy": "test", "environment": ENVIRONMENT, **changes})


@pytest.fixture
def store(tmp_path):
    """The path of a store of three episodes."""
    with EpisodeWriter(tmp_path / "store") as writer:
        for _ in range(3):
            append(writer)
    return tmp_path / "store"


def numbers(path):
    """The episodes of a store that are there and hold what they must."""
    opened = EpisodeStore(path)
    for number in opened.records:
        assert_is(opened.episode(number), number)
    return list(opened.records)


def assert_is(found, number, steps=5):
    for ours, theirs in zip(found, episode(number, steps), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_what_was_stored_is_there(store):
    opened = EpisodeStore(store)

    assert numbers(store) == [0, 1, 2]
    assert opened.watermark == 3
    record = opened.records[2]
    assert (record.steps, record.frames, record.seed, record.policy) == (5, 10, 1, "test")
    assert record.total_reward == pytest.approx(10.15, abs=1e-5)
    assert record.environment == ENVIRONMENT


def test_any_tool_can_read_an_episode(store):
    with np.load(store / "000001.npz") as file:
        about = json.loads(file["meta"].item())
        np.testing.assert_array_equal(file["observation"], episode(1).observation)
        assert set(file) == {"observation", "action", "reward", "meta"}
    assert (about["number"], about["environment"]["task"]) == (1, "Counting")


def test_the_same_episodes_are_the_same_bytes(store, tmp_path):
    with EpisodeWriter(tmp_path / "again") as writer:
        for _ in range(3):
            append(writer)
    for name in ("index.jsonl", "000000.npz", "000002.npz"):
        assert (tmp_path / "again" / name).read_bytes() == (store / name).read_bytes()


def test_a_reader_sees_added_episodes_after_a_refresh(store):
    reader = EpisodeStore(store)
    with EpisodeWriter(store) as writer:
        append(writer)

    assert list(reader.records) == [0, 1, 2]
    reader.refresh()
    assert list(reader.records) == [0, 1, 2, 3]
    assert_is(reader.episode(3), 3)


def steps_of(opened, number):
    """The episode as `EpisodeStore.read` gives it."""
    record = opened.records[number]
    arrays = [np.empty((record.steps + 1, *shape), np.float32) for shape in ((2,), (1,), ())]
    opened.read(number, 0, arrays)
    return Episode(*arrays, record.terminated, record.frames)


def test_reading_keeps_no_file_open(store):
    with EpisodeWriter(store) as writer:
        for _ in range(9):
            append(writer)
    opened, before = EpisodeStore(store), os.listdir("/proc/self/fd")
    opened.verify(opened.records)
    for number in (*range(12), *range(12)):
        assert_is(steps_of(opened, number), number)

    assert os.listdir("/proc/self/fd") == before
    assert not mapped_files(store)


def test_two_processes_never_write_to_one_store(store):
    with (
        EpisodeWriter(store),
        pytest.raises(ForbesError, match=r"process \d+ on .* writes episodes here"),
        EpisodeWriter(store),
    ):
        pass
    with EpisodeWriter(store):  # it is free again
        pass


def kill_at_sync(path, when):
    """Append two episodes and be killed at the n-th time that something is synced to the disk."""
    calls, sync = [], os.fsync

    def fsync(descriptor):
        calls.append(1)
        if len(calls) == when:
            os.kill(os.getpid(), signal.SIGKILL)
        sync(descriptor)

    with EpisodeWriter(path) as writer:
        os.fsync = fsync
        append(writer)
        append(writer)


@pytest.mark.parametrize("when", range(1, 7))  # an episode is synced, its folder, and the index
def test_a_kill_while_writing_leaves_whole_episodes_only(store, when):
    assert run_in_a_fork(kill_at_sync, store, when) == -signal.SIGKILL

    left = numbers(store)
    assert left in ([0, 1, 2], [0, 1, 2, 3], [0, 1, 2, 3, 4])
    with EpisodeWriter(store) as writer:
        assert list(writer.records) == left
        append(writer)
    assert numbers(store) == [*left, len(left)]
    stored = {f"{number:06d}.npz" for number in numbers(store)}
    assert {path.name for path in store.iterdir()} - {".lock", "index.jsonl", "set_aside"} == stored


def test_half_a_line_of_the_index_is_no_episode(store):
    whole = (store / "index.jsonl").read_bytes()
    (store / "index.jsonl").write_bytes(whole[:-20])

    assert numbers(store) == [0, 1]
    with EpisodeWriter(store) as writer:
        append(writer)
    assert numbers(store) == [0, 1, 2]
    assert (store / "set_aside" / "000002.npz").is_file()  # whole, but its line was not


@pytest.mark.parametrize(("when", "name"), [(1, "000003.npz"), (2, "000003.npz"), (3, "index.jsonl")])
def test_a_full_disk_leaves_the_store_as_it_was(store, when, name, monkeypatch):
    calls, sync, index = [], os.fsync, (store / "index.jsonl").read_bytes()

    def fsync(descriptor):
        calls.append(1)
        if len(calls) == when:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with EpisodeWriter(store) as writer:
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", fsync)
            with pytest.raises(ForbesError, match=rf"{name}: cannot be written \(No space left .*\)\. Free some space"):
                append(writer)
        assert (store / "index.jsonl").read_bytes() == index
        assert sorted(path.name for path in store.glob("*.npz")) == ["000000.npz", "000001.npz", "000002.npz"]
        append(writer)
    assert numbers(store) == [0, 1, 2, 3]


def test_going_back_to_a_checkpoint_sets_the_future_aside(store):
    with EpisodeWriter(store) as writer:
        assert writer.set_aside(1) == 2
        assert list(writer.records) == [0]
        append(writer)
    assert numbers(store) == [0, 1]

    with EpisodeWriter(store) as writer:
        assert writer.set_aside(1) == 1
        assert writer.set_aside(1) == 0
    names = sorted(path.name for path in (store / "set_aside").iterdir())
    assert names == ["000001-2.npz", "000001.npz", "000002.npz"]  # nothing was lost

    with (
        pytest.raises(ForbesError, match=r"has 1 episodes, expected the 2 of the checkpoint"),
        EpisodeWriter(store) as w,
    ):
        w.set_aside(2)


def test_the_oldest_are_forgotten(store):
    with EpisodeWriter(store) as writer:
        writer.forget(first_held(writer.records.values(), capacity=10))
        assert list(writer.records) == [1, 2]
        append(writer)

    assert numbers(store) == [1, 2, 3]
    assert not (store / "000000.npz").exists()


@pytest.mark.parametrize(("capacity", "first"), [(None, 0), (15, 0), (14, 1), (9, 2), (1, 2)])
def test_what_a_capacity_holds_is_the_latest_whole_episodes(store, capacity, first):
    assert first_held(EpisodeStore(store).records.values(), capacity) == first


def test_what_another_process_has_forgotten_is_not_called_damaged(store):
    reader = EpisodeStore(store)
    with EpisodeWriter(store) as writer:
        writer.forget(2)

    with pytest.raises(ForbesError, match=r"000001\.npz: the process that writes episodes here has removed it since"):
        steps_of(reader, 1)
    (store / "000002.npz").unlink()
    with pytest.raises(DamagedEpisodeError, match="it is missing"):
        steps_of(reader, 2)


def test_a_store_does_not_go_back_before_what_it_has_forgotten(store):
    with EpisodeWriter(store) as writer:
        writer.forget(2)
        with pytest.raises(ForbesError, match="its episodes before 2 were deleted, expected those before 1"):
            writer.set_aside(1)

        writer.set_aside(0)  # a new start
        append(writer)

    with EpisodeWriter(store) as writer:
        assert (writer.watermark, writer.index.first, writer.index.forgotten_steps) == (1, 0, 0)
    assert numbers(store) == [0]


def mapped_files(path):
    """The files below a path that this process has mapped, deleted ones with a mark."""
    with open("/proc/self/maps") as maps:
        return {line.split(maxsplit=5)[5].strip() for line in maps if str(path) in line}


def test_a_forgotten_episode_leaves_the_disk_though_it_was_read(store):
    with EpisodeWriter(store) as writer:
        reader = EpisodeStore(store)
        for number in range(3):
            assert_is(steps_of(reader, number), number)
        writer.forget(2)
        reader.refresh()

    assert not mapped_files(store)
    assert [path.name for path in store.glob("*.npz")] == ["000002.npz"]


def test_names_that_the_store_does_not_give_are_left_alone(store):
    names = {"000004-2.npz", "000004 (copy).npz", "7.npz", "0000001.npz", "notes.npz", "00000\u0664.npz"}
    for name in names:
        (store / name).touch()

    with EpisodeWriter(store) as writer:
        append(writer)
        writer.forget(1)
        writer.set_aside(2)

    assert names < {path.name for path in store.iterdir()}
    assert numbers(store) == [1]


DAMAGE = {
    "truncated": lambda content: content[:-100],
    "empty": lambda content: b"",
    "flipped": lambda content: content[:300] + bytes([content[300] ^ 1]) + content[301:],
    "zeroed": lambda content: content[:-200] + bytes(200),
    "another": lambda content: b"no archive at all".ljust(len(content)),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_named_and_quarantined(store, damage):
    path = store / "000001.npz"
    path.write_bytes(DAMAGE[damage](path.read_bytes()))

    with pytest.raises(
        DamagedEpisodeError, match=r"000001\.npz: damaged \(.*\)\. Move it to quarantine with: forbes data check"
    ):
        EpisodeStore(store).episode(1)
    with EpisodeWriter(store) as writer:
        found = writer.damage()
        assert list(found) == [1]
        writer.quarantine(1)
    assert numbers(store) == [0, 2]
    assert (store / "quarantine" / "000001.npz").is_file()


@pytest.fixture
def hashed(monkeypatch):
    """The sizes of the files hashed so far."""
    sizes = []
    sha256 = hashlib.sha256

    def count(content):
        sizes.append(len(content))
        return sha256(content)

    monkeypatch.setattr("forbes.data.episodes.episode.hashlib.sha256", count)
    return sizes


def test_a_file_is_hashed_once_for_all_processes(store, hashed):
    EpisodeStore(store).verify([0, 1])
    assert len(hashed) == 2
    again = EpisodeStore(store)
    again.verify(again.records)
    assert_is(steps_of(again, 1), 1)
    assert_is(again.episode(0), 0)
    assert len(hashed) == 3

    with EpisodeWriter(store) as writer:
        assert writer.damage() == {}  # `forbes data check` trusts no earlier look
    assert len(hashed) == 6


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("when", ["before this process", "in this process"])
def test_damage_after_a_check_is_found_before_a_step_is_used(store, damage, when):
    reader = EpisodeStore(store)
    reader.verify(reader.records)
    assert_is(steps_of(reader, 1), 1)
    path, before = store / "000001.npz", (store / "000001.npz").stat()
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # as if it had not been written to

    reader = EpisodeStore(store) if when == "before this process" else reader
    with pytest.raises(DamagedEpisodeError, match=r"000001\.npz: damaged"):
        steps_of(reader, 1)
    with pytest.raises(DamagedEpisodeError, match=r"000001\.npz: damaged"):
        EpisodeStore(store).verify([0, 1, 2])
    assert_is(steps_of(reader, 2), 2)


@pytest.mark.parametrize("content", ["", "nonsense", "[]", "3", '{"a": 1}', '{"a": ["x"]}', '{"a": [1, 2]}', "\0\0"])
def test_a_damaged_list_of_verified_files_is_written_again(store, content, hashed):
    EpisodeStore(store).verify([0, 1, 2])
    (store / "verified.jsonl").write_text(content + "\n")
    EpisodeStore(store).verify([0, 1, 2])
    assert len(hashed) == 6
    EpisodeStore(store).verify([0, 1, 2])
    assert len(hashed) == 6


def test_a_list_that_cannot_be_written_is_done_without(store):
    """The store may be read-only, or somebody else's."""
    (store / "verified.jsonl").mkdir()

    EpisodeStore(store).verify([0, 1, 2])
    assert_is(steps_of(EpisodeStore(store), 2), 2)


def test_a_link_in_place_of_the_list_is_not_followed(store, tmp_path):
    (tmp_path / "elsewhere").write_text("")
    (store / "verified.jsonl").symlink_to(tmp_path / "elsewhere")
    EpisodeStore(store).verify([0])
    assert (tmp_path / "elsewhere").read_text() == ""


def test_headers_are_parsed_one_at_a_time(store, monkeypatch):
    # Garbage collection may run another thread in the midst of Python's parser, and 3.11 then raises a SystemError.
    parse, parsing, most = np.lib.format.read_array_header_1_0, [], []

    def slowly(file):
        parsing.append(file)
        time.sleep(0.01)
        most.append(len(parsing))
        parsing.pop()
        return parse(file)

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", slowly)
    EpisodeStore(store).verify([0, 1, 2])
    assert most == [1] * 9  # three arrays of three episodes


def test_a_missing_file_is_damage_too(store):
    (store / "000002.npz").unlink()
    with EpisodeWriter(store) as writer:
        assert writer.damage() == {2: "it is missing"}
        writer.quarantine(2)
        assert append(writer).number == 3
    assert numbers(store) == [0, 1, 3]


def test_objects_are_never_unpickled(store):
    np.savez(store / "evil.npz", observation=np.array([{}], object), action=np.zeros(1), reward=np.zeros(1))
    content = (store / "evil.npz").read_bytes()
    record = EpisodeStore(store).records[0]._replace(size=len(content))
    with open(store / "evil.npz", "rb", buffering=0) as file:
        verified = stamp_of(file)
    with pytest.raises(DamagedEpisodeError, match="has dtype object"):
        map_episode(store / "evil.npz", record, verified)


@pytest.mark.parametrize("line", ["nonsense", "[]", "3", '{"number": 1}', '{"set_aside": 1}', '{"a": 1, "b": 2}'])
def test_a_line_that_is_no_line_of_the_index_is_named(store, line):
    lines = (store / "index.jsonl").read_text().splitlines()
    (store / "index.jsonl").write_text("\n".join([lines[0], line, *lines[1:]]) + "\n")

    with pytest.raises(ForbesError, match=r"index\.jsonl: line 2 is not a line of the index\. Delete it"):
        EpisodeStore(store)


def broken(array, *place, value=np.nan):
    array = array.copy()
    array[place] = value
    return array


WHOLE = episode(0)
WRONG = {
    "its reward is not finite at step 2": {"reward": broken(WHOLE.reward, 2)},
    "its action is not finite at step 3": {"action": broken(WHOLE.action, 3, 0, value=np.inf)},
    "its observation is not finite at step 1": {"observation": broken(WHOLE.observation, 1, 1)},
    r"its reward is float32 \(5,\)": {"reward": WHOLE.reward[:-1]},
    r"its action is float64 \(6, 1\), expected float32": {"action": WHOLE.action.astype(float)},
    r"its observation is int64 \(6, 2\), expected uint8 of rank 4": {"observation": WHOLE.observation.astype(int)},
    r"its observation is float32 \(1, 2\), .* at least 2 steps": {
        "observation": WHOLE.observation[:1], "action": WHOLE.action[:1], "reward": WHOLE.reward[:1]
    },
    "its first action or reward is not zero": {"reward": WHOLE.reward + 1},
    r"its observation is uint8 \(6, 2\), expected": {"observation": WHOLE.observation.astype(np.uint8)},
    r"its observation is float32 \(6, 2, 1, 1\), expected": {"observation": WHOLE.observation[..., None, None]},
    r"its observation is >f4 \(6, 2\), expected": {"observation": WHOLE.observation.astype(">f4")},
    "its action is a list, expected an array": {"action": WHOLE.action.tolist()},
    "its observation is a float, expected an array": {"observation": 1.5},
    "its frames is -1": {"frames": -1},
    "its frames is 2.5": {"frames": 2.5},
    "its terminated is None": {"terminated": None},
}  # fmt: skip


@pytest.mark.parametrize("sentence", WRONG)
def test_an_episode_that_is_not_whole_is_not_stored(store, sentence):
    with EpisodeWriter(store) as writer:
        with pytest.raises(ForbesError, match=f"000003.npz: not stored, {sentence}"):
            writer.append(WHOLE._replace(**WRONG[sentence]), seed=0, policy="test", environment=ENVIRONMENT)
        assert writer.watermark == 3
    assert numbers(store) == [0, 1, 2]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"seed": 2**63}, "its seed is 9223372036854775808"),
        ({"policy": 3}, "its policy is 3"),
        ({"environment": ENVIRONMENT | {"speed": np.nan}}, "its environment is not JSON"),
        ({"environment": ENVIRONMENT | {"speed": object()}}, "its environment is not JSON"),
    ],
)
def test_a_record_that_cannot_be_read_again_is_not_written(change, sentence, store):
    index = (store / "index.jsonl").read_bytes()
    with EpisodeWriter(store) as writer, pytest.raises(ForbesError, match=sentence):
        append(writer, **change)

    assert (store / "index.jsonl").read_bytes() == index
    assert numbers(store) == [0, 1, 2]


def test_any_memory_layout_and_numbers_of_numpy_are_stored(store):
    other = episode(3)._replace(
        observation=np.asfortranarray(episode(3).observation),
        reward=np.repeat(episode(3).reward, 2)[::2],
        terminated=np.bool_(False),
        frames=np.int64(10),
    )
    with EpisodeWriter(store) as writer:
        writer.append(other, seed=np.uint32(7), policy="test", environment=ENVIRONMENT)

    assert numbers(store) == [0, 1, 2, 3]
    assert_is(steps_of(EpisodeStore(store), 3), 3)


def test_other_environments_are_refused_but_not_other_machines(store):
    with EpisodeWriter(store) as writer:
        with pytest.raises(
            ForbesError, match=r"has episodes whose task is Counting, not Other\. Choose another folder"
        ):
            append(writer, environment=ENVIRONMENT | {"task": "Other"})
        append(writer, environment=ENVIRONMENT | {"made_by": {"machine": "that"}})
    assert numbers(store) == [0, 1, 2, 3]


@pytest.mark.parametrize("missing", ["task", "observation_shape", "action_dim", "discrete"])
def test_an_environment_that_describes_too_little_is_refused(missing, store):
    about = {name: value for name, value in ENVIRONMENT.items() if name != missing}
    sentence = f"its environment has no {missing}, expected the result of `describe_environment`"
    with EpisodeWriter(store) as writer, pytest.raises(ForbesError, match=sentence):
        append(writer, environment=about)
    assert numbers(store) == [0, 1, 2]


def test_choices_are_stored_with_their_sizes_and_read_back(tmp_path):
    about, action = ENVIRONMENT | {"action_dim": 5, "discrete": (3, 2)}, np.zeros((3, 5), np.float32)
    action[1:] = [0, 0, 1, 1, 0], [1, 0, 0, 0, 1]
    chosen = Episode(np.zeros((3, 2), np.float32), action, np.zeros(3, np.float32), False, 2)
    with EpisodeWriter(tmp_path) as writer:
        assert writer.append(chosen, 0, "test", about).environment["discrete"] == [3, 2]
        writer.append(chosen, 0, "test", about | {"discrete": [3, 2]})
        for wrong, sentence in (
            (about | {"discrete": True}, r"its action at step 1 is .*, expected a one-hot vector\. Fix"),
            (about | {"discrete": (2, 3)}, "its action at step 1 is .*, expected one-hot vectors of 2 and 3 numbers"),
            (
                about | {"discrete": (3, 3)},
                r"its environment's discrete is \(3, 3\), expected .* action_dim, 5",
            ),
            (about | {"discrete": (4, 1)}, "its action at step 1 is"),
        ):
            with pytest.raises(ForbesError, match=sentence):
                writer.append(chosen, 0, "test", wrong)
        other = action.copy()
        other[1:] = [1, 0, 1, 1, 0]
        with pytest.raises(ForbesError, match=r"has episodes whose discrete is \[3, 2\], not \[2, 1, 2\]"):
            writer.append(chosen._replace(action=other), 0, "test", about | {"discrete": [2, 1, 2]})

    replay = Replay(str(tmp_path), hold_out=0)
    assert (replay.discrete, replay.action_dim) == ((3, 2), 5)
    np.testing.assert_array_equal(EpisodeStore(tmp_path).episode(1).action, action)


@pytest.mark.parametrize(("name", "value"), [("observation_shape", [3]), ("action_dim", 2)])
def test_shapes_unlike_those_of_the_episode_are_refused(name, value, tmp_path):
    with EpisodeWriter(tmp_path) as writer, pytest.raises(ForbesError, match=f"its environment's {name} is"):
        append(writer, environment=ENVIRONMENT | {name: value})
