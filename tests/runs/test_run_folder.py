"""Run folders: names, locks, and metrics that survive kills."""

import json

import pytest

from forbes.errors import ForbesError
from forbes.runs.folder import RunFolder, experiment_name, read_config, read_metrics
from forbes.runs.metrics_log import JsonLinesLogger


@pytest.mark.parametrize(
    ("config", "name"),
    [
        ("configs/strokes/forbes.yaml", "strokes/forbes"),
        ("/home/me/configs/strokes/paper/rssm.yaml", "strokes/paper/rssm"),
        ("mine.yaml", "mine"),
        ("elsewhere/mine.yaml", "mine"),
    ],
)
def test_an_experiment_is_named_after_its_configuration(config, name):
    assert experiment_name([config, "configs/debug.yaml"]) == name


def test_runs_that_start_in_the_same_second_have_folders_of_their_own(in_tmp_path):
    folders = {RunFolder.new("strokes/forbes", "20260101-120000", seed=3).path for _ in range(3)}

    assert {folder.name for folder in folders} == {"20260101-120000-3", "20260101-120000-3-2", "20260101-120000-3-3"}
    assert all(folder.is_dir() for folder in folders)


def test_what_a_killed_process_has_left_half_written_is_removed(tmp_path):
    halves = [".config.yaml.0f", ".provenance.json.0f", "checkpoints/.last.ckpt.0f", "checkpoints/.best.ckpt.part"]
    for name in [*halves, ".evaluation.json.0f"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    with RunFolder(tmp_path).locked():
        left = {path.name for path in tmp_path.rglob("*") if path.is_file()}

    assert left == {".lock", ".evaluation.json.0f"}  # another process may be writing this


def test_a_second_process_cannot_enter_a_run_folder(tmp_path):
    with RunFolder(tmp_path).locked():
        with pytest.raises(ForbesError, match=r"process \d+ on .* trains here"), RunFolder(tmp_path).locked():
            pass
    with RunFolder(tmp_path).locked():
        pass


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (None, "no such run folder"),
        ([], "not a run folder, config.yaml is missing"),
        (["config.yaml"], "has no checkpoint yet"),
    ],
)
def test_a_folder_without_a_trained_run_is_one_sentence(tmp_path, files, message):
    run = tmp_path / "run"
    if files is not None:
        run.mkdir()
        for file in files:
            (run / file).touch()

    with pytest.raises(ForbesError, match=message):
        RunFolder.trained(run)


def log(run, first, last, value):
    """Log as a trainer does: `step` is the index of the last update."""
    logger = JsonLinesLogger(run / "metrics.jsonl")
    logger.mark_start(first)
    for update in range(first + 1, last + 1):
        logger.log_metrics({"train/elbo": value, "epoch": 0}, step=update - 1)
    return logger


def test_metrics_are_a_row_an_update_and_a_column_a_name(tmp_path):
    logger = log(tmp_path, first=0, last=2, value=1.5)
    logger.log_metrics({"val/elbo": -2.0, "epoch": 0}, step=1)

    table = read_metrics(tmp_path)

    assert list(table.index) == [1, 2]
    assert table["train/elbo"].tolist() == [1.5, 1.5]
    assert table["val/elbo"].isna().tolist() == [True, False]
    assert table.loc[2, "val/elbo"] == -2.0


def test_lines_after_the_checkpoint_a_run_went_on_from_are_dropped(tmp_path):
    log(tmp_path, first=0, last=5, value=1.0)
    log(tmp_path, first=3, last=4, value=2.0)

    assert read_metrics(tmp_path)["train/elbo"].to_dict() == {1: 1.0, 2: 1.0, 3: 1.0, 4: 2.0}


@pytest.mark.parametrize("cut", [1, 10, 30])
def test_a_line_cut_short_by_a_kill_is_dropped_and_does_not_spoil_the_next(tmp_path, cut):
    log(tmp_path, first=0, last=3, value=1.0)
    content = (tmp_path / "metrics.jsonl").read_bytes()
    (tmp_path / "metrics.jsonl").write_bytes(content[:-cut])
    assert list(read_metrics(tmp_path).index) == [1, 2]

    log(tmp_path, first=2, last=4, value=2.0)

    assert read_metrics(tmp_path)["train/elbo"].to_dict() == {1: 1.0, 2: 1.0, 3: 2.0, 4: 2.0}


def test_the_log_only_grows(tmp_path):
    log(tmp_path, first=0, last=3, value=1.0)
    before = (tmp_path / "metrics.jsonl").read_text()
    log(tmp_path, first=2, last=4, value=2.0)

    after = (tmp_path / "metrics.jsonl").read_text()

    assert after.startswith(before)
    assert all("update" in json.loads(line) for line in after.splitlines())


@pytest.mark.parametrize("line", ["{", "[1]", '{"epoch": 1}', "3"])
def test_a_line_that_is_no_line_of_metrics_is_named(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_text('{"update": 1}\n' + line + "\n")

    with pytest.raises(ForbesError, match=r"metrics\.jsonl: line 2 is not a line of metrics"):
        read_metrics(tmp_path)


def test_missing_metrics_are_one_sentence(tmp_path):
    with pytest.raises(ForbesError, match=r"metrics\.jsonl: no such file"):
        read_metrics(tmp_path)


def test_an_older_run_says_the_public_names_of_its_classes(tmp_path):
    """A run of a version that wrote the packages of its classes has the same configuration as a run of today."""
    older = (
        "model: {class_path: forbes.training.WorldModel, init_args: {belief: {class_path: forbes.beliefs.FlowBelief}}}"
    )
    path = tmp_path / "config.yaml"
    path.write_text(f"{older}\ndata: {{class_path: forbes.data.SequenceDataModule}}\n")

    config = read_config(path)

    assert config["model"] == {
        "class_path": "forbes.WorldModel",
        "init_args": {"belief": {"class_path": "forbes.FlowBelief"}},
    }
    assert config["data"]["class_path"] == "forbes.SequenceDataModule"
