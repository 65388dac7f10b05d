"""Damaged recordings end an import with one sentence, and leave no store."""

import io
import json
import re
import zipfile

import numpy as np
import pytest
import recordings

from forbes.data.episodes.store import EpisodeStore
from forbes.data.imports.formats import open_reader
from forbes.data.imports.importing import import_episodes, partial_path
from forbes.data.imports.source import Source
from forbes.errors import ForbesError

PICTURES = ("png", "mp4")


def sentence_of(path, store, name=None, **options):
    """Return the error of an import, which leaves no store; the episodes before it are whole."""
    with pytest.raises(ForbesError) as caught:
        list(import_episodes(Source(open_reader(path, name), path, **options), store))
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert len(sentence.replace(str(path), "")) < 400
    assert not store.exists()
    partial = EpisodeStore(partial_path(store))
    partial.verify(partial.records)
    return sentence


def options_of(name):
    return {"proprio": ["observation.state"]} if name == "lerobot" else {}


def largest(path):
    """The last file of a recording that matters, by size."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return max(files, key=lambda each: (each.stat().st_size, each.name))


@pytest.mark.parametrize("name", recordings.FORMATS)
def test_a_truncated_recording_is_refused(name, tmp_path):
    path = recordings.write(name, tmp_path / "recorded", recordings.episodes(5, images=name in PICTURES))
    file = largest(path)
    options = options_of(name) if file.suffix != ".mp4" or name == "mp4" else {"images": ["observation.images.top"]}
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])

    sentence = sentence_of(path, tmp_path / "store", **options)

    assert sentence.startswith(str(path))
    assert ("line 5 has 1 values, expected 3" if name == "png" else ": truncated or not ") in sentence


@pytest.mark.parametrize("name", recordings.FORMATS)
def test_a_value_that_is_no_number_is_refused_with_its_place(name, tmp_path):
    recorded = recordings.episodes(5, images=name in PICTURES)
    recorded[3].action[2] = np.nan
    path = recordings.write(name, tmp_path / "recorded", recorded)

    sentence = sentence_of(path, tmp_path / "store", **options_of(name))

    episode = r"(/003\.npz|/take-3|/take-3\.mp4|: data/demo_3|: steps 15 to 21|: episode 3)"  # after 4, 5 and 6 steps
    assert_matches(rf"{episode}: its action is not finite at step 2\.", sentence)


def rewrite(path, **changes):
    """Change arrays of an `.npz`; None removes one."""
    with np.load(path) as arrays:
        content = {name: arrays[name] for name in arrays} | changes
    np.savez(path, **{name: array for name, array in content.items() if array is not None})


NPZ = {
    "has no reward, unlike other episodes": {"reward": None},
    "unequal lengths: 8 observations, 7 actions": {"action": np.zeros((7, 1), np.float32)},
    "8 observations, 8 actions, 5 rewards": {"reward": np.zeros(5, np.float32)},
    "reward is <U3 .*, expected numbers": {"reward": np.array(["one"] * 8)},
    "its first action is not zero": {"action": np.ones((8, 1), np.float32)},
    r"its observation has shape \(3,\), expected that of the first episode, \(2,\)": {"state": np.zeros((8, 3))},
    r"its action has shape \(2,\), expected that of the first episode": {"action": np.zeros((8, 2), np.float32)},
    "has several episodes, expected one per file": {"is_first": np.ones(8, bool)},
    "its reward is not finite at step 3": {"reward": np.where(np.arange(8) == 3, 1e300, 0)},
    "truncated or not dreamer .*allow_pickle": {"reward": np.array([{}] * 8)},
}


@pytest.mark.parametrize("expected", NPZ)
def test_a_file_of_dreamer_that_is_unlike_the_others_is_refused(expected, tmp_path):
    path = recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(4))
    rewrite(path / "003.npz", **NPZ[expected])

    message = sentence_of(path, tmp_path / "store")

    assert str(path) in message
    assert_matches(expected, message)
    assert len(EpisodeStore(partial_path(tmp_path / "store")).records) in (0, 3)


def assert_matches(pattern, message):
    assert re.search(pattern, message), message


def test_an_import_continues_after_the_damaged_file_is_repaired(tmp_path):
    path = recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(4))
    whole = (path / "003.npz").read_bytes()
    rewrite(path / "003.npz", reward=None)
    sentence_of(path, tmp_path / "store")
    (path / "003.npz").write_bytes(whole)

    assert [record.number for record in import_episodes(Source(open_reader(path), path), tmp_path / "store")] == [3]
    assert len(EpisodeStore(tmp_path / "store").records) == 4


def test_integers_that_are_no_choices_are_refused(tmp_path):
    path = recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(2))
    rest = {"state": np.ones(5), "reward": None, "is_first": None, "is_terminal": None}

    def refused(action, **options):
        for file, values in zip(sorted(path.iterdir()), action, strict=True):
            rewrite(file, action=values, **rest)
        return sentence_of(path, tmp_path / "store", **options)

    pair, negative = np.tile([[0, 2]], (5, 1)), np.tile([[0, -1]], (5, 1))
    assert "its actions are -1 to -1, expected 0 to 1" in refused([negative, negative])
    assert "action has integers up to 9998, expected discrete actions" in refused([pair, pair + 9996])
    assert "its actions are 2 to 2, expected 0 to 1" in refused([pair, pair], action_sizes=[3, 2])
    assert "action is int64 (2,), expected 1 integers, or a one-hot vector" in refused([pair, pair], action_sizes=[3])
    assert "action has 3 numbers a step, unlike that of the first episode" in refused(
        [pair, np.tile([[0, 2, 0]], (5, 1))]
    )
    assert "its actions are float64 (2,), expected 2 integers" in refused([pair, pair / 4])


def test_images_of_floats_are_refused(tmp_path):
    path = recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(2, images=True))
    for file in path.iterdir():
        with np.load(file) as arrays:
            rewrite(file, image=arrays["image"] / 255)

    assert "--image image is float64 (32, 32, 3), expected uint8" in sentence_of(path, tmp_path / "s", images=["image"])
    assert "no key has an image (uint8) or a vector" in sentence_of(path, tmp_path / "s")


def external_link(file, elsewhere):
    import h5py

    del file["observations"]
    file["observations"] = h5py.ExternalLink(str(elsewhere), "observations")


def external_storage(file, elsewhere):
    del file["rewards"]
    file.create_dataset("rewards", (20,), "u1", external=[(str(elsewhere), 0, 20)])


def virtual(file, elsewhere):
    import h5py

    layout = h5py.VirtualLayout((20,), "u1")
    layout[:] = h5py.VirtualSource(str(elsewhere), "rewards", (20,))
    del file["rewards"]
    file.create_virtual_dataset("rewards", layout)


@pytest.mark.parametrize("point", [external_link, external_storage, virtual], ids=lambda point: point.__name__)
def test_an_hdf5_file_that_points_to_another_file_is_refused(point, tmp_path):
    h5py = pytest.importorskip("h5py")
    path = recordings.write("d4rl", tmp_path / "recorded", recordings.episodes(3))
    with h5py.File(path, "r+") as file:
        point(file, recordings.write("d4rl", tmp_path / "secret", recordings.episodes(3)))

    assert "is in another file, expected one file. Do not trust this data" in sentence_of(path, tmp_path / "store")


HDF5 = {
    "actions has 13 steps, expected 15, since episodes end there": ("actions", lambda array: array[:-2]),
    "no key action or actions. Name the action: --action KEY": ("actions", None),
    "rewards has dtype .S3, expected numbers": ("rewards", lambda array: np.array([b"one"] * 15)),
    "nothing says where episodes end": ("terminals", None),
}


@pytest.mark.parametrize("expected", HDF5)
def test_an_array_of_d4rl_that_does_not_fit_is_refused(expected, tmp_path):
    h5py = pytest.importorskip("h5py")
    path = recordings.write("d4rl", tmp_path / "recorded", recordings.episodes(3))
    name, change = HDF5[expected]
    with h5py.File(path, "r+") as file:
        array = file[name][:]
        del file[name]
        if change is not None:
            file[name] = change(array)
        elif name == "terminals":
            del file["timeouts"]

    assert_matches(expected, sentence_of(path, tmp_path / "store"))


def test_an_episode_of_robomimic_without_a_key_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = recordings.write("robomimic", tmp_path / "recorded", recordings.episodes(3))
    with h5py.File(path, "r+") as file:
        del file["data/demo_2/obs/state"]

    assert "data/demo_2: has no state, unlike other episodes" in sentence_of(path, tmp_path / "store")


def test_lengths_of_stable_worldmodel_beyond_its_columns_are_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = recordings.write("stable-worldmodel", tmp_path / "recorded", recordings.episodes(3))
    with h5py.File(path, "r+") as file:
        file["ep_len"][2] = 99

    assert "say up to step 110, but there are 18" in sentence_of(path, tmp_path / "store")


def change_info(path, **changes):
    info = json.loads((path / "meta/info.json").read_text()) | changes
    (path / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"data_path": "../secret/{chunk_index}-{file_index}.parquet"},
            "names the file '../secret/0-0.parquet', expected",
        ),
        ({"data_path": "/etc/passwd"}, "names the file '/etc/passwd', expected one inside"),
        ({"codebase_version": "v2.1"}, "is of version v2.1, expected v3. Convert it by lerobot"),
        ({"fps": "many"}, "truncated or not lerobot"),
        ({"features": {}}, "no key action or actions"),
    ],
)
def test_a_description_of_lerobot_that_misleads_is_refused(change, expected, tmp_path):
    path = recordings.write("lerobot", tmp_path / "recorded", recordings.episodes(2))
    change_info(path, **change)

    assert expected in sentence_of(path, tmp_path / "store", **({} if "features" in change else options_of("lerobot")))


def test_a_video_with_too_few_frames_is_refused(tmp_path):
    path = recordings.write("lerobot", tmp_path / "recorded", recordings.episodes(3))
    frames = recordings.pictures(np.zeros((9, 1))).transpose(0, 2, 3, 1)
    recordings.film(path / "videos/observation.images.top/chunk-000/file-000.mp4", frames)

    message = sentence_of(path, tmp_path / "store", images=["observation.images.top"])

    assert "has 4 frames from 0.5 s on, expected 6" in message


def test_minari_never_imports_what_a_data_set_names(tmp_path):
    path = recordings.write("minari", tmp_path / "recorded", recordings.episodes(2))
    about = json.loads((path / "metadata.json").read_text())
    del about["action_space"]
    about["env_spec"] = json.dumps({"id": "Evil-v0", "entry_point": "os:abort"})
    (path / "metadata.json").write_text(json.dumps(about))

    assert "metadata.json has no spaces" in sentence_of(path, tmp_path / "store")


CSV = {
    "line 3 has 2 values, expected 3": "push,reward,terminated\n0.1,0,0\n0.2,0\n",
    "could not convert string to float": "push,reward,terminated\n0.1,0,0\nleft,0,0\n",
    "has no column for the action": "reward,terminated\n0,0\n0,0\n",
    "its last line has a reward and is terminated": "push,reward,terminated\n" + "0.1,0,0\n" * 4 + "0.2,1,1\n",
    "unequal lengths: 5 observations, 2 actions": "push,reward,terminated\n0.1,0,0\n0.2,0,0\n",
}


@pytest.mark.parametrize("expected", CSV)
def test_a_table_of_actions_that_does_not_fit_is_refused(expected, tmp_path):
    path = recordings.write("png", tmp_path / "recorded", recordings.episodes(2, images=True))
    (path / "take-0/actions.csv").write_text(CSV[expected])

    assert expected in sentence_of(path, tmp_path / "store")


def test_a_picture_of_another_size_is_refused(tmp_path):
    path = recordings.write("png", tmp_path / "recorded", recordings.episodes(2, images=True))
    content = io.BytesIO((path / "take-1/0002.png").read_bytes())
    with recordings.Image.open(content) as picture:
        picture.resize((8, 8)).save(path / "take-1/0002.png")

    assert "episode 1: truncated or not frames" in sentence_of(path, tmp_path / "store")


def test_an_archive_cannot_write_outside_of_the_store(tmp_path):
    path = recordings.write("dreamer", tmp_path / "recorded", recordings.episodes(2))
    with zipfile.ZipFile(path / "000.npz", "a") as archive:
        archive.writestr("../../escaped.npy", archive.read("reward.npy"))
    list(import_episodes(Source(open_reader(path), path, proprio=["state"]), tmp_path / "store"))

    assert not [each for each in tmp_path.parent.rglob("escaped*")]


@pytest.mark.parametrize("content", [None, "nothing.txt", "store"])
def test_what_no_format_recognises_is_said(content, tmp_path):
    path = tmp_path / "recorded"
    expected = "no such file or folder"
    if content is not None:
        path.mkdir()
        (path / "notes.txt").touch()
        expected = "no format recognises it. Name one: --format dreamer|"
    if content == "store":
        (path / "index.jsonl").touch()
        expected = "is an episode store already"

    assert expected in sentence_of(path, tmp_path / "store")
