"""An exported run is the model of its run, small and safe to share, wherever it lies."""

import json
import lzma
import shutil
from pathlib import Path

import pytest
import torch
from command_line import error_of

from forbes.commands import export
from forbes.commands.cli import main
from forbes.evaluation.record import read_record
from forbes.runs.checkpoint import compressed_checkpoint, open_checkpoint, read_checkpoint
from forbes.runs.exported import shareable
from forbes.runs.folder import RunFolder
from forbes.training.loading import load_run

FEW = ["--scores", "elbo", "--sequences", "4"]


@pytest.fixture
def run(tiny_run, tmp_path):
    return RunFolder(shutil.copytree(tiny_run, tmp_path / "run"))


@pytest.fixture
def exported(run, tmp_path):
    assert main(["export", str(run), "-o", str(tmp_path / "export")]) == 0
    return RunFolder(tmp_path / "export")


def test_an_export_has_the_weights_rounded_to_bfloat16(run, exported):
    original, _ = load_run(run.path)
    loaded, _ = load_run(exported.path)

    for (name, values), (_, found) in zip(original.named_parameters(), loaded.named_parameters(), strict=True):
        expected = values.bfloat16().float() if values.dim() > 1 else values
        torch.testing.assert_close(found, expected, rtol=0, atol=0, msg=name)
        torch.testing.assert_close(found, values, rtol=2**-8, atol=0)  # half a unit of 8 significant bits
    for (name, values), (_, found) in zip(original.named_buffers(), loaded.named_buffers(), strict=True):
        torch.testing.assert_close(found, values, rtol=0, atol=0, msg=name)


def test_an_export_has_no_optimizer_and_is_smaller(run, exported):
    assert read_checkpoint(exported.checkpoint).keys() & {"optimizer_states", "lr_schedulers", "loops"} == set()
    assert exported.checkpoint.stat().st_size < run.checkpoint.stat().st_size / 4


def test_an_export_is_evaluated_validated_and_drawn(exported, in_tmp_path):
    assert main(["evaluate", str(exported), *FEW]) == 0
    assert main(["complete", str(exported), "-o", "a.png", "--context", "3", "--samples", "2"]) == 0
    assert (
        main(["figures", "predictions", "--runs", str(exported), "--index", "0", "--context", "3", "-o", "drawn"]) == 0
    )
    assert main(["validate", "--config", str(exported.config), "--ckpt_path", str(exported.checkpoint)]) == 0

    assert (in_tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_an_export_of_an_agent_plays(tmp_path):
    agent = Path(__file__).parents[1] / "old_runs" / "agent"

    assert main(["export", str(agent), "-o", str(tmp_path / "agent")]) == 0

    assert main(["evaluate", str(tmp_path / "agent"), "--episodes", "2"]) == 0


def test_scores_of_the_run_are_marked_until_the_export_is_evaluated(run, tmp_path):
    assert main(["evaluate", str(run), *FEW]) == 0
    export = ["export", str(run), "-o", str(tmp_path / "export")]
    assert main(export) == 0
    before = (tmp_path / "export" / "README.md").read_text()
    record = read_record(tmp_path / "export")
    sha256 = open_checkpoint(run.checkpoint).sha256
    assert {entry["checkpoint"] for entry in record.values() if "mean" in entry} == {sha256}

    assert main(["evaluate", str(tmp_path / "export"), *FEW]) == 0
    assert main(export) == 0

    after = (tmp_path / "export" / "README.md").read_text()
    assert "| before rounding |" in before
    assert "| before rounding |" not in after
    assert "| exported |" in after
    mean = read_record(tmp_path / "export")["test[:4]/elbo[bernoulli,S=16]"]["mean"]
    assert f"{mean:.2f} ±" in after


def test_a_card_says_where_a_reference_is_higher():
    entry = {"mean": -34.0, "standard_error": 0.5, "checkpoint": "a"}
    better, worse = {"mean": -33.0, "standard_error": 0.5}, {"mean": -35.0, "standard_error": 0.5}
    entries = {"one": entry | {"references": {"5-gram": better, "1-gram": worse}}, "two": {**entry, "checkpoint": "b"}}
    entries["three"] = entry | {"references": {"1-gram": worse}}

    rows = export._scores(entries, "a").splitlines()[-3:]

    assert rows == [
        "| `one` | -34.00 ± 0.50 | 5-gram: -33.00 ± 0.50 (higher) | exported |",
        "| `two` | -34.00 ± 0.50 |  | before rounding |",
        "| `three` | -34.00 ± 0.50 | 1-gram: -35.00 ± 0.50 | exported |",
    ]


def test_an_export_names_no_machine_and_no_folder(run, exported):
    (before,), (after,) = (json.loads(one.provenance.read_text()) for one in (run, exported))
    folder = str(Path(before["command"].split()[-1]).parent)

    assert "name" in before["machine"]
    assert "name" not in after["machine"]
    assert folder in before["command"]
    assert folder not in after["command"] + (exported.path / "README.md").read_text()


def test_absolute_paths_lose_their_folders():
    value = {"command": "forbes fit --config configs/a.yaml --run_dir=/home/me/runs/a '/x/y z'", "n": [1, "test/elbo"]}

    assert shareable(value) == {
        "command": "forbes fit --config configs/a.yaml --run_dir=a 'y z'",
        "n": [1, "test/elbo"],
    }


def test_an_export_is_not_resumed(exported, capsys):
    assert "last.ckpt: has no optimizer, it was exported" in error_of(capsys, "fit", "--resume", exported)


def test_another_run_is_not_overwritten(run, exported, tiny_run, tmp_path, capsys):
    before = run.checkpoint.read_bytes()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("")

    assert "run: holds another run. Choose another folder" in error_of(capsys, "export", run, "-o", run)
    assert "export: holds another run" in error_of(capsys, "export", exported, "-o", exported)
    for name in ("model.ckpt", "pretrained:strokes-forbes"):
        assert f"-o {name}: is not the name of a folder" in error_of(capsys, "export", run, "-o", name)
    assert "notes: has other files" in error_of(capsys, "export", run, "-o", tmp_path / "notes")
    assert run.checkpoint.read_bytes() == before


def test_a_link_brings_no_other_file_into_an_export(run, tmp_path, capsys):
    (tmp_path / "secret").write_text("{}")
    run.metrics.unlink()
    run.metrics.symlink_to(tmp_path / "secret")

    assert "metrics.jsonl: is a symbolic link" in error_of(capsys, "export", run, "-o", tmp_path / "export")
    assert not (tmp_path / "export").exists()


def test_a_run_that_cannot_be_loaded_is_not_exported(run, tmp_path, capsys):
    for checkpoint in run.checkpoint.parent.iterdir():
        checkpoint.write_bytes(checkpoint.read_bytes()[:-100])

    assert "previous.ckpt: truncated or not a checkpoint" in error_of(capsys, "export", run, "-o", tmp_path / "export")
    assert not (tmp_path / "export").exists()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_flipped_bit_or_a_missing_end_of_an_export_is_one_sentence(exported, capsys, share):
    whole = exported.checkpoint.read_bytes()
    place = int(share * len(whole))

    exported.checkpoint.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    assert "last.ckpt: truncated or " in error_of(capsys, "evaluate", exported, *FEW)

    exported.checkpoint.write_bytes(whole[:place])
    assert "last.ckpt: truncated" in error_of(capsys, "evaluate", exported, *FEW)


def test_an_xz_file_that_expands_without_end_is_refused(exported, capsys, monkeypatch):
    monkeypatch.setattr("forbes.runs.checkpoint._LARGEST", 1000)

    assert "truncated, or more than" in error_of(capsys, "evaluate", exported, *FEW)


def test_an_xz_file_of_anything_but_a_checkpoint_is_refused(exported, capsys):
    exported.checkpoint.write_bytes(lzma.compress(b"no archive"))
    assert "last.ckpt: truncated or not a checkpoint" in error_of(capsys, "evaluate", exported, *FEW)

    exported.checkpoint.write_bytes(compressed_checkpoint({"state_dict": print, "global_step": 1}))
    assert "last.ckpt: refused, it has other objects than tensors" in error_of(capsys, "evaluate", exported, *FEW)
