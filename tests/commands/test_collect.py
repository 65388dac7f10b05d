"""`forbes data collect --policy RUN`: a store that an agent adds to."""

import shutil

import numpy as np
import pytest
from small_agents import fit, forbes, write_config

from forbes.data.episodes.store import EpisodeStore


@pytest.fixture(scope="module")
def run(small_agent):
    return small_agent


def test_an_agent_plays_what_its_training_would_have_played_next(run, tmp_path, capsys):
    longer = tmp_path / "longer"
    assert fit("--config", write_config(tmp_path), "--run_dir", longer, "--trainer.max_epochs", 2) == 0
    shutil.copytree(run / "episodes", store := tmp_path / "store")

    assert forbes("data", "collect", "--policy", run, "--episodes", 3, "-o", store) == 0

    assert f"{store}: 1 episodes stored, 8 agent steps" in capsys.readouterr().out
    ours, theirs = EpisodeStore(store), EpisodeStore(longer / "episodes")
    assert len(ours.records) == len(theirs.records) == 3
    for name in ("observation", "action", "reward"):
        np.testing.assert_array_equal(getattr(ours.episode(2), name), getattr(theirs.episode(2), name))
    assert [record.policy for record in ours.records.values()][-1] == str(run)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--policy", "{run}", "--task", "Parrot"), "acts in the environment of its run, expected no --task"),
        (("--policy", "{run}", "--timeout", 3), "acts in the environment of its run, expected no --timeout"),
        (("--policy", "{run}", "--action-repeat", 3), "expected no --action-repeat"),
        (("--policy", "{world}"), "not the run of an agent, but of a WorldModel"),
        (("--policy", "randon"), "randon"),
        ((), "--policy random: needs an environment. Name one: --task TASK"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_no_folder(arguments, message, run, tiny_run, tmp_path, capsys):
    given = [str(each).format(run=run, world=tiny_run) for each in arguments]

    assert forbes("data", "collect", *given, "-o", tmp_path / "store") == 2

    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_agent_does_not_add_to_the_episodes_of_another_task(run, tmp_path, capsys):
    store = tmp_path / "hike"
    assert forbes("data", "collect", "--task", "mountain_hike", "--episodes", 1, "-o", store) == 0

    assert forbes("data", "collect", "--policy", run, "--episodes", 2, "-o", store) == 2

    assert "MountainHike" in capsys.readouterr().err
    assert len(EpisodeStore(store).records) == 1


def test_workers_play_the_same_episodes_of_an_agent(run, tmp_path):
    stores = [tmp_path / "one", tmp_path / "two"]
    for number, store in enumerate(stores, start=1):
        assert forbes("data", "collect", "--policy", run, "--episodes", 3, "--workers", number, "-o", store) == 0

    hashes = [[record.sha256 for record in EpisodeStore(store).records.values()] for store in stores]
    assert hashes[0] == hashes[1]
    assert len(set(hashes[0])) == 3
