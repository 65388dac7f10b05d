"""What `forbes evaluate` says of agents."""

import shutil

import numpy as np
import pytest
from small_agents import fit, forbes, write_config

from forbes.control.agent import Agent
from forbes.data.episodes.store import EpisodeStore
from forbes.evaluation.record import read_arrays, read_record
from forbes.seeding import derive_seed
from forbes.training.loading import load_run

NAME = "return[episodes=3]"


@pytest.fixture(scope="module")
def run(small_agent, tmp_path_factory):
    return shutil.copytree(small_agent, tmp_path_factory.mktemp("agent") / "run")


def test_the_return_is_what_the_agent_earns_without_exploration(run, capsys):
    """A parrot pays what it is told, so the return is the sum of the actions."""
    assert forbes("evaluate", run, "--episodes", 3, "--seed", 5) == 0

    module, data = load_run(run)
    earned = []
    for number in range(3):
        seed = derive_seed(5, "test episode", number) % 2**32
        agent = Agent(module.model, module.action_selector(exploring=False), seed)
        actions, shown = [], [seed % 97, 0]
        for step in range(8):
            action = agent(np.array(shown, np.float32))
            actions.append(action[0])
            shown = [action[0], step + 1]
        earned.append(sum(actions))
    data.source.close()
    entry = read_record(str(run))[NAME]
    np.testing.assert_allclose(entry["returns"], earned, rtol=1e-5)
    assert entry["mean"] == pytest.approx(np.mean(earned), rel=1e-5)
    assert entry["standard_error"] == pytest.approx(np.std(earned, ddof=1) / np.sqrt(3), rel=1e-5)
    np.testing.assert_array_equal(read_arrays(str(run))[NAME], entry["returns"])
    assert entry["environment"]["task"] == "Parrot"
    assert entry["command"].startswith("forbes --allow-module toy_environments evaluate")
    assert "ImaginationActorCritic" in capsys.readouterr().out


def test_a_record_names_the_agent_that_has_played(run, tmp_path, overwritten):
    shutil.copytree(run, copy := tmp_path / "copy")

    assert forbes("evaluate", copy, "--episodes", 3) == 0

    (read,) = overwritten.values()
    assert {entry["checkpoint"] for entry in read_record(copy).values()} == {read}


def test_every_agent_plays_the_same_episodes(run, tmp_path, capsys):
    shutil.copytree(run, twin := tmp_path / "twin")

    assert forbes("evaluate", run, twin, "--episodes", 3) == 0

    assert "paired: 0.00 ± 0.00" in " ".join(capsys.readouterr().out.split())


def test_acting_on_many_trajectories_is_a_measurement_of_its_own(run, capsys):
    """It takes another action, and is kept beside what the agent earns by a guess."""
    assert forbes("evaluate", run, "--episodes", 3) == 0
    assert forbes("evaluate", run, "--episodes", 3, "--acting-samples", 4) == 0

    record = read_record(str(run))
    guess, many = (record[name]["returns"] for name in (NAME, "return[episodes=3,K=4]"))
    assert len(many) == 3
    assert guess != many
    assert "reward_explained[ahead=1,S=16,episodes=3,K=4]" in record
    assert "K trajectories" in capsys.readouterr().out
    assert forbes("evaluate", run, "--acting-samples", 0) == 2
    assert "--acting-samples" in capsys.readouterr().err


def test_acting_samples_are_used_to_explore_and_to_evaluate(tmp_path):
    """Unless another number is asked for."""
    runs = one, many = tmp_path / "1", tmp_path / "4"
    for run in runs:
        samples = ("--model.acting_samples", run.name, "--trainer.max_epochs", 2)
        assert fit("--config", write_config(tmp_path), *samples, "--run_dir", run) == 0

    earned = [[record.total_reward for record in EpisodeStore(run / "episodes").records.values()] for run in runs]
    assert earned[0][:2] == earned[1][:2]  # at random
    assert earned[0][2] != earned[1][2]

    assert forbes("evaluate", one, many, "--episodes", 3) == 0
    assert forbes("evaluate", many, "--episodes", 3, "--acting-samples", 1) == 0
    assert NAME in read_record(str(one))
    guess, own = (read_record(str(many))[name]["returns"] for name in (NAME, "return[episodes=3,K=4]"))
    assert guess != own


def test_agents_with_different_observations_are_compared(tmp_path, capsys):
    """What one is shown changes nothing of what is paid, so the difference has a meaning."""
    task = ("--data.source.task", "tiger", "--trainer.max_epochs", 1)
    runs = [tmp_path / shown for shown in ("observation", "exact_belief")]
    for run in runs:
        options = ("--data.source.options", f"{{shows: {run.name}}}")
        assert fit("--config", write_config(tmp_path), *task, *options, "--run_dir", run) == 0

    assert forbes("evaluate", *runs, "--episodes", 2) == 0

    assert f"{runs[0]} minus {runs[1]}, paired:" in " ".join(capsys.readouterr().out.split())


def test_refuses_what_cannot_be_compared(run, tiny_run, tmp_path, capsys):
    shutil.copytree(run, other := tmp_path / "other")
    (other / "evaluation.json").unlink(missing_ok=True)
    config = other / "config.yaml"
    config.write_text(config.read_text().replace("steps: 8", "steps: 9"))

    for arguments, message in [
        ((run, other), "its task is Parrot"),
        ((run, tiny_run), "not the run of an agent"),
        ((run, "--episodes", 1), "--episodes 1: a standard error needs at least 2"),
    ]:
        assert forbes("evaluate", *arguments) == 2
        assert message in (err := capsys.readouterr().err)
        assert f"{other}: 1/" not in err  # it says so before it plays
    assert not (other / "evaluation.json").exists()
    assert read_record(str(run))["return[episodes=10]"]  # and what was played before is kept


def test_seeds_of_several_methods_are_summarised(tmp_path, capsys):
    runs = [tmp_path / f"{kind}-{seed}" for kind in ("forbes", "dreamer") for seed in (0, 1)]
    for run in runs:
        kind, seed = run.name.split("-")
        brief = ("--trainer.max_epochs", 1, "--seed_everything", seed)
        assert fit("--config", write_config(tmp_path, kind), *brief, "--run_dir", run) == 0

    assert forbes("evaluate", *runs, "--episodes", 2) == 0

    means = [read_record(str(run))["return[episodes=2]"]["mean"] for run in runs]
    wins = np.mean([(np.sign(one - other) + 1) / 2 for one in means[:2] for other in means[2:]])  # a tie is half
    out = capsys.readouterr().out
    assert "interquartile mean over seeds" in out
    assert f"FORBES   {np.mean(means[:2]):.2f} [{min(means[:2]):.2f}, {max(means[:2]):.2f}], 2 runs" in out
    assert f"P(FORBES > Dreamer) = {wins:.2f} [0." in out

    assert forbes("evaluate", *runs[::2], "--episodes", 2) == 0
    assert "interquartile mean" not in capsys.readouterr().out  # one seed each
