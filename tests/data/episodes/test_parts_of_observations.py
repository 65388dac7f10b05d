"""Episodes whose observations have several parts: each is stored, verified and sampled like an array of its own."""

import hashlib
import json

import numpy as np
import pytest
import torch
from toy_environments import Robot

from forbes.commands.episodes import check
from forbes.data import Replay, SequenceBatch, SequenceDataModule
from forbes.data.episodes.collection import collect_episodes, describe_environment, play, random_policy
from forbes.data.episodes.episode import DamagedEpisodeError, Episode, pack_episode
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter
from forbes.data.source import check_batch
from forbes.errors import ForbesError

ENVIRONMENT = describe_environment(Robot())


def episode(number):
    return play(Robot(), random_policy(Robot(), number), number)


@pytest.fixture
def store(tmp_path):
    """The path of a store of four episodes of the robot."""
    with EpisodeWriter(tmp_path / "store") as writer:
        for number in range(4):
            writer.append(episode(number), seed=number, policy="random", environment=ENVIRONMENT)
    return tmp_path / "store"


def test_what_was_stored_comes_back_bit_for_bit(store):
    opened = EpisodeStore(store)

    for number in range(4):
        found, expected = opened.episode(number), episode(number)
        assert {*found.observation} == {"camera", "joint"}
        for part in found.observation:
            assert found.observation[part].dtype == expected.observation[part].dtype
            np.testing.assert_array_equal(found.observation[part], expected.observation[part])
        np.testing.assert_array_equal(found.action, expected.action)
        np.testing.assert_array_equal(found.reward, expected.reward)
    assert opened.records[0].environment["observation_shape"] == {"camera": [1, 6, 6], "joint": [2]}


def test_each_part_is_a_member_that_numpy_reads(store):
    with np.load(store / "000000.npz") as arrays:
        assert arrays.files == ["observation/camera", "observation/joint", "action", "reward", "meta"]
        np.testing.assert_array_equal(arrays["observation/camera"], episode(0).observation["camera"])


def test_the_file_of_one_array_is_the_same_bytes_as_before_parts():
    zeros = np.zeros((3, 2), np.float32)
    content = pack_episode(Episode(zeros, zeros[:, :1], zeros[:, 0], False, 2), {"number": 0})

    assert hashlib.sha256(content).hexdigest() == SHA256_BEFORE_PARTS


SHA256_BEFORE_PARTS = "2a1105c7e08f0f94a3237c2c2a931511430cf65a0f7823a47fa8549598c2ca44"
"""Of the same call at the commit before observations had parts."""


def test_a_lost_index_is_rebuilt_from_the_files(store, capsys):
    (store / "index.jsonl").unlink()

    with EpisodeWriter(store) as writer:
        assert [*writer.records] == [0, 1, 2, 3]


def test_segments_are_those_of_the_episodes(store):
    source, length = Replay(str(store), hold_out=0), 4
    index = torch.arange(source.size("train"))

    batch = source.decode(source.gather("train", index, length))

    for row, (number, start) in enumerate((number, start) for number in range(4) for start in range(10)):
        expected = episode(number)
        steps = min(length, 10 - start)
        for part, values in expected.observation.items():
            np.testing.assert_array_equal(batch.observation[part][row, :steps], values[start : start + steps])
            assert not batch.observation[part][row, steps:].any()
        np.testing.assert_array_equal(batch.action[row, :steps], expected.action[start : start + steps])
        assert batch.mask[row].sum() == steps


def test_batches_move_cut_and_split_every_part(store):
    data = SequenceDataModule(Replay(str(store), hold_out=0), batch_size=4, length=6)
    batch = next(iter(data.train_dataloader()))
    batch = data.on_after_batch_transfer(batch, 0)

    assert batch.observation["camera"].shape == (4, 6, 1, 6, 6)
    assert batch.first(2).observation["joint"].shape == (4, 2, 2)
    assert torch.equal(batch.after(2).observation["joint"], batch.observation["joint"][:, 2:])
    assert batch.rows(slice(1, 3)).observation["camera"].shape == (2, 6, 1, 6, 6)
    assert batch.to("meta").observation["camera"].is_meta
    assert "observation={camera: uint8 (4, 6, 1, 6, 6), joint: float32 (4, 6, 2)}" in repr(batch)


def test_collected_episodes_have_the_parts(tmp_path):
    with EpisodeWriter(tmp_path) as writer:
        [record] = collect_episodes(Robot(), writer, random_policy, "random", until=1, seed=3)

    assert record.environment["observation_shape"] == {"camera": [1, 6, 6], "joint": [2]}
    assert EpisodeStore(tmp_path).episode(0).observation["joint"].shape == (10, 2)


@pytest.mark.parametrize("part", ["camera", "joint"])
def test_a_damaged_part_is_found_and_quarantined(store, part, capsys):
    path = store / "000002.npz"
    content = bytearray(path.read_bytes())
    values = np.load(path)[f"observation/{part}"].tobytes()
    content[content.index(values) + len(values) // 2] ^= 1
    path.write_bytes(content)

    with pytest.raises(DamagedEpisodeError, match="sha256"):
        EpisodeStore(store).episode(2)
    assert check(store) == 1
    assert [*EpisodeStore(store).records] == [0, 1, 3]


def changed(**parts):
    found = episode(0)
    return found._replace(observation={k: v for k, v in (found.observation | parts).items() if v is not None})


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (changed(joint=None), "observation_shape is .*'joint'.*, that of its arrays"),
        (changed(sound=np.zeros((10, 1), np.float32)), "observation_shape is .*, that of its arrays .*sound"),
        (changed(joint=np.zeros((10, 2))), "its observation/joint is float64"),
        (changed(joint=np.zeros((9, 2), np.float32)), "its observation/joint is float32 .9, 2., expected .* with 10"),
        (changed(joint=np.full((10, 2), np.nan, np.float32)), "its observation/joint is not finite at step 0"),
        (changed(**{"../up": np.zeros((10, 2), np.float32)}), "parts named .*, expected letters, digits, _ and -"),
        (episode(0)._replace(observation={}), "at least one part"),
        (episode(0)._replace(observation=np.zeros((10, 2), np.float32)), "that of its arrays .2"),
    ],
    ids=["missing", "unknown", "dtype", "length", "not finite", "name", "none", "one array"],
)
def test_what_could_not_be_read_again_is_refused(tmp_path, wrong, sentence):
    with EpisodeWriter(tmp_path) as writer, pytest.raises(ForbesError, match=sentence):
        writer.append(wrong, seed=0, policy="random", environment=ENVIRONMENT)

    assert not EpisodeStore(tmp_path).records


def test_an_index_with_an_invalid_name_of_a_part_is_refused(store):
    line = json.loads((store / "index.jsonl").read_text().splitlines()[0])
    line["environment"]["observation_shape"] = {"../camera": [1, 6, 6]}
    (store / "index.jsonl").write_text(json.dumps(line) + "\n")

    with pytest.raises(ForbesError, match="observation_shape is"):
        EpisodeStore(store)


def test_a_batch_without_a_part_is_refused(store):
    source = Replay(str(store), hold_out=0)
    batch = source.decode(source.gather("train", torch.arange(2), 3))

    with pytest.raises(ForbesError, match="decode returns observation joint, expected observation camera, observation"):
        check_batch(source, batch._replace(observation={"joint": batch.observation["joint"]}))
    double = batch.observation | {"joint": batch.observation["joint"].double()}
    with pytest.raises(ForbesError, match="decode returns observation joint float64"):
        check_batch(source, SequenceBatch(double, *batch[1:]))
