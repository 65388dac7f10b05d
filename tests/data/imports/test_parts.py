"""Recorded images and vectors become the parts of an observation, and go back to other formats."""

from pathlib import Path

import numpy as np
import pytest
import recordings

from forbes.commands.cli import main
from forbes.data.episodes.episode import arrays_of
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.data.exports import export_store
from forbes.data.imports.formats import open_reader
from forbes.data.imports.importing import import_episodes
from forbes.data.imports.source import Source
from forbes.errors import ForbesError


def two_cameras(folder, cut=0):
    """A robot in Dreamer's format: o_t = a_{t-1}, in each of two cameras and two vectors."""
    folder.mkdir()
    for number, episode in enumerate(recordings.episodes(3)):
        top = recordings.pictures(episode.action).transpose(0, 2, 3, 1)
        arrays = {"top": top, "wrist": 255 - top[:, :20], "arm": episode.action, "hand": -episode.action}
        arrays["wrist"] = arrays["wrist"][cut:]
        np.savez(folder / f"{number}.npz", action=episode.action, reward=episode.reward, **arrays)
    return folder


def source(path, **options):
    return Source(open_reader(path), path, **options)


def test_two_cameras_and_proprioception_are_parts(tmp_path):
    path = two_cameras(tmp_path / "recorded")

    found = source(path, images=["wrist", "top"], proprio=["arm", "hand"])

    assert found.describe()["observation_shape"] == {"proprio": [2], "top": [3, 32, 32], "wrist": [3, 20, 32]}
    for number, recorded in enumerate(recordings.episodes(3)):
        episode = found.episode(number)
        expected = recordings.pictures(recorded.action)
        np.testing.assert_array_equal(episode.observation["top"], expected)
        np.testing.assert_array_equal(episode.observation["wrist"], 255 - expected[:, :, :20])
        np.testing.assert_array_equal(episode.observation["proprio"][:, 0], episode.action[:, 0])


def test_one_vector_next_to_an_image_keeps_its_name(tmp_path):
    path = two_cameras(tmp_path / "recorded")

    assert {*source(path, images=["top"], proprio=["arm"]).first.observation} == {"top", "arm"}
    assert {*source(path, images=["top", "wrist"]).first.observation} == {"top", "wrist"}
    assert source(path, images=["top"]).first.observation.shape[1:] == (3, 32, 32)  # one array, as ever


def test_keys_of_lerobot_become_short_names(tmp_path):
    path = recordings.write("lerobot", tmp_path / "recorded", recordings.episodes(2))

    found = source(path, images=["observation.images.top"], proprio=["observation.state"], resize=16)

    assert found.describe()["observation_shape"] == {"state": [2], "top": [3, 16, 16]}


def test_parts_of_unequal_length_are_refused(tmp_path):
    path = two_cameras(tmp_path / "recorded", cut=1)

    with pytest.raises(ForbesError, match=r"unequal lengths: .*'top': 5, 'wrist': 4"):
        source(path, images=["top", "wrist"])


def test_the_command_line_shows_and_imports_the_parts(tmp_path, capsys):
    path, store = two_cameras(tmp_path / "recorded"), tmp_path / "store"
    command = ["data", "import", path, "-o", store, "--image", "top", "wrist", "--proprio", "arm", "hand"]

    assert main([*map(str, command)]) == 0
    assert main([*map(str, command)]) == 0  # resumed: already there

    shown = capsys.readouterr().out
    assert "observation top" in shown
    assert "observation proprio" in shown
    assert "already imported, 3 episodes" in shown
    assert EpisodeStore(store).episode(2).observation["wrist"].shape == (7, 3, 20, 32)


@pytest.mark.parametrize("name", ["hdf5", "minari", "npz"])
def test_an_exported_store_of_parts_is_imported_bit_for_bit(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pytest.importorskip({"hdf5": "h5py", "minari": "minari"}.get(name, "numpy"))
    recorded = two_cameras(tmp_path / "recorded")
    with EpisodeWriter(tmp_path / "store") as writer:
        found = source(recorded, images=["top", "wrist"], proprio=["arm"])
        for number in range(3):
            writer.append(found.episode(number), 0, "test", found.describe())
    store = EpisodeStore(tmp_path / "store")

    assert list(export_store(store, Path("exported"), name)) == [0, 1, 2]
    again = source(Path("exported"), images=["top", "wrist"], proprio=["arm"])
    list(import_episodes(again, tmp_path / "again"))

    for number in range(3):
        one, other = (arrays_of(s.episode(number)) for s in (store, EpisodeStore(tmp_path / "again")))
        assert one.keys() == other.keys()
        for array, expected in zip(one.values(), other.values(), strict=True):
            np.testing.assert_array_equal(array, expected)
            assert array.dtype == expected.dtype


def test_a_part_with_the_name_of_another_key_is_not_exported(tmp_path):
    zeros = np.zeros((3, 2), np.float32)
    environment = {"task": "toy", "observation_shape": {"reward": [2]}, "action_dim": 1, "discrete": False}
    with EpisodeWriter(tmp_path / "store") as writer:
        episode = recordings.episodes(1)[0]._replace(
            observation={"reward": zeros}, action=zeros[:, :1], reward=zeros[:, 0]
        )
        writer.append(episode, 0, "test", environment)

    with pytest.raises(ForbesError, match="has a part called reward"):
        next(export_store(EpisodeStore(tmp_path / "store"), tmp_path / "out", "npz"))
