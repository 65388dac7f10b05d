"""An agent that plays while it learns, through the command line: what is stored, counted, measured and resumed."""

import errno
import os
import shutil
import signal
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pandas as pd
import pytest
import torch
from lightning import Trainer
from small_agents import fit, forbes, write_config

from forbes.data.episodes.store import EpisodeStore
from forbes.data.episodes.worker import EpisodeWorker
from forbes.envs import EnvironmentProcess
from forbes.evaluation.reward_prediction import predict_rewards, r2_score
from forbes.runs.checkpoint import read_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.saving import ResumeWholeEpochs
from forbes.seeding import derive_seed
from forbes.training import ImaginationActorCritic
from forbes.training.acting import play_measured
from forbes.training.loading import load_run


@pytest.fixture(scope="module")
def run_and_output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    with redirect_stdout(StringIO()) as output:
        assert fit("--config", write_config(folder), "--run_dir", folder / "run") == 0
    return folder / "run", output.getvalue()


@pytest.fixture(scope="module")
def run(run_and_output):
    return run_and_output[0]


def write_overlap(folder):
    """Configure the agent of `run` with episodes that are played while it learns."""
    (folder / "overlap.yaml").write_text(write_config(folder).read_text().replace("{seed", "{overlap: true, seed"))
    return folder / "overlap.yaml"


@pytest.fixture(scope="module")
def overlapped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("overlapped")
    assert fit("--config", write_overlap(folder), "--run_dir", folder / "run") == 0
    return folder / "run"


def fit_whole_and_killed(folder, monkeypatch, config):
    """Train with room for two episodes: `whole`, and `cut`, which is killed late and resumed."""
    fit_it = ("--config", config, "--data.source.capacity", 16, "--run_dir")

    def kill(self, loss):
        if self.global_step == 10:
            raise Killed

    assert fit(*fit_it, folder / "whole") == 0
    with monkeypatch.context() as patch:
        patch.setattr(ImaginationActorCritic, "on_before_backward", kill)
        with pytest.raises(Killed):
            fit(*fit_it, folder / "cut")
    assert fit("--resume", folder / "cut") == 0


class Killed(BaseException):
    """What the test kills a training with."""


def test_each_epoch_adds_one_episode_to_the_seed_episodes(run):
    records = EpisodeStore(run / "episodes").records.values()

    assert [record.policy for record in records] == ["random"] * 2 + ["ImaginationActorCritic"] * 2
    assert len({record.seed for record in records}) == 4


def test_several_episodes_an_epoch_are_kept_for_both_checkpoints(tmp_path, monkeypatch):
    """Two of the parrot's 8 steps fit, two more are those of the previous checkpoint; a kill changes nothing."""
    config = write_config(tmp_path)
    config.write_text(config.read_text().replace("{seed_episodes: 2", "{episodes: 2, seed_episodes: 2"))
    fit_whole_and_killed(tmp_path, monkeypatch, config)

    metrics = read_metrics(tmp_path / "whole")
    assert metrics["agent_steps"].dropna().tolist() == [16, 32, 48]
    records = EpisodeStore(tmp_path / "whole" / "episodes").records
    assert [*records] == [0, 1, 2, 3, 4, 5]
    newest = [records[number].total_reward for number in (4, 5)]
    assert metrics["return/exploring"].dropna().iloc[-1] == pytest.approx(sum(newest) / 2, rel=1e-6)
    pd.testing.assert_frame_equal(read_metrics(tmp_path / "cut"), metrics, check_exact=True)


def test_trainings_of_different_seeds_see_different_episodes(run, tmp_path):
    assert fit("--config", write_config(tmp_path), "--run_dir", tmp_path / "run", "--seed_everything", "1") == 0

    stores = [EpisodeStore(folder / "episodes") for folder in (run, tmp_path / "run")]
    first, second = ({record.seed for record in store.records.values()} for store in stores)
    assert len(second) == 4
    assert first.isdisjoint(second)


def test_env_steps_agent_steps_and_updates_are_counted_apart(run):
    """An episode of the parrot has 8 steps of 3 frames each."""
    metrics = read_metrics(run)

    steps = metrics["env_steps"].dropna()
    assert steps.tolist() == [2 * 24, 3 * 24, 4 * 24]
    assert metrics["agent_steps"].dropna().tolist() == [16, 24, 32]
    assert steps.index.tolist() == [4, 8, 12]


def test_the_returns_are_those_of_the_episodes(run):
    metrics, records = read_metrics(run), EpisodeStore(run / "episodes").records

    exploring = metrics["return/exploring"].dropna()
    np.testing.assert_allclose(exploring, [records[2].total_reward, records[3].total_reward], rtol=1e-6)
    assert metrics["return/acting"].notna().sum() == 2  # after epochs 2 and 3, the last


def test_reward_prediction_is_scored_on_the_measured_episodes(run):
    """By the weights of the end, which are those of the last measurement."""
    module, data = load_run(run)
    played = [play_measured(module, data.source.environment, "evaluation", 0, number) for number in range(2)]
    data.source.close()

    told = [predict_rewards(module, one, derive_seed(0, "foresight", k), "", (5,))[5] for k, one in enumerate(played)]
    share = r2_score(told, [torch.from_numpy(one.reward[1:]).double() for one in played])

    logged = read_metrics(run)["reward_explained/5"].dropna()
    assert len(logged) == 2  # after epochs 2 and 3, the last
    assert logged.iloc[-1] == pytest.approx(share, rel=1e-4)


def test_a_run_is_loaded_without_its_environment(run, monkeypatch):
    """The store knows the shapes; the environment starts when an episode is to be played."""
    (record, *_) = EpisodeStore(run / "episodes").records.values()
    with monkeypatch.context() as patch:
        patch.setattr(EnvironmentProcess, "_start", pytest.fail)
        _, data = load_run(run)
        shapes = {name: getattr(data, name) for name in ("observation_shape", "action_dim", "discrete")}

    assert shapes | {"observation_shape": list(shapes["observation_shape"])} == {
        name: record.environment[name] for name in shapes
    }
    with data.source.environment as environment:
        assert (environment.observation_shape, environment.action_dim, environment.discrete) == tuple(shapes.values())


def test_a_run_without_its_episodes_asks_its_environment(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("episodes"))

    _, data = load_run(copy)
    data.source.close()

    assert data.observation_shape == load_run(run)[1].observation_shape


@pytest.mark.parametrize("kind", ["dreamer", "planet"])
def test_every_agent_trains(kind, tmp_path):
    assert fit("--config", write_config(tmp_path, kind), "--run_dir", tmp_path / "run") == 0

    assert len(EpisodeStore(tmp_path / "run" / "episodes").records) == 4
    assert torch.isfinite(torch.tensor(read_metrics(tmp_path / "run")["train/reward"].dropna().values)).all()


def test_an_agent_of_deepmind_control_trains_reproducibly(tmp_path):
    """A thousand frames of the physics an episode, eight an action; in processes that start anew."""
    options = "{pixels: false, action_repeat: 8}"
    task = ("--data.source.task", "cartpole_balance", "--data.source.options", options)
    stores = []
    for name in ("run", "again"):
        assert fit("--config", write_config(tmp_path), *task, "--run_dir", tmp_path / name) == 0
        stores.append(EpisodeStore(tmp_path / name / "episodes"))

    assert read_metrics(tmp_path / "run")["env_steps"].dropna().tolist() == [2000, 3000, 4000]
    for number in range(4):
        first, again = (store.episode(number) for store in stores)
        assert first.observation.shape == (126, 5)
        for ours, theirs in zip(first[:3], again[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_an_agent_plays_discrete_actions_of_its_environment(tmp_path):
    """The tiger's door is opened or not, at random and by the agent; and what it plays is what it learns from."""
    config = write_config(tmp_path)
    task = ("--data.source.task", "tiger", "--data.source.options", "{}")
    assert fit("--config", config, *task, "--run_dir", tmp_path / "run") == 0

    store = EpisodeStore(tmp_path / "run" / "episodes")
    for number in range(4):
        action = store.episode(number).action[1:]  # (30, 3)
        assert set(np.unique(action)) == {0, 1}
        assert (action.sum(1) == 1).all()
    assert forbes("evaluate", tmp_path / "run", "--episodes", 2) == 0


def test_a_planner_says_that_it_has_no_discrete_actions(tmp_path, capsys):
    task = ("--data.source.task", "tiger", "--data.source.options", "{}")

    assert fit("--config", write_config(tmp_path, "planet"), *task, "--run_dir", tmp_path / "run") == 2
    assert "actions are discrete, expected vectors. Use ImaginationActorCritic" in capsys.readouterr().err


def test_warns_if_episodes_end_but_the_agent_predicts_no_end(tmp_path):
    parrot = ("--config", write_config(tmp_path), "--data.source.options", "{steps: 8, ends: true}")
    with pytest.warns(UserWarning, match="Parrot: an episode terminated.*--model.continuation true"):
        assert fit(*parrot, "--run_dir", tmp_path / "blind") == 0

    assert fit(*parrot, "--model.continuation", "true", "--run_dir", tmp_path / "run") == 0
    assert (read_metrics(tmp_path / "run")["train/continuation"] < 0).sum() == 12  # a log-probability at each update


def test_the_progress_counts_both_kinds_of_steps_beside_updates(run_and_output):
    lines = [line for line in run_and_output[1].splitlines() if line.startswith("epoch ")]
    assert [line.split("env_steps ")[1].split()[0] for line in lines] == ["48", "72", "96"]
    assert [line.split("agent_steps ")[1].split()[0] for line in lines] == ["16", "24", "32"]
    assert [line.split("update ")[1].split()[0] for line in lines] == ["4/12", "8/12", "12/12"]


def test_a_restart_reuses_only_the_episodes_it_would_play(run, tmp_path, monkeypatch):
    """Cut off in its first epoch, then begun anew in the same folder: under its seed, then under another."""
    config = write_config(tmp_path)

    def kill(self, loss):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(ImaginationActorCritic, "on_before_backward", kill)
        for seed in (1, 1, 0):
            with pytest.raises(Killed):
                fit("--config", config, "--run_dir", tmp_path / "run", "--seed_everything", seed)
            set_aside = tmp_path / "run" / "episodes" / "set_aside"
            assert len([*set_aside.glob("*.npz")]) == (2 if seed == 0 else 0)
    assert fit("--config", config, "--run_dir", tmp_path / "run") == 0

    stores = [EpisodeStore(folder / "episodes") for folder in (run, tmp_path / "run")]
    first, second = ([record.seed for record in store.records.values()] for store in stores)
    assert first == second


@pytest.mark.parametrize(("task", "what"), [("tiger", "observation"), ("mountain_hike", "action")])
def test_shapes_unlike_those_of_the_checkpoint_are_refused(run, tmp_path, capsys, task, what):
    """The parrot's observations are 2 numbers and its actions 1; the hike's actions are 2."""
    other = ("--data.source.task", task, "--data.source.options", "{}")

    assert fit("--resume", shutil.copytree(run, tmp_path / "run"), *other) == 2

    error = capsys.readouterr().err.splitlines()[-1]
    assert "that of the configured model" in error
    assert f"{what}s" in error.partition(": other sizes, or ")[2]
    assert len(EpisodeStore(tmp_path / "run" / "episodes").records) == 4


@pytest.mark.parametrize("trouble", ["raises", "rewards_nan", "sees_nan", "dies"])
def test_a_failing_environment_ends_training_and_loses_nothing(tmp_path, capsys, trouble):
    """In the fourth episode it learns from, after two that measured it; then it is well, and the run goes on."""
    options = f"{{trouble: {trouble}, ledger: {tmp_path / 'ledger'}, healthy: 5}}"
    task = ("--data.source.task", "Weary", "--data.source.options", options)

    assert fit("--config", write_config(tmp_path), *task, "--run_dir", tmp_path / "run") == 2

    error = capsys.readouterr().err.splitlines()[-1]
    assert "episode 3 failed 3 times and was not stored. Fix the environment" in error
    assert list(EpisodeStore(tmp_path / "run" / "episodes").records) == [0, 1, 2]
    assert fit("--resume", tmp_path / "run") == 0
    assert list(EpisodeStore(tmp_path / "run" / "episodes").records) == [0, 1, 2, 3]


def test_a_hanging_environment_ends_training_after_a_timeout(tmp_path, capsys):
    hangs = ("--data.source.task", "Hanging", "--data.source.options", "{}", "--data.source.timeout", 0.5)

    assert fit("--config", write_config(tmp_path), *hangs, "--run_dir", tmp_path / "run") == 2

    error = capsys.readouterr().err.splitlines()[-1]
    assert "it hangs, no answer to step within 0.5 s; episode 0 failed 3 times" in error
    for seconds in ("0", ".nan", ".inf"):
        assert fit("--config", write_config(tmp_path), "--data.source.timeout", seconds) == 2
        assert f"Experience: timeout is {float(seconds.strip('.'))}" in capsys.readouterr().err


@pytest.mark.parametrize("overlap", ["", ", overlap: true"])
def test_an_agent_gets_episodes_from_an_endless_environment(tmp_path, overlap, capsys):
    config = write_config(tmp_path)
    config.write_text(config.read_text().replace("seed_episodes: 2", f"seed_episodes: 2{overlap}"))
    endless = ("--data.source.task", "Endless", "--data.source.options", "{}", "--data.source.time_limit")

    assert fit("--config", config, *endless, 9, "--run_dir", tmp_path / "run") == 0

    records = EpisodeStore(tmp_path / "run" / "episodes").records.values()
    assert {(record.steps, record.terminated) for record in records} == {(9, False)}
    assert fit("--config", config, *endless, 0, "--run_dir", tmp_path / "other") == 2
    assert "Experience: time_limit is 0, expected at least 1 step" in capsys.readouterr().err


def test_a_disk_that_is_full_ends_the_training_and_loses_nothing(run, tmp_path, monkeypatch, capsys):
    def full(descriptor, sync=os.fsync):
        if "000003.npz" in os.readlink(f"/proc/self/fd/{descriptor}"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert fit("--config", write_config(tmp_path), "--run_dir", tmp_path / "run") == 2

    sentence = "000003.npz: cannot be written (No space left on device). Free some space, or choose another folder"
    assert capsys.readouterr().err.splitlines()[-1].endswith(sentence)
    assert fit("--resume", tmp_path / "run") == 0
    pd.testing.assert_frame_equal(read_metrics(tmp_path / "run"), read_metrics(run), check_exact=True)


def test_an_agent_keeps_episodes_up_to_capacity_but_counts_all(run, tmp_path, monkeypatch):
    """Two of the parrot's, of 8 steps, and the two before for both checkpoints; killed late, it goes on the same."""
    fit_whole_and_killed(tmp_path, monkeypatch, write_config(tmp_path))

    for folder in (tmp_path / "whole", tmp_path / "cut"):
        kept = sorted(path.name for path in (folder / "episodes").glob("*.npz"))
        assert kept == ["000000.npz", "000001.npz", "000002.npz", "000003.npz"]
    metrics = read_metrics(tmp_path / "whole")
    assert metrics["env_steps"].dropna().tolist() == read_metrics(run)["env_steps"].dropna().tolist()
    pd.testing.assert_frame_equal(read_metrics(tmp_path / "cut"), metrics, check_exact=True)


@pytest.mark.parametrize("update", [4, 6, 10])
def test_a_killed_run_resumes_to_the_same_numbers_and_episodes(run, tmp_path, monkeypatch, update):
    """Killed after the first update of an epoch or in its midst: later episodes are set aside and played anew."""

    def kill(self, loss):
        if self.global_step == update:
            raise Killed

    other = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(ImaginationActorCritic, "on_before_backward", kill)
        with pytest.raises(Killed):
            fit("--config", write_config(tmp_path), "--run_dir", other)
    assert fit("--resume", other) == 0

    pd.testing.assert_frame_equal(read_metrics(other), read_metrics(run), check_exact=True)
    state, expected = (read_checkpoint(RunFolder(path).checkpoint)["state_dict"] for path in (other, run))
    torch.testing.assert_close(state, expected, rtol=0, atol=0)
    stores = [EpisodeStore(path / "episodes") for path in (other, run)]
    for number in range(4):
        for ours, theirs in zip(*(store.episode(number)[:3] for store in stores), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert any((other / "episodes" / "set_aside").iterdir())


def test_a_kill_between_checkpoint_and_log_loses_no_line(run, tmp_path, monkeypatch):
    """After the checkpoint of the second epoch, before Lightning logs what that epoch has measured."""
    save_checkpoint = Trainer.save_checkpoint

    def save_and_die(self, path, *args, **kwargs):
        save_checkpoint(self, path, *args, **kwargs)
        if self.global_step == 8:
            raise Killed

    other = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "save_checkpoint", save_and_die)
        with pytest.raises(Killed):
            fit("--config", write_config(tmp_path), "--run_dir", other)
    assert read_checkpoint(RunFolder(other).checkpoint)["global_step"] == 8
    assert fit("--resume", other) == 0

    pd.testing.assert_frame_equal(read_metrics(other), read_metrics(run), check_exact=True)


def test_no_line_of_the_log_is_written_twice(run):
    lines = RunFolder(run).metrics.read_text().splitlines()

    assert len(lines) == len(set(lines))
    assert sum("env_steps" in line for line in lines) == 3  # one an epoch


def test_a_resumed_run_learns_at_the_rates_it_is_given(run, tmp_path):
    """At rates of 0 it stays what it was."""
    other = shutil.copytree(run, tmp_path / "run")
    rates = [f"--model.{name}=0" for name in ("learning_rate", "actor_rate", "critic_rate")]
    assert fit("--resume", other, *rates, "--trainer.max_epochs", 5) == 0

    state, expected = (read_checkpoint(RunFolder(path).checkpoint)["state_dict"] for path in (other, run))
    torch.testing.assert_close(state, expected, rtol=0, atol=0)
    assert len(read_metrics(other)) == 20


def test_overlapped_episodes_lag_one_epoch_and_resume_exactly(run, overlapped, tmp_path, monkeypatch):
    """The first epoch's agent plays the third episode, as without; from then on it is always one epoch behind."""

    def kill(self, loss):
        if self.global_step == 6:
            raise Killed

    cut = tmp_path / "cut"
    with monkeypatch.context() as patch:
        patch.setattr(ImaginationActorCritic, "on_before_backward", kill)
        with pytest.raises(Killed):
            fit("--config", write_overlap(tmp_path), "--run_dir", cut)
    assert fit("--resume", cut) == 0

    pd.testing.assert_frame_equal(read_metrics(cut), read_metrics(overlapped), check_exact=True)
    stores = [EpisodeStore(path / "episodes") for path in (overlapped, cut, run)]
    actions = [[store.episode(number).action for number in store.records] for store in stores]
    assert [len(each) for each in actions] == [5, 5, 4]
    np.testing.assert_array_equal(actions[0], actions[1])
    np.testing.assert_array_equal(actions[0][:2], actions[2][:2])
    assert (actions[0][2] != actions[2][2]).any()  # without, the first epoch's updates come before it is played


@pytest.mark.parametrize(("whole", "write"), [("run", write_config), ("overlapped", write_overlap)])
@pytest.mark.parametrize("update", [0, 5, 7])
def test_a_signal_ends_training_after_an_epoch_losing_nothing(
    tmp_path, monkeypatch, capfd, request, whole, write, update
):
    """At the first update, in the midst of the second epoch, and at the last of it; resumed, nothing is missing."""

    def interrupt(self, loss):
        if self.global_step == update:
            os.kill(os.getpid(), signal.SIGINT)

    whole, stopped = request.getfixturevalue(whole), tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(ImaginationActorCritic, "on_before_backward", interrupt)
        assert fit("--config", write(tmp_path), "--run_dir", stopped) == 130
    said = capfd.readouterr()
    assert "stopping after this epoch" in said.err
    assert f"stopped at update {4 * (update // 4 + 1)}" in said.out

    assert fit("--resume", stopped) == 0

    pd.testing.assert_frame_equal(read_metrics(stopped), read_metrics(whole), check_exact=True)
    state, expected = (read_checkpoint(RunFolder(path).checkpoint)["state_dict"] for path in (stopped, whole))
    torch.testing.assert_close(state, expected, rtol=0, atol=0)


def test_a_signal_before_training_stops_it_after_one_epoch(tmp_path, monkeypatch):
    """There Lightning's own handler receives it, which would end the loop within the epoch."""
    monkeypatch.setattr(ResumeWholeEpochs, "on_train_start", lambda *_: os.kill(os.getpid(), signal.SIGTERM))

    assert fit("--config", write_config(tmp_path), "--run_dir", tmp_path / "run") == 128 + signal.SIGTERM

    assert read_checkpoint(RunFolder(tmp_path / "run").checkpoint)["global_step"] == 4


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_group_signal_while_the_player_starts_loses_nothing(tmp_path, monkeypatch, number):
    """The player gets it before Python has begun there; `tests/envs/test_worker.py` has the same of an environment."""
    start = EpisodeWorker._start

    def start_and_send(self):
        start(self)
        os.kill(self._process.pid, number)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(EpisodeWorker, "_start", start_and_send)

    assert fit("--config", write_overlap(tmp_path), "--run_dir", tmp_path / "run") == 128 + number

    assert read_checkpoint(RunFolder(tmp_path / "run").checkpoint)["global_step"] == 4


def test_a_finished_run_can_be_made_longer(run, tmp_path):
    """Two epochs and one more are three."""
    other = tmp_path / "run"
    assert fit("--config", write_config(tmp_path), "--run_dir", other, "--trainer.max_epochs", 2) == 0
    shutil.copytree(other, moved := tmp_path / "moved")

    assert fit("--resume", moved, "--trainer.max_epochs", 3) == 0

    state, expected = (read_checkpoint(RunFolder(path).checkpoint)["state_dict"] for path in (moved, run))
    torch.testing.assert_close(state, expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("Parrot", "Parot"), "Parot: no such task. Did you mean Parrot?"),
        (("steps: 8", "length: 8"), "Parrot: its environment has no option length"),
        (("seed_episodes: 2", "seed_episodes: 0"), "Collect: seed_episodes is 0, expected at least 1"),
        (
            ("{seed", "{overlap: true, episodes: 2, seed"),
            "Collect: overlap plays one episode at a time, found episodes 2",
        ),
        (("{seed", "{overlap: true, per_rank: true, seed"), "overlap plays one episode at a time, found per_rank"),
        (("class_path: ImaginationActorCritic", "class_path: WorldModel"), "Collect: found a WorldModel on Experience"),
        (("horizon: 3", "model: VectorModel"), "its model is a VectorModel, expected a StateSpaceModel"),
    ],
)
def test_refuses_what_cannot_be(tmp_path, capsys, change, message):
    config = write_config(tmp_path)
    text = config.read_text().replace(*change)
    if "WorldModel" in change[1]:
        text = text.replace("    horizon: 3\n", "").replace("    control_dim: 8\n", "")
    if "VectorModel" in change[1]:
        text = text.replace("state_dim: 2", "state_dim: 0")
    config.write_text(text)

    assert fit("--config", config, "--run_dir", tmp_path / "run") == 2
    assert message in capsys.readouterr().err
