"""The trained models in the package are measured, drawn and loaded by name, from any folder, and stay as they are."""

import os
import shutil

import pytest
import torch
from command_line import error_of

import forbes
from forbes import bundled as bundled_files
from forbes.bundled import bundled, pretrained_names, run_path
from forbes.commands.cli import main
from forbes.errors import ForbesError
from forbes.evaluation.record import read_record
from forbes.evaluation.runs import load_runs, run_titles
from forbes.runs.folder import RunFolder, read_metrics

NAMES = pretrained_names()
FOLDER = bundled("pretrained")
DIGITS = 100
FEW = ["--scores", "elbo", "--sequences", "4", "--samples", "2"]


@pytest.fixture
def package(tiny_run, tmp_path, monkeypatch):
    """A package with two tiny models, `tiny` and `other`, in a folder that is not to be written to."""
    folder = tmp_path / "package"
    for name in ("tiny", "other"):
        assert main(["export", str(tiny_run), "-o", str(folder / "pretrained" / name)]) == 0
    monkeypatch.setattr(bundled_files, "bundled", lambda name: folder / name)
    return folder


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("name", NAMES)
def test_a_pretrained_model_has_the_elbo_of_its_card(name, in_tmp_path):
    world, data = forbes.load_run(f"pretrained:{name}")
    recorded = read_record(f"pretrained:{name}")[f"test[:{DIGITS}]/elbo[categorical,S=16]"]

    found = forbes.evaluate(world.model, data, ("elbo",), sequences=DIGITS)["elbo"]

    assert found.mean == pytest.approx(recorded["mean"], abs=0.005)  # half a unit of the card's last digit
    card = (FOLDER / name / "README.md").read_text()
    assert f"| {recorded['mean']:.2f} ± {recorded['standard_error']:.2f} |" in card


@pytest.mark.parametrize("name", NAMES)
def test_a_pretrained_model_names_its_family_and_its_training(name):
    (run,) = load_runs([f"pretrained:{name}"])
    bound = read_metrics(f"pretrained:{name}")[f"val/{run.model.bound_name}"].dropna()

    assert name.startswith(f"strokes-{run.family.lower()}")
    assert bound.iloc[-1] > bound.iloc[0]


def test_the_pretrained_models_take_at_most_five_megabytes():
    shipped = [path for kind in ("ckpt", "json", "jsonl", "yaml", "md") for path in FOLDER.rglob(f"*.{kind}")]

    assert sum(path.stat().st_size for path in shipped) <= 5e6


def test_evaluating_a_pretrained_model_writes_to_the_current_folder(package, in_tmp_path, capsys):
    before = contents(package)

    assert main(["evaluate", "pretrained:tiny", "pretrained:other", *FEW]) == 0

    assert "the results of pretrained:tiny go to pretrained-tiny\n" in capsys.readouterr().out
    (metric,) = (name for name in read_record("pretrained-other") if "/elbo" in name)
    assert "paired" in read_record("pretrained-tiny")[metric]
    assert contents(package) == before


def test_results_of_a_pretrained_model_go_to_the_output(package, in_tmp_path):
    assert main(["evaluate", "pretrained:tiny", *FEW, "--output", "results"]) == 0

    assert (in_tmp_path / "results" / "tiny" / "evaluation.json").is_file()
    assert [path.name for path in in_tmp_path.iterdir() if path.name != "package"] == ["results"]


def test_a_package_that_cannot_be_written_to_is_enough(package, in_tmp_path):
    folders = [package, *(path for path in package.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert main(["evaluate", "pretrained:tiny", *FEW]) == 0
        assert main(["complete", "pretrained:tiny", "-o", "a.png", "--context", "3", "--samples", "2"]) == 0
    finally:
        for folder in folders:
            folder.chmod(0o755)


def test_a_pretrained_model_is_loaded_by_name_from_any_folder(package, in_tmp_path, monkeypatch):
    (in_tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")

    world, data = forbes.load_run("pretrained:tiny")

    assert world.terms(data.sequences("test", torch.arange(8))).elbo.shape == (8,)
    assert os.listdir() == []


def test_a_copy_of_a_pretrained_model_is_made_with_export(package, in_tmp_path):
    assert main(["export", "pretrained:tiny", "-o", "mine"]) == 0
    assert main(["evaluate", "mine", *FEW]) == 0

    ours, theirs = (forbes.load_run(run)[0].state_dict() for run in ("mine", "pretrained:tiny"))
    torch.testing.assert_close(dict(ours), dict(theirs), rtol=0, atol=0)


def test_two_pretrained_models_of_one_family_have_titles(package):
    assert run_titles(load_runs(["pretrained:tiny", "pretrained:other"])) == [
        "FORBES (pretrained:tiny)",
        "FORBES (pretrained:other)",
    ]


def test_an_unknown_name_is_one_sentence_with_the_list(package, capsys):
    for name in ("pretrained:huge", "pretrained:", "pretrained:..", "pretrained:/etc"):
        expected = f"{name}: no such trained model. There are pretrained:other, pretrained:tiny"
        assert error_of(capsys, "evaluate", name) == expected
    with pytest.raises(ForbesError, match="no such trained model"):
        RunFolder("pretrained:huge")


def test_the_names_are_in_the_help_of_export(package, capsys):
    with pytest.raises(SystemExit):
        main(["export", "--help"])

    assert "pretrained:other, pretrained:tiny" in " ".join(capsys.readouterr().out.split())


def test_a_damaged_pretrained_model_is_one_sentence(package, capsys):
    path = run_path("pretrained:tiny/checkpoints/last.ckpt")
    path.write_bytes(path.read_bytes()[:-40])

    assert "last.ckpt: truncated" in error_of(capsys, "evaluate", "pretrained:tiny", *FEW)


def test_a_pretrained_model_is_not_trained_in_the_package(package, tiny_config, capsys):
    before = contents(package)

    for arguments in (["--resume", "pretrained:tiny"], ["--config", tiny_config, "--run_dir", "pretrained:tiny"]):
        assert "pretrained:tiny: comes with the package, expected a folder" in error_of(capsys, "fit", *arguments)

    assert contents(package) == before


def test_a_folder_of_the_wheel_is_found_before_that_of_the_checkout(tmp_path, monkeypatch):
    (tmp_path / "data" / "a").mkdir(parents=True)
    (tmp_path / "forbes").mkdir()
    monkeypatch.setattr(bundled_files, "__file__", str(tmp_path / "forbes" / "bundled.py"))
    assert bundled("a") == tmp_path / "data" / "a"

    shutil.copytree(tmp_path / "data", tmp_path / "forbes" / "data")

    assert bundled("a") == tmp_path / "forbes" / "data" / "a"
