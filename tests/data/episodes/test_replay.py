"""Stored episodes as data: which windows are drawn, how often, and that none is one step aside."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_environments import Echo

from forbes.commands.cli import main
from forbes.data import Experience, Replay, SequenceDataModule
from forbes.data.episodes.collection import play, random_policy
from forbes.data.episodes.episode import Episode, pack_episode
from forbes.data.episodes.store import EpisodeWriter
from forbes.errors import ForbesError
from forbes.runs.checkpoint import read_checkpoint

LENGTHS = [5, 9, 21]
"""Observations of three episodes."""
ENVIRONMENT = {"task": "Counting", "observation_shape": [2], "action_dim": 1, "discrete": False}


def add(path, lengths, terminated=False):
    """Add episodes whose observations say (number, time)."""
    with EpisodeWriter(path) as writer:
        for length in lengths:
            time = np.arange(length, dtype=np.float32)
            observation = np.stack([np.full_like(time, writer.watermark), time], 1)
            whole = Episode(observation, time[:, None] / 100, time / 10, terminated, frames=length - 1)
            writer.append(whole, seed=0, policy="test", environment=ENVIRONMENT)


@pytest.fixture
def path(tmp_path):
    add(tmp_path / "store", LENGTHS)
    return tmp_path / "store"


def drawn(source, batches, batch_size, length, seed=0):
    """Windows of training batches as `(N, T, 2)`: episode and time of each step."""
    index = torch.cat([source.train_index(batch_size, length, seed, update) for update in range(batches)])
    return source.decode(source.gather("train", index, length))


@pytest.mark.parametrize("terminated", [True, False])
def test_a_window_says_where_its_episode_ended_by_itself(tmp_path, terminated):
    """In the last step of the episode and nowhere else; not where a window or a time limit ends."""
    add(tmp_path / "store", LENGTHS, terminated)
    source = Replay(str(tmp_path / "store"), hold_out=0)
    batch = source.decode(source.gather("train", torch.arange(source.size("train")), 4))

    lengths = torch.tensor(LENGTHS)[batch.observation[:, 0, 0].long()]  # (N,)
    last = batch.observation[..., 1] == lengths[:, None] - 1  # (N, 4)
    assert last.any(1).sum() > 10
    assert torch.equal(batch.ended, last & batch.mask & terminated)


def test_windows_are_uniform_over_episodes_then_over_starts(path):
    length, count = 4, 20_000
    batch = drawn(Replay(str(path), hold_out=0), 400, 50, length)

    first = batch.observation[:, 0].long()  # (N, 2)
    statistic, cells = 0.0, 0
    for number, observations in enumerate(LENGTHS):
        starts = observations - length + 1
        expected = count / len(LENGTHS) / starts
        seen = first[first[:, 0] == number, 1].bincount(minlength=starts)
        assert len(seen) == starts  # the last frame is drawn, and none beyond it
        statistic += ((seen - expected).square() / expected).sum().item()
        cells += starts
    # Chi-square with cells - 1 degrees of freedom: mean k, variance 2 k.
    assert statistic < cells - 1 + 5 * math.sqrt(2 * (cells - 1))


def test_no_window_crosses_episodes_and_steps_follow_each_other(path):
    batch = drawn(Replay(str(path), hold_out=0), 40, 50, 4)

    number, time = batch.observation.unbind(-1)  # (N, T)
    assert (number == number[:, :1]).all()
    assert (time.diff(dim=1) == 1).all()
    assert batch.mask.all()
    torch.testing.assert_close(batch.action.squeeze(-1), time / 100)  # a window begins with the action that led there
    torch.testing.assert_close(batch.reward, time / 10)


def test_an_episode_shorter_than_a_window_is_padded(path):
    batch = drawn(Replay(str(path), hold_out=0), 20, 50, 9)

    short = batch.observation[:, 0, 0] == 0
    assert short.any()
    assert batch.observation[short][:, 0, 1].eq(0).all()  # it is shown from its beginning
    assert batch.mask[short].sum(1).eq(5).all()
    assert batch.mask[~short].all()
    for values in (batch.observation, batch.action, batch.reward):
        assert not values[~batch.mask].any()


def test_observations_follow_from_the_action_of_their_index(tmp_path):
    """In this environment the next observation and the reward are the action: one step aside, and nothing agrees."""
    with EpisodeWriter(tmp_path / "echo") as writer:
        for seed in range(4):
            episode = play(Echo(20), random_policy(Echo(20), seed), seed)
            about = {"task": "Echo", "observation_shape": [2], "action_dim": 1, "discrete": False}
            writer.append(episode, seed, "random", about)

    batch = drawn(Replay(str(tmp_path / "echo"), hold_out=0), 10, 20, 7)

    seen, time = batch.observation.unbind(-1)  # (N, T)
    later = time > 0
    assert torch.equal(seen[later], batch.action.squeeze(-1)[later])
    assert torch.equal(seen[later], batch.reward[later])
    assert not batch.action[~later].any()
    assert not batch.reward[~later].any()
    assert seen[later].abs().min() > 0


def test_a_batch_depends_on_seed_update_and_held_episodes_only(path):
    source = Replay(str(path), hold_out=0)
    before = source.train_index(50, 4, 3, 17)

    assert torch.equal(Replay(str(path), hold_out=0).train_index(50, 4, 3, 17), before)
    assert not torch.equal(source.train_index(50, 4, 3, 18), before)
    assert not torch.equal(source.train_index(50, 4, 4, 17), before)

    add(path, [30, 30])
    assert torch.equal(source.train_index(50, 4, 3, 17), before)  # not yet seen
    source.refresh()
    assert not torch.equal(source.train_index(50, 4, 3, 17), before)
    with EpisodeWriter(path) as writer:
        writer.set_aside(3)  # as on resuming from a checkpoint
    source.refresh()
    assert torch.equal(source.train_index(50, 4, 3, 17), before)


def test_a_resumed_run_sees_the_episodes_that_there_were(path):
    first = SequenceDataModule(Replay(str(path), hold_out=0), batch_size=50, length=4)
    batches, sha256 = [first.train_index(update) for update in range(3)], first.source.sha256()
    checkpoint = first.state_dict()
    add(path, [30, 30])
    second = SequenceDataModule(Replay(str(path), hold_out=0), batch_size=50, length=4)
    assert not torch.equal(second.train_index(0), batches[0])

    second.load_state_dict(checkpoint)

    assert all(torch.equal(second.train_index(update), batch) for update, batch in enumerate(batches))
    assert second.source.sha256() == sha256
    with pytest.raises(ForbesError, match=r"has 5 episodes, expected the 6 of the checkpoint\. Name the folder"):
        second.load_state_dict({"watermark": 6})


def test_a_capacity_holds_the_latest_episodes(path):
    source = Replay(str(path), hold_out=0, capacity=28)

    assert drawn(source, 20, 50, 4).observation[..., 0].unique().tolist() == [1, 2]


def test_each_held_out_split_keeps_its_tenth_of_the_episodes(tmp_path):
    path = str(tmp_path / "store")
    add(path, [6] * 12)
    source = Replay(path)
    splits = [source.split_of(number) for number in range(24)]
    add(path, [6] * 12)
    source.refresh()

    assert splits == [source.split_of(number) for number in range(24)]
    assert [number for number in range(24) if splits[number] == "validation"] == [8, 18]
    assert [number for number in range(24) if splits[number] == "test"] == [9, 19]
    assert set(drawn(source, 40, 50, 3).observation[..., 0].unique().tolist()) == set(range(24)) - {8, 9, 18, 19}


def test_held_out_windows_tile_their_episodes_without_rests(tmp_path):
    """A window of one step would be a sequence that no score is about, and that none of a context can score."""
    path = str(tmp_path / "store")
    add(path, [5, 5, 23, 5, 5, 11, 5, 5, 6])
    data = SequenceDataModule(Replay(path, hold_out=3, stride=10), batch_size=2, length=10)

    batches = [data.on_after_batch_transfer(compact, 0) for compact in data.test_dataloader()]
    number, time = (torch.cat([batch.observation[..., k] for batch in batches]) for k in (0, 1))
    mask = torch.cat([batch.mask for batch in batches])

    assert number[:, 0].tolist() == [2, 2, 5, 8]
    assert time[:, 0].tolist() == [0, 10, 0, 0]
    assert mask.sum(1).tolist() == [10, 10, 10, 6]
    assert sum(len(batch.mask) for batch in batches) == data.source.size("test")


def test_each_index_of_the_training_split_is_its_own_window(path):
    source = Replay(str(path), hold_out=0)

    batch = source.decode(source.gather("train", torch.arange(source.size("train")), 2))

    expected = [[number, time] for number, length in enumerate(LENGTHS) for time in range(length)]
    assert batch.observation[:, 0].long().tolist() == expected


def anonymous_memory():
    """KiB of this process that the system cannot drop: pages of mapped files are not among them."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("RssAnon"))


def test_memory_does_not_grow_with_the_store(tmp_path):
    """A sparse store of 300 MiB: its black frames take no room on the disk, but they would in memory."""
    path, copies, steps = tmp_path / "store", 6, 4400
    limit = 100 * 2**20
    frames = np.zeros((steps, 3, 64, 64), np.uint8)
    whole = Episode(frames, np.zeros((steps, 1), np.float32), np.zeros(steps, np.float32), False, steps - 1)
    about = {"task": "Night", "observation_shape": [3, 64, 64], "action_dim": 1, "discrete": False}
    with EpisodeWriter(path) as writer:
        record = writer.append(whole, seed=0, policy="test", environment=about)
        content = writer.file(0).read_bytes()
        size, tail = len(content), content[frames.nbytes // 2 :].lstrip(b"\0")
        head = content[: frames.nbytes // 2].rstrip(b"\0")
        for number in range(copies):
            with writer.file(number).open("wb") as file:  # the same bytes, with a hole
                file.write(head)
                file.seek(size - len(tail))
                file.write(tail)
            if number:
                writer.index.append(record._replace(number=number)._asdict())
    assert pack_episode(whole, {})[:30] == content[:30]
    assert sum(file.stat().st_size for file in path.glob("*.npz")) > 3 * limit
    del frames, whole, content
    source = Replay(str(path), hold_out=0)

    before = anonymous_memory()
    for update in range(40):
        source.gather("train", source.train_index(16, 16, 0, update), 16)

    assert (anonymous_memory() - before) * 1024 < limit


def test_it_trains_a_world_model(tmp_path, tiny_config, in_tmp_path):
    add("store", [9] * 12)
    flags = {
        "data.source": "Replay",
        "data.source.path": "store",
        "data.source.stride": 6,
        "model.likelihood": "VectorNormal",
        "trainer.max_epochs": 1,
    }

    options = [f"--{name}={value}" for name, value in flags.items()]
    assert main(["fit", "--config", str(tiny_config), *options, "--run_dir", "run"]) == 0
    assert read_checkpoint(Path("run/checkpoints/last.ckpt"))["SequenceDataModule"] == {"watermark": 12}


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"capacity": 0}, "Replay: capacity is 0, expected at least 1 step, or null for all"),
        ({"hold_out": 2}, "Replay: hold_out is 2, expected 0 or at least 3"),
        ({"stride": 0}, "Replay: stride is 0, expected at least 1"),
    ],
)
def test_numbers_that_cannot_be_are_one_sentence(path, options, sentence):
    with pytest.raises(ForbesError, match=sentence):
        Replay(str(path), **options)


def test_an_empty_store_and_an_empty_split_are_one_sentence(tmp_path, path):
    with pytest.raises(ForbesError, match=r"absent: no such folder\. Name one that has episodes, or collect some: "):
        Replay(str(tmp_path / "absent"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ForbesError, match=r"empty: there are no episodes\. Collect some: forbes data collect --task"):
        Replay(str(tmp_path / "empty"))
    with pytest.raises(ForbesError, match=r"the test split has no episodes, expected one out of 10\. Collect more"):
        next(iter(SequenceDataModule(Replay(str(path))).test_dataloader()))
    with pytest.raises(ForbesError, match=r"hold_out is 0, so the validation split has no episodes\. Set hold_out"):
        next(iter(SequenceDataModule(Replay(str(path), hold_out=0)).val_dataloader()))
    with pytest.raises(ForbesError, match="Experience: capacity is 0, expected at least 1"):
        Experience("tiger", capacity=0)


def test_a_damaged_episode_ends_the_training_with_its_name(path):
    file = path / "000001.npz"
    file.write_bytes(file.read_bytes()[:-1])
    source = Replay(str(path), hold_out=0)

    with pytest.raises(ForbesError, match=r"000001\.npz: damaged .*forbes data check"):
        source.gather("train", torch.arange(source.size("train")), 4)


def test_a_store_that_does_not_say_its_shapes_is_one_sentence(path):
    index = path / "index.jsonl"
    index.write_text(index.read_text().replace('"observation_shape": [2], ', ""))

    with pytest.raises(ForbesError, match=r"index\.jsonl: line 1 is not .* \(its environment has no observation_shape"):
        Replay(str(path))
