"""An import ends with a whole store or with none, after a kill too, and needs the memory of one episode."""

import os
import shutil
import signal
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import recordings
from forked import run_in_a_fork
from PIL import Image

from forbes.choices import EXPORTS
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.data.exports import export_store
from forbes.data.imports.formats import open_reader
from forbes.data.imports.importing import import_episodes, is_imported, partial_path
from forbes.data.imports.source import Source
from forbes.data.imports.survey import survey
from forbes.errors import ForbesError
from forbes.factors import factor_sizes, to_one_hot


def source(path, **options):
    return Source(open_reader(path), path, **options)


def imported(path, output, **options):
    return list(import_episodes(source(path, **options), output))


def content(store):
    """The files of a store, but for the process in its lock."""
    return {path.name: path.read_bytes() for path in store.rglob("*") if path.is_file() and path.name != ".lock"}


@pytest.fixture
def recorded(tmp_path):
    """A folder of six episodes."""
    return recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(6))


def test_an_imported_episode_says_where_it_is_from(recorded, tmp_path):
    records = imported(recorded, tmp_path / "store")

    assert [record.steps for record in records] == [4, 5, 6, 7, 8, 9]
    assert records[0].environment == {
        "task": "recorded",
        "observation_shape": [2],
        "action_dim": 1,
        "discrete": False,
        "action_repeat": 1,
        "imported": {"format": "dreamer", "resize": None, "keys": ["state", "action", "reward"]},
    }
    assert list(EpisodeStore(tmp_path / "store").records) == [0, 1, 2, 3, 4, 5]
    assert not partial_path(tmp_path / "store").exists()
    assert is_imported(source(recorded), tmp_path / "store")


def import_and_die(recorded, output, when):
    """Import, and be killed at the n-th time that something is synced to the disk."""
    calls, sync = [], os.fsync

    def fsync(descriptor):
        calls.append(1)
        if len(calls) == when:
            os.kill(os.getpid(), signal.SIGKILL)
        sync(descriptor)

    os.fsync = fsync
    imported(recorded, output)


@pytest.mark.parametrize("when", [1, 2, 3, 4, 7, 9, 10, 19, 20, 21, 22])  # files, folders, index; at last the new name
def test_a_killed_import_continues_to_the_same_bytes(when, recorded, tmp_path):
    imported(recorded, tmp_path / "whole")
    store = tmp_path / "store"
    assert run_in_a_fork(import_and_die, recorded, store, when) == -signal.SIGKILL
    assert store.exists() == (when == 22)
    if not store.exists():
        imported(recorded, store)
    assert is_imported(source(recorded), store)
    assert content(store) == content(tmp_path / "whole")


def test_an_import_does_not_continue_another_one(recorded, tmp_path):
    (tmp_path / "others").mkdir()
    other = recordings.write("dreamer", tmp_path / "others" / "recorded", recordings.episodes(6, seed=1))
    begun = import_episodes(source(recorded), tmp_path / "store")
    next(begun)
    begun.close()

    with pytest.raises(ForbesError, match=r"store\.partial: has episodes that are not those of .*others"):
        imported(other, tmp_path / "store")
    with pytest.raises(ForbesError, match=r"store\.partial: has episodes that are not those"):
        imported(recorded, tmp_path / "store", reward="action")


def test_a_folder_with_anything_else_is_left_alone(recorded, tmp_path):
    (tmp_path / "notes").mkdir()
    imported(recorded, tmp_path / "store")

    with pytest.raises(ForbesError, match=r"notes: exists and is not a store of"):
        is_imported(source(recorded), tmp_path / "notes")
    with pytest.raises(ForbesError, match=r"store: exists and is not a store of"):
        is_imported(source(recorded, reward="action"), tmp_path / "store")
    assert not is_imported(source(recorded), tmp_path / "new")

    shutil.rmtree(recorded)  # recorded again, with as many episodes
    recordings.write("dreamer", recorded, recordings.episodes(6, seed=1))
    with pytest.raises(ForbesError, match=r"store: exists and is not a store of"):
        is_imported(source(recorded), tmp_path / "store")


def test_memory_is_that_of_an_episode(tmp_path):
    recorded, size = tmp_path / "recorded", 0
    recorded.mkdir()
    for number in range(40):
        image = np.random.default_rng(number).integers(0, 256, (30, 64, 64, 3), np.uint8)
        np.savez(recorded / f"{number:02d}.npz", image=image, action=np.zeros((30, 1), np.float32))
        size = image.nbytes
    tracemalloc.start()
    imported(recorded, tmp_path / "store")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak < 8 * size < 40 * size  # the array, its images, their copy, and the file of it


@pytest.mark.parametrize("images", [False, True], ids=["vectors", "images"])
@pytest.mark.parametrize("discrete", [False, True, (2, 1)], ids=["continuous", "discrete", "choices"])
@pytest.mark.parametrize("name", EXPORTS)
def test_an_exported_store_is_imported_bit_for_bit(name, discrete, images, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a relative path, as one types it
    exported = Path("exported")
    pytest.importorskip({"hdf5": "h5py", "minari": "minari"}.get(name, "numpy"))
    random = np.random.default_rng(0)
    about = {"task": "toy", "action_dim": 3, "discrete": discrete}
    with EpisodeWriter(tmp_path / "store") as writer:
        for episode in recordings.episodes(4, images=images):
            steps = len(episode.reward) - 1
            action = random.uniform(-1, 1, (steps, 3))
            if sizes := factor_sizes(discrete, 3):
                action = to_one_hot(np.stack([random.integers(size, size=steps) for size in sizes], 1), sizes)
            action = np.concatenate([np.zeros((1, 3)), action]).astype(np.float32)
            observation = episode.observation
            if images:
                observation = random.integers(0, 256, observation.shape, np.uint8)
            about["observation_shape"] = list(observation.shape[1:])
            writer.append(episode._replace(observation=observation, action=action), 0, "test", about)
        writer.quarantine(1)
    store = EpisodeStore(tmp_path / "store")

    assert list(export_store(store, exported, name)) == [0, 1, 2]
    known = isinstance(discrete, bool) or name == "minari"
    found = source(exported, action_sizes=() if known else discrete)

    assert (found.discrete, len(found)) == (discrete, 3)
    for number, ours in zip(store.records, map(found.episode, range(3)), strict=True):
        theirs = store.episode(number)
        for one, other in zip(ours[:3], theirs[:3], strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
        assert ours.terminated == theirs.terminated
    with pytest.raises(ForbesError, match="exported: exists"):
        next(export_store(store, exported, name))


def test_integers_become_one_hot_actions(tmp_path):
    (tmp_path / "recorded").mkdir()
    for number in range(3):
        arrays = {"state": np.ones((4, 2)), "action": np.array([0, number, 1, 0])}
        np.savez(tmp_path / "recorded" / f"{number}.npz", **arrays)
    found = source(tmp_path / "recorded")

    assert found.discrete
    np.testing.assert_array_equal(found.episode(2).action, [[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]])
    assert not found.episode(2).reward.any()


@pytest.mark.parametrize("dtype", [np.int64, bool])
def test_several_integers_become_one_hot_vectors_side_by_side(dtype, tmp_path):
    (tmp_path / "recorded").mkdir()
    action = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype)
    for number in range(2):
        np.savez(tmp_path / "recorded" / f"{number}.npz", state=np.ones((4, 2)), action=action)
    found, wider = source(tmp_path / "recorded"), source(tmp_path / "recorded", action_sizes=[3, 2])

    assert (found.discrete, wider.discrete) == ((2, 2), (3, 2))
    np.testing.assert_array_equal(found.episode(0).action, [[0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 0, 1], [1, 0, 0, 1]])
    np.testing.assert_array_equal(wider.episode(0).action[1], [0, 1, 0, 1, 0])
    assert "one-hot vectors of 2 and 2 numbers, one after the other" in survey(found).facts["action"]
    assert len(imported(tmp_path / "recorded", tmp_path / "store")) == 2
    assert is_imported(found, tmp_path / "store")


@pytest.mark.parametrize("kind", ["several", "buttons", "nested"])
def test_choices_of_a_minari_data_set_have_its_sizes(kind, tmp_path, monkeypatch):
    minari, spaces = pytest.importorskip("minari"), pytest.importorskip("gymnasium").spaces
    from minari.data_collector.episode_buffer import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    space = {
        "several": spaces.MultiDiscrete([3, 2], start=[5, -1]),
        "buttons": spaces.MultiBinary(2),
        "nested": spaces.Tuple([spaces.Discrete(2), spaces.Discrete(2)]),
    }[kind]
    action = np.array([[0, 0], [1, 1], [0, 1]])
    recorded = {"several": action + np.array([5, -1]), "buttons": action.astype(np.int8), "nested": tuple(action.T)}[
        kind
    ]
    episode = EpisodeBuffer(
        0, None, None, np.zeros((4, 2), np.float32), recorded, [0.0] * 3, [False] * 3, [False] * 2 + [True]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that nobody is named as author
        minari.create_dataset_from_buffers(
            "lab/toy-v0", [episode], action_space=space, observation_space=spaces.Box(-9, 9, (2,))
        )

    if kind == "nested":
        with pytest.raises(ForbesError, match="its actions are a Tuple, expected a Box, Discrete, MultiDiscrete or"):
            source(tmp_path / "lab/toy-v0")
        return
    found = source(tmp_path / "lab/toy-v0")
    assert found.discrete == ((3, 2) if kind == "several" else (2, 2))
    np.testing.assert_array_equal(found.episode(0).action[1:], to_one_hot(action, found.sizes))


def test_an_episode_of_one_step_leaves_actions_one_hot(tmp_path):
    (tmp_path / "recorded").mkdir()
    for steps in (1, 3):
        action = np.concatenate([np.zeros((1, 2)), np.eye(2)[[0, 1, 0][:steps]]])
        np.savez(tmp_path / "recorded" / f"{steps}.npz", state=np.ones(steps + 1), action=action)

    assert source(tmp_path / "recorded").discrete


def test_actions_that_stop_being_one_hot_are_numbers(tmp_path):
    (tmp_path / "recorded").mkdir()
    for number in range(3):
        action = np.array([[0, 0], [1, 0], [0, 1 if number < 2 else 2]], float)
        np.savez(tmp_path / "recorded" / f"{number}.npz", state=np.ones(3), action=action)

    assert not source(tmp_path / "recorded").discrete
    with pytest.raises(ForbesError, match=r"2\.npz: its actions are not a one-hot vector"):
        imported(tmp_path / "recorded", tmp_path / "store", action_sizes=[2])


def test_parts_of_a_minari_data_set_are_chosen_by_key(tmp_path, monkeypatch):
    minari, spaces = pytest.importorskip("minari"), pytest.importorskip("gymnasium").spaces
    from minari.data_collector.episode_buffer import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    image = np.random.default_rng(0).integers(0, 256, (4, 8, 8, 3), np.uint8)
    parts = {"camera": image, "robot": {"place": np.arange(8.0).reshape(4, 2), "gripper": np.arange(4)}}
    vectors = {"place": spaces.Box(-9, 9, (2,)), "gripper": spaces.Discrete(4)}
    observations = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "robot": spaces.Dict(vectors)})
    episode = EpisodeBuffer(
        0, None, None, parts, np.array([5, 7, 6]), [1.0, 2.0, 3.0], [False] * 3, [False] * 2 + [True]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that nobody is named as author
        minari.create_dataset_from_buffers(
            "lab/toy-v0", [episode], action_space=spaces.Discrete(4, start=5), observation_space=observations
        )

    with pytest.raises(ForbesError, match="Choose some of --image camera --proprio robot/gripper robot/place"):
        source(tmp_path / "lab/toy-v0")
    vector = source(tmp_path / "lab/toy-v0", proprio=["robot/place", "robot/gripper"]).episode(0)
    np.testing.assert_array_equal(vector.observation, [[0, 1, 0], [2, 3, 1], [4, 5, 2], [6, 7, 3]])
    np.testing.assert_array_equal(vector.action[1:], np.eye(4)[[0, 2, 1]])
    by_id = Source(open_reader(Path("lab/toy-v0"), "minari"), Path("lab/toy-v0"), images=["camera"])
    np.testing.assert_array_equal(by_id.episode(0).observation, image.transpose(0, 3, 1, 2))
    assert by_id.describe()["task"] == "toy-v0"


def test_a_lower_rate_joins_actions_and_sums_rewards(tmp_path):
    theirs = recordings.episodes(4)
    path = recordings.write("lerobot", tmp_path / "recorded", theirs)
    ours = source(path, proprio=["observation.state"], fps=recordings.FPS / 2).episode(3)  # of 7 steps

    np.testing.assert_array_equal(ours.observation, theirs[3].observation[:7:2])
    np.testing.assert_array_equal(ours.action[1:], theirs[3].action[1:7].reshape(3, 2))
    np.testing.assert_array_equal(ours.reward[1:], theirs[3].reward[1:7].reshape(3, 2).sum(1))
    assert (ours.frames, ours.terminated) == (6, False)
    with pytest.raises(ForbesError, match="--fps 4 does not divide the 10 steps per second"):
        source(path, proprio=["observation.state"], fps=4)
    with pytest.raises(ForbesError, match="--fps 4 needs the rate of the data"):
        source(recordings.write("dreamer", tmp_path / "dreamer", theirs), fps=4)


def test_a_lower_rate_keeps_the_end(tmp_path):
    """The frames that are left over are the first ones: the last reward and the termination often are the task."""
    theirs = recordings.episodes(2, images=True)
    path = recordings.write("mp4", tmp_path / "recorded", theirs)

    ours = source(path, images=["image"], fps=recordings.FPS / 2).episode(1)  # of 5 steps

    grey = theirs[1].observation[1::2, 0, 0, 0].astype(int)
    np.testing.assert_allclose(ours.observation[:, 0, 0, 0], grey, atol=4)  # lossy
    np.testing.assert_allclose(ours.action[1:], theirs[1].action[2:].reshape(2, 2), rtol=1e-6)
    np.testing.assert_allclose(ours.reward[1:], theirs[1].reward[2:].reshape(2, 2).sum(1), rtol=1e-6)
    assert (ours.frames, ours.terminated) == (4, True)


def takes(path, text, pictures, **encoding):
    """Write an episode of pictures, and its table."""
    (path / "take-0").mkdir(parents=True)
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(path / "take-0" / f"{number}.png")
    (path / "take-0" / "actions.csv").write_text(text, **encoding)
    return path


GREY = np.zeros((3, 4, 4), np.uint8)


def test_a_mark_at_the_start_of_a_table_is_no_part_of_a_name(tmp_path):
    path = takes(tmp_path / "takes", "reward,a\n100,0.1\n101,0.2\n", GREY, encoding="utf-8-sig")

    episode = source(path, images=["image"]).episode(0)

    np.testing.assert_allclose(episode.action[1:], [[0.1], [0.2]], rtol=1e-6)
    assert episode.reward.tolist() == [0, 100, 101]


@pytest.mark.parametrize(
    ("text", "pictures", "sentence"),
    [
        ("0.0\n0.1\n0.2\n", GREY, r"actions\.csv: its first line has the number 0\.0, expected names\. Add a line"),
        ("a\n0.1\n0.2\n", GREY.astype(np.uint16), r"0\.png: its pixels are of mode I;16, expected 8 bits each"),
    ],
    ids=["no names", "16 bits"],
)
def test_what_would_be_read_otherwise_than_meant_is_refused(text, pictures, sentence, tmp_path):
    with pytest.raises(ForbesError, match=sentence):
        source(takes(tmp_path / "takes", text, pictures), images=["image"])


def test_a_folder_with_two_tables_is_named(tmp_path):
    path = takes(tmp_path / "takes", "a\n0.1\n0.2\n", GREY)
    (path / "take-0" / "notes.csv").write_text("a\n1\n")

    with pytest.raises(ForbesError, match=r"take-0: has several \.csv, expected one beside its pictures"):
        open_reader(path, "frames")


def test_choices_in_a_table_are_counted_by_their_sizes(tmp_path):
    path = takes(tmp_path / "takes", "button,lever\n2,0\n1,1\n", GREY)

    episode = source(path, images=["image"], action_sizes=[3, 2]).episode(0)

    assert episode.action[1:].tolist() == [[0, 0, 1, 1, 0], [0, 1, 0, 0, 1]]
    (path / "take-0" / "actions.csv").write_text("button,lever\n2,0\n0.5,1\n")
    with pytest.raises(ForbesError, match="expected 2 integers"):
        source(path, images=["image"], action_sizes=[3, 2])


def test_corrected_ends_are_not_imported_already(recorded, tmp_path):
    imported(recorded, tmp_path / "store")
    for path in recorded.iterdir():
        with np.load(path) as file:
            np.savez(path, **{name: file[name] & False if name == "is_terminal" else file[name] for name in file})

    with pytest.raises(ForbesError, match="exists and is not a store of"):
        is_imported(source(recorded), tmp_path / "store")


def test_the_state_of_robomimic_is_not_followed_by_an_observation(tmp_path):
    """`next_obs` is of `obs` alone, so that the observation after the last action is not known."""
    import h5py

    path = recordings.write("robomimic", tmp_path / "recorded.hdf5", recordings.episodes(2))
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            demo["states"], demo["rewards"][-1] = np.arange(len(demo["actions"]), dtype=np.float32), 0.0

    episode = source(path, proprio=["states"]).episode(1)

    assert (len(episode.observation), episode.terminated) == (5, False)


def test_the_next_action_of_d4rl_is_not_one_of_the_episode(tmp_path):
    import h5py

    path = recordings.write("d4rl", tmp_path / "recorded.hdf5", recordings.episodes(3))
    expected = source(path).episode(1)
    with h5py.File(path, "r+") as file:
        file["next_actions"] = file["actions"][:]

    for ours, theirs in zip(source(path).episode(1), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_table_needs_the_memory_of_one_episode(tmp_path):
    (tmp_path / "recorded").mkdir()
    size = 4 * 100 * 10_000  # bytes of an episode in float32
    for number in range(10):
        action, state = np.zeros((100, 1)), np.full((100, 10_000), number, np.float32)
        np.savez(tmp_path / "recorded" / f"{number}.npz", state=state, action=action)
    found = source(tmp_path / "recorded")

    tracemalloc.start()
    survey(found)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 6 * size  # one of ten at a time, which is read, converted and checked


def test_the_table_says_what_becomes_of_each_key(tmp_path):
    path = recordings.write("lerobot", tmp_path / "recorded", recordings.episodes(3))
    found = survey(source(path, proprio=["observation.state"]))

    rows = {row[0]: row[1:] for row in found.rows}
    assert rows["observation.state"][:3] == ("observation", "(2,)", "float32")
    assert rows["action"][0] == "action"
    assert rows["next.reward"][0] == "reward"
    assert rows["timestamp"] == ("not used", "()", "float32", "")
    low, high = map(float, rows["action"][3].split(" to "))
    assert -1 <= low < high <= 1
    assert "shifted by one" in found.facts["alignment"]
    assert found.facts["episodes"] == "3, of 4 to 6 steps, 0 terminated"
