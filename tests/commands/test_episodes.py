"""`forbes data collect`, `info` and `check`, as a user calls them."""

import re
from pathlib import Path

import numpy as np
import pytest
import toy_environments  # its classes are tasks by name, as those of --allow-module are
from command_line import error_of
from PIL import Image

from forbes.commands.cli import main
from forbes.data.episodes.store import EpisodeStore, EpisodeWriter

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A store of four episodes of pictures."""
    path = tmp_path_factory.mktemp("stores") / "pictures"
    assert issubclass(toy_environments.Pictures, toy_environments.Environment)
    assert main(["data", "collect", "--task", "Pictures", "--episodes", "4", "-o", str(path)]) == 0
    return path


def test_collecting_counts_both_steps_and_does_not_restart(pictures, capsys):
    assert main(["data", "collect", "--task", "Pictures", "--episodes", "4", "-o", str(pictures)]) == 0

    assert f"{pictures}: 0 episodes stored, 0 agent steps, 0 env steps" in capsys.readouterr().out
    records = EpisodeStore(pictures).records.values()
    assert [(record.steps, record.policy) for record in records] == [(4, "random")] * 4
    assert len({record.seed for record in records}) == 4


def test_info_says_what_there_is_and_draws_it(pictures, tmp_path, capsys):
    assert main(["data", "info", str(pictures), "-o", str(tmp_path / "strip.png")]) == 0

    output = capsys.readouterr().out
    for line in (
        r"task +Pictures",
        r"episodes +4 of 4 ever stored; 0 terminated",
        r"steps +16 agent steps, 16 env steps \(frames, with action repeat\)",
        r"return +4\.000 to 4\.000, mean 4\.000",
        r"reward per step +1\.000 to 1\.000, mean 1\.000",
        r"action 1 +-0\.\d+ to 0\.\d+, mean -?0\.\d+",
        r"policies +random: 4 episodes",
    ):
        assert re.search(line, output), line
    picture = np.asarray(Image.open(tmp_path / "strip.png"))
    white, black = ((picture[..., :3] == value).all(-1).mean() for value in (255, 0))
    assert black > 0.3  # the frames
    assert white > 0.1


def test_an_endless_episode_is_truncated_at_the_given_limit(tmp_path):
    collect = ["data", "collect", "--task", "Endless", "-o", str(tmp_path), "--episodes"]
    assert main([*collect, "2", "--time-limit", "7"]) == 0

    records = EpisodeStore(tmp_path).records.values()
    assert [(record.steps, record.terminated, record.environment["time_limit"]) for record in records] == [
        (7, False, 7)
    ] * 2


def test_a_store_of_another_limit_of_steps_is_another_store(tmp_path, capsys):
    collect = ["collect", "--task", "Parrot", "-o", tmp_path, "--episodes"]
    assert main(["data", *map(str, collect), "1"]) == 0
    sentence = "has episodes whose time_limit is 100000, not 7. Choose another folder"
    assert sentence in error_of(capsys, "data", *collect, 2, "--time-limit", 7)

    index = tmp_path / "index.jsonl"  # of a version that had no limit: one that nobody reached
    index.write_text(index.read_text().replace(', "time_limit": 100000', ""))
    assert main(["data", *map(str, collect), "2"]) == 0
    assert len(EpisodeStore(tmp_path).records) == 2


def test_a_hanging_environment_ends_collecting_cleanly(tmp_path, capsys):
    collect = [
        "data",
        "collect",
        "--task",
        "Hanging",
        "--timeout",
        "1",
        "--episodes",
        "1",
        "-o",
        str(tmp_path / "store"),
    ]

    assert main(collect) == 2

    dropped, again, error = capsys.readouterr().err.splitlines()
    for line in (dropped, again):
        assert line == "forbes: Echo: it hangs, no answer to step within 1 s; episode 0 is dropped and replayed"
    assert error == (
        "forbes: Echo: it hangs, no answer to step within 1 s; episode 0 failed 3 times and was not stored. "
        "Fix the environment"
    )
    assert not list((tmp_path / "store").glob("*.npz"))


def test_check_finds_all_whole_and_then_the_damage(pictures, tmp_path, capsys):
    store = tmp_path / "store"
    store.mkdir()
    for file in pictures.iterdir():
        if file.is_file():
            (store / file.name).write_bytes(file.read_bytes())
    assert main(["data", "check", str(store)]) == 0
    assert f"{store}: 4 episodes read, 4 intact, 0 damaged" in capsys.readouterr().out

    broken = store / "000002.npz"
    broken.write_bytes(broken.read_bytes().replace(b"\xff", b"\xfe", 1))
    assert main(["data", "check", str(store)]) == 1
    output = capsys.readouterr().out
    assert f"{broken}: damaged (its sha256 is not that of the index), moved to {store}/quarantine" in output
    assert f"{store}: 4 episodes read, 3 intact, 1 damaged" in output
    assert main(["data", "check", str(store)]) == 0
    assert list(EpisodeStore(store).records) == [0, 1, 3]


@pytest.fixture
def damaged(tmp_path, capsys):
    """A store whose one episode is cut short."""
    store = tmp_path / "damaged"
    assert main(["data", "collect", "--task", "Screen", "--episodes", "1", "-o", str(store)]) == 0
    (file,) = store.glob("*.npz")
    file.write_bytes(file.read_bytes()[:-9])
    capsys.readouterr()
    return store


def test_damaged_episodes_are_named_and_quarantine_is_reported(damaged, capsys):
    assert re.search(r"000000\.npz: damaged .*forbes data check", error_of(capsys, "data", "info", damaged))
    assert main(["data", "check", str(damaged)]) == 1
    capsys.readouterr()

    for command in ("info", "check"):
        assert error_of(capsys, "data", command, damaged) == (
            f"{damaged}: there are no episodes but 1 in quarantine. Collect some: forbes data collect --task TASK "
            f"-o {damaged}"
        )


@pytest.mark.parametrize("what", ["empty", "damaged"])
def test_a_training_on_no_whole_episode_is_one_sentence(what, damaged, tmp_path, capsys):
    store = damaged if what == "damaged" else tmp_path
    config = Path(__file__).parents[2] / "configs" / "dmc" / "world_model_rssm.yaml"
    flags = ["--data.source.path", str(store), "--data.source.hold_out", "0", "--data.length", "6"]
    small = ["--trainer.accelerator", "cpu", "--trainer.limit_val_batches", "0", "--run_dir", str(tmp_path / "run")]
    no_pictures = ["--trainer.callbacks", "null"]  # they need a validation split

    assert main(["fit", "--config", str(config), *flags, *small, *no_pictures]) == 2

    error = capsys.readouterr().err.splitlines()[-1]
    expected = "000000.npz: damaged" if what == "damaged" else "there are no episodes. Collect some"
    assert error.startswith("forbes: ")
    assert expected in error


def test_vectors_are_described_and_not_drawn(tmp_path, capsys):
    store = tmp_path / "hike"
    assert main(["data", "collect", "--task", "mountain_hike", "--episodes", "1", "-o", str(store)]) == 0
    assert main(["data", "info", str(store)]) == 0

    output = capsys.readouterr().out
    assert re.search(r"task +MountainHike", output)
    assert re.search(r"steps +75 agent steps, 75 env steps", output)
    assert not list(store.glob("*.png"))
    assert main(["data", "info", str(store), "-o", str(tmp_path / "frames.png")]) == 2
    assert "frames.png: the observations are vectors of 2, expected images" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["info", "absent"],
            "absent: no such folder. Name one that has episodes, or collect some: "
            "forbes data collect --task TASK -o absent",
        ),
        (
            ["check", "absent"],
            "absent: no such folder. Name one that has episodes, or collect some: "
            "forbes data collect --task TASK -o absent",
        ),
        (
            ["collect", "--task", "Unbuildable", "--episodes", "1", "-o", "x"],
            "Unbuildable: start raises ArithmeticError: the physics has exploded",
        ),
        (["collect", "--task", "mountain_hik", "-o", "x"], "mountain_hik: no such task. Did you mean mountain_hike?"),
        (["collect", "--task", "Picture", "-o", "x"], "Picture: no such task. Did you mean Pictures?"),
        (
            ["collect", "--task", "tiger", "--fast", "-o", "x"],
            "tiger: its environment has no option fast. Remove it",
        ),
        (["collect", "--task", "tiger", "-o", "/proc/x"], "/proc/x: no such file or directory"),
        *(
            (
                ["collect", "--task", "tiger", "-o", "x", "--timeout", seconds],
                f"forbes data collect: argument --timeout: {seconds} is not a number of seconds above 0, at most "
                "1000000. See forbes data collect --help",
            )
            for seconds in ("0", "-1", "nan", "inf", "1e9", "soon")
        ),
    ],
)
def test_what_cannot_be_is_one_sentence(arguments, sentence, in_tmp_path, capsys):
    assert error_of(capsys, "data", *arguments) == sentence
    assert list(in_tmp_path.iterdir()) == []


def test_a_misspelt_task_of_the_suite_gets_a_suggestion(tmp_path, capsys):
    arguments = ["collect", "--task", "walker_wlak", "--no-pixels", "-o", tmp_path / "store"]

    assert error_of(capsys, "data", *arguments).startswith("walker_wlak: no such task. Did you mean walker_walk")


def test_a_store_that_is_written_to_is_left_alone(pictures, capsys):
    with EpisodeWriter(pictures):
        assert "writes episodes here. Choose another folder" in error_of(capsys, "data", "check", pictures)


def test_the_environment_of_the_documentation_can_be_collected(tmp_path, monkeypatch, capsys):
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "environments.md").read_text(), re.DOTALL)
    assert len(blocks[0].strip().splitlines()) <= 20
    (tmp_path / "my_room.py").write_text(blocks[0])
    monkeypatch.syspath_prepend(str(tmp_path))
    flags = ["--task", "Room", "--allow-module", "my_room", "--episodes", "3", "-o", str(tmp_path / "room")]

    assert main(["data", "collect", *flags]) == 0

    records = list(EpisodeStore(tmp_path / "room").records.values())
    assert [record.environment["task"] for record in records] == ["Room"] * 3
    assert all(record.steps == 50 or record.terminated for record in records)
    assert main(["data", "check", str(tmp_path / "room")]) == 0
