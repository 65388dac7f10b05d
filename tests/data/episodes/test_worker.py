"""Episodes that another process plays: the same as here, by the policy as it was, and every failure is said."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from processes import ends
from toy_environments import Parrot, Troubled

from forbes.data.episodes.collection import collect_episodes, play, random_policy
from forbes.data.episodes.store import EpisodeWriter
from forbes.data.episodes.worker import EpisodeWorker, collect_in_parallel
from forbes.envs import EnvironmentProcess
from forbes.errors import ForbesError


class Said:
    """Says what its tensor holds, at every step."""

    def __init__(self, number):
        self.number = torch.full((1,), number)

    def __call__(self, environment, seed):
        return lambda observation: self.number.numpy()


@pytest.fixture(scope="module")
def player():
    with closing(EpisodeWorker(partial(Parrot, steps=8))) as player:
        yield player


def test_the_episode_is_that_of_this_process(player):
    player.begin(Said(0.5), number=0, seed=3)

    for ours, theirs in zip(player.finish(), play(Parrot(8), Said(0.5)(None, 3), 3), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_the_policy_does_not_change_while_it_plays(player):
    """Tensors sent through a pipe in torch's own way share their memory."""
    policy = Said(0.5)
    player.begin(policy, number=0, seed=3)
    policy.number.fill_(0.25)

    assert (player.finish().action[1:] == 0.5).all()


def test_one_episode_after_another(player):
    for number in range(3):
        player.begin(Said(number / 4), number, seed=number)
        assert player.finish().action[-1] == number / 4


def test_a_broken_episode_is_played_again(tmp_path):
    with closing(EpisodeWorker(partial(Troubled, "raises", tmp_path / "ledger"))) as player:
        player.begin(Said(0.5), number=0, seed=0)
        assert len(player.finish().action) == 7


@pytest.mark.parametrize("trouble", ["raises", "hangs"])
def test_an_environment_that_breaks_each_time_is_named(trouble, tmp_path):
    timeout = 0.5 if trouble == "hangs" else 60.0
    with closing(EpisodeWorker(partial(Troubled, trouble, tmp_path / "ledger", times=9), timeout)) as player:
        player.begin(Said(0.5), number=4, seed=0)
        with pytest.raises(ForbesError, match=f"{trouble}.* episode 4 failed 3 times and was not stored"):
            player.finish()


class Kills(Said):
    """Is the end of whoever asks it."""

    def __call__(self, environment, seed):
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_player_that_dies_each_time_is_named():
    with closing(EpisodeWorker(partial(Parrot, steps=8))) as player:
        player.begin(Kills(0.5), number=4, seed=0)
        with pytest.raises(ForbesError, match=r"died, exit code -9, 3 times in episode 4. Fix the error printed above"):
            player.finish()


def test_a_killed_player_restarts_and_plays_the_same_episode(capfd):
    """Killed between two episodes."""
    with closing(EpisodeWorker(partial(Parrot, steps=8))) as player:
        os.kill(player._process.pid, signal.SIGKILL)
        player._process.join()
        player.begin(Said(0.5), number=4, seed=3)
        for ours, theirs in zip(player.finish(), play(Parrot(8), Said(0.5)(None, 3), 3), strict=True):
            np.testing.assert_array_equal(ours, theirs)

    assert "died, exit code -9; episode 4 is replayed" in capfd.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_a_player_that_starts_is_left_to_its_parent(number, capfd):
    """As a terminal sends it to the whole group: before Python has begun in the new process."""
    with closing(EpisodeWorker(partial(Parrot, steps=8))) as player:
        os.kill(player._process.pid, number)
        player.begin(Said(0.5), number=0, seed=3)
        assert len(player.finish().action) == 9

    assert capfd.readouterr().err == ""


def touch_and_sleep(path):
    Path(path).touch()
    time.sleep(3600)


class SlowToImport:
    """Makes an environment, in a process that imports what it needs for an hour; a file says that it has begun."""

    def __reduce__(self):
        return touch_and_sleep, ("imports",)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("kind", ["forbes.data.episodes.worker.EpisodeWorker", "forbes.envs.EnvironmentProcess"])
def test_a_process_that_still_imports_ends_with_its_parent(tmp_path, kind):
    module, _, name = kind.rpartition(".")
    program = f"""
import multiprocessing, pathlib, threading, time
from {module} import {name}
from test_worker import SlowToImport
if __name__ == "__main__":
    threading.Thread(target={name}, args=(SlowToImport(),), daemon=True).start()
    while not pathlib.Path("imports").exists():
        time.sleep(0.01)
    print(multiprocessing.active_children()[0].pid, flush=True)
    time.sleep(3600)
"""
    (tmp_path / "parent.py").write_text(program)
    paths = os.pathsep.join([os.path.dirname(__file__), *filter(None, sys.path)])
    command, environ = [sys.executable, str(tmp_path / "parent.py")], os.environ | {"PYTHONPATH": paths}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environ, cwd=tmp_path) as parent:
        child = int(parent.stdout.readline())
        parent.kill()

    if not (ended := ends(child)):
        os.kill(child, signal.SIGKILL)
    assert ended


class Told(Said):
    """Says in a file which process its environment is."""

    def __call__(self, environment, seed):
        self.path.write_text(str(environment.describe()["process"]))
        return super().__call__(environment, seed)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_closing_a_player_within_an_episode_leaves_nothing(tmp_path):
    ledger, policy = tmp_path / "ledger", Told(0.5)
    policy.path = tmp_path / "process"
    player = EpisodeWorker(partial(Troubled, "hangs", ledger))
    player.begin(policy, number=0, seed=0)
    while not ledger.exists():  # it has begun to hang
        time.sleep(0.05)
    player.close()

    assert ends(int(policy.path.read_text()))


@pytest.mark.parametrize(("workers", "until"), [(2, 5), (4, 3)])
def test_several_workers_store_the_same_episodes(tmp_path, workers, until):
    make = partial(Parrot, steps=8)
    with EnvironmentProcess(make) as environment:
        with EpisodeWriter(tmp_path / "one") as writer:
            records = list(collect_episodes(environment, writer, random_policy, "random", until, 7))
        with EpisodeWriter(tmp_path / "many") as writer:  # the first episode is there already
            first = list(collect_episodes(environment, writer, random_policy, "random", 1, 7))
            others = list(collect_in_parallel(workers, environment, writer, random_policy, "random", until, 7))

    assert first + others == records  # also their hashes
    assert len({record.sha256 for record in records}) == until


def test_workers_end_when_one_fails(tmp_path):
    make = partial(Troubled, "raises", tmp_path / "ledger", times=100)
    before = set(multiprocessing.active_children())
    with EnvironmentProcess(partial(Parrot)) as environment, EpisodeWriter(tmp_path / "store") as writer:
        environment.make = make
        with pytest.raises(ForbesError, match="failed 3 times"):
            list(collect_in_parallel(2, environment, writer, random_policy, "random", 4, 0))

    assert set(multiprocessing.active_children()) == before
