"""Imported episodes have at index t the action and the reward that led to o_t, whatever their format has there."""

import shutil

import h5py
import numpy as np
import pytest
import recordings

from forbes.data.imports.formats import open_reader
from forbes.data.imports.source import Source

WITHOUT_THE_LAST = ("robomimic-short", "d4rl-short", "episode-ends")
"""Formats that lack the last observation, so the last action led nowhere."""
PICTURES = ("png", "mp4")


def source(path, name, **options):
    if name == "lerobot" and not options:
        options = {"proprio": ["observation.state"]}
    return Source(open_reader(path), path, **options)


@pytest.mark.parametrize("name", recordings.FORMATS)
def test_the_next_observation_is_the_action_that_led_to_it(name, tmp_path):
    recorded = recordings.episodes(count=5, images=name in PICTURES)
    found = source(recordings.write(name, tmp_path / "recorded", recorded), name)

    assert len(found) == 5
    for number, theirs in enumerate(recorded):
        ours = found.episode(number)
        steps = len(theirs.reward) - (name in WITHOUT_THE_LAST)
        np.testing.assert_array_equal(ours.action, theirs.action[:steps])
        np.testing.assert_array_equal(ours.reward, theirs.reward[:steps])
        np.testing.assert_allclose(ours.observation, theirs.observation[:steps], atol=3 if name == "mp4" else 0)
        whole = name not in (*WITHOUT_THE_LAST, "lerobot")
        assert ours.terminated == (theirs.terminated and whole)
        assert ours.frames == steps - 1


@pytest.mark.parametrize("name", ["dreamer", "lerobot", "lance", "png", "mp4"])
def test_a_picture_is_that_of_the_action_that_led_to_it(name, tmp_path):
    recorded = recordings.episodes(images=name != "lerobot")
    path = recordings.write(name, tmp_path / "recorded", recorded)
    keys = {"lerobot": "observation.images.top", "lance": "pixels"}
    found = source(path, name, images=[keys.get(name, "image")], resize=16)

    for number, theirs in enumerate(recorded):
        ours = found.episode(number)
        assert (ours.observation.dtype, ours.observation.shape[1:]) == (np.uint8, (3, 16, 16))
        expected = recordings.pictures(theirs.action)[..., :16, :16]
        assert np.abs(ours.observation.astype(int) - expected).max() <= (0 if name in ("dreamer", "png") else 3)
        np.testing.assert_array_equal(ours.action, theirs.action)


def test_numbers_of_pictures_need_no_zeros(tmp_path):
    """As text, 10.png is before 2.png."""
    recorded = recordings.episodes(count=8, images=True)
    assert max(len(episode.observation) for episode in recorded) > 10
    whole = recordings.write("png", tmp_path / "whole", recorded)
    short = tmp_path / "short"
    shutil.copytree(whole, short)
    for picture in short.glob("*/*.png"):
        picture.rename(picture.with_name(f"{int(picture.stem)}.png"))

    ours, theirs = source(short, "png"), source(whole, "png")

    for number in range(len(recorded)):
        np.testing.assert_array_equal(ours.episode(number).observation, theirs.episode(number).observation)


@pytest.mark.parametrize("with_terminals", [True, False])
def test_dones_at_a_time_limit_are_no_terminations(with_terminals, tmp_path):
    recorded = recordings.episodes(count=5)
    path = recordings.write("d4rl", tmp_path / "recorded.hdf5", recorded)
    with h5py.File(path, "r+") as file:
        file["dones"] = file["terminals"][:] | file["timeouts"][:]
        if not with_terminals:
            del file["terminals"]

    found = source(path, "d4rl")

    assert [found.episode(number).terminated for number in range(5)] == [episode.terminated for episode in recorded]
