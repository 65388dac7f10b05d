"""`forbes evaluate --model`: somebody else's world model next to a run, as a user calls it."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import error_of

import forbes
from forbes.commands.cli import main
from forbes.evaluation.adapters import adapter_folder, load_all
from forbes.evaluation.calibration.runs import calibrate_run
from forbes.runs.folder import RunFolder

PAGES = Path(__file__).parents[2] / "docs" / "adapters"
MEASURES = ["--sequences", "6", "--samples", "2", "--particles", "3", "--futures", "4", "--context", "2"]
MODEL = ["--model", "my_adapter:Model", "checkpoint=their_dreamer.pt"]
NAME = "my_adapter:Model checkpoint=their_dreamer.pt"
RESULTS = "my_adapter-Model-checkpoint=their_dreamer.pt"


@pytest.fixture(scope="module")
def trained(tiny_config, strokes_file, tmp_path_factory):
    """A folder with the files of the page, a checkpoint of their model, and a run of ours, on the same digits."""
    folder = tmp_path_factory.mktemp("adapters")
    for name in ("my_adapter.py", "their_dreamer.py"):
        shutil.copy(PAGES / name, folder)
    options = ["--model.likelihood", "OnePixel", "--trainer.max_epochs", "1"]
    assert main(["fit", "--config", str(tiny_config), *options, "--run_dir", str(folder / "ours")]) == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.delitem(sys.modules, "their_dreamer", raising=False)
        import their_dreamer  # from the folder

        data = forbes.SequenceDataModule(forbes.Strokes(path=str(strokes_file), validation=20), batch_size=8, length=6)
        their_dreamer.train(data, 30, folder / "their_dreamer.pt")
    return folder


@pytest.fixture
def here(trained, tmp_path, monkeypatch):
    """A copy of the folder, which a test works in; its modules are forgotten afterwards."""
    folder = shutil.copytree(trained, tmp_path / "work")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    for name in ("my_adapter", "their_dreamer", "other"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield folder
    for name in ("my_adapter", "their_dreamer", "other"):
        sys.modules.pop(name, None)


def test_a_checkpoint_in_the_name_leaves_the_results_in_their_folder():
    """A path that ends in .ckpt would be taken for a checkpoint of a run, and its record put beside the output."""
    folder = adapter_folder(["m:Model", "actions=1", "checkpoint=logs/a.ckpt"], "results")

    assert RunFolder(folder).path == folder == Path("results/m-Model-actions=1-checkpoint=logs-a-ckpt")


def test_an_adapter_is_filled_in_within_sixty_lines():
    for path in PAGES.glob("*_adapter.py"):
        assert len(path.read_text().splitlines()) <= 60, path
    assert len((PAGES / "my_adapter.py").read_text().splitlines()) <= 40


def test_a_foreign_model_is_scored_next_to_a_run_on_the_same_sequences(here, capsys):
    assert main(["evaluate", "ours", *MODEL, *MEASURES]) == 0

    printed = capsys.readouterr().out
    assert f"2  {NAME}: my_adapter, " in printed
    ours, theirs = (json.loads((here / folder / "evaluation.json").read_text()) for folder in ("ours", RESULTS))
    of_both = {name for name in theirs if not name.endswith("round_trip")}
    assert of_both == {name for name in ours if not name.endswith("round_trip")}
    assert {name.partition("/")[2].partition("[")[0] for name in of_both} >= {
        *("elbo", "kl", "iwae", "pll", "fivo", "ess", "open_loop", "open_loop_marginal", "psnr")
    }
    name = "test[:6]/pll[categorical,K=3]"
    difference = theirs[name]["paired"][0]
    assert difference["minus"] == "ours"
    assert difference["mean"] == pytest.approx(theirs[name]["mean"] - ours[name]["mean"])
    assert theirs[name]["data"]["sha256"] == ours[name]["data"]["sha256"]
    with np.load(here / RESULTS / "evaluation.npz") as arrays:
        assert arrays[name].shape == (6,)


def test_its_data_may_be_a_run_or_a_configuration(here, tiny_config):
    for data in ("ours", str(tiny_config)):
        assert (
            main(["evaluate", *MODEL, "--data", data, *MEASURES, "--scores", "pll", "--output", Path(data).stem]) == 0
        )

    first, second = (
        json.loads((here / name / RESULTS / "evaluation.json").read_text())["test[:6]/pll[categorical,K=3]"]["mean"]
        for name in ("ours", "forbes")
    )
    assert first == second


DRAWS = """
import my_adapter

class Model(my_adapter.Model):
    def __init__(self, checkpoint, posterior=True):
        super().__init__(checkpoint)
        self.has_densities = posterior
"""


def test_what_it_lacks_is_not_available_in_the_table(here, capsys):
    (here / "other.py").write_text(DRAWS)
    other = ["--model", "other:Model", "checkpoint=their_dreamer.pt", "posterior=false"]

    assert main(["evaluate", "ours", *MODEL, *other, *MEASURES, "--scores", "elbo", "pll"]) == 0

    table = capsys.readouterr().out.split("nats per sequence, mean")[1].split("log p of")[0]
    rows = {line.split("│")[1].strip(): line for line in table.splitlines() if line.startswith("│ test")}
    assert rows["test[:6]/elbo"].count("n/a") == 1
    assert "n/a" not in rows["test[:6]/pll"]


def test_calibration_and_figures_accept_it(here):
    ours, theirs = (calibrate_run(run, 20, 3, 9) for run in load_all(["ours"], [MODEL[1:]], None))
    assert ours.tarp.shape == theirs.tarp.shape == theirs.density.shape == (20,)
    assert theirs.value.shape == (20, 64)

    assert main(["figures", "predictions", "--runs", "ours", *MODEL, "--index", "0", "1", "--context", "3"]) == 0
    assert list((here / "figures").glob("predictions-t*.png"))


def test_an_adapter_of_another_checkpoint_is_another_row(here, capsys):
    torch.save(torch.load("their_dreamer.pt", weights_only=True), "second.pt")
    second = ["--model", "my_adapter:Model", "checkpoint=second.pt"]

    assert main(["evaluate", *MODEL, *second, "--data", "ours", *MEASURES, "--scores", "pll"]) == 0

    assert "+0.00 ± 0.00" in capsys.readouterr().out


BROKEN = {
    "import": ("import nothing_of_this_name\n", "importing other fails (ModuleNotFoundError: No module named"),
    "syntax": ("class Model(:\n", "importing other fails (SyntaxError: "),
    "class": ("class Modell: pass\n", "other has no Model, its classes are Modell"),
    "kind": ("class Model: pass\n", "Model is no subclass of forbes.ModelAdapter"),
    "method": (
        "import forbes\nclass Model(forbes.ModelAdapter):\n    def initial(self, batch): pass\n",
        "Model has no decode_state. Implement",
    ),
    "raises": (
        "import my_adapter\nclass Model(my_adapter.Model):\n    def advance(self, before, action): return 1 / 0\n",
        "fails (ZeroDivisionError: division by zero). Change the adapter; --debug shows where",
    ),
}


@pytest.mark.parametrize(("text", "sentence"), BROKEN.values(), ids=BROKEN)
def test_a_broken_adapter_is_one_sentence(text, sentence, here, capsys):
    (here / "other.py").write_text(text)
    arguments = ["checkpoint=their_dreamer.pt"] if "my_adapter" in text else []

    found = error_of(capsys, "evaluate", "ours", "--model", "other:Model", *arguments)

    assert found.startswith("--model other:Model")
    assert sentence in found


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ["--model", "my_adapter"],
            "--model my_adapter: expected MODULE:CLASS, e.g. my_adapter:Model",
        ),
        (["--model", "no_such:Model"], "importing no_such fails (ModuleNotFoundError"),
        (
            ["--model", "my_adapter:Model"],
            "the argument checkpoint is missing. Give it: --model my_adapter:Model",
        ),
        ([*MODEL, "size=3"], "there is no argument size, expected some of checkpoint"),
        ([*MODEL, "ours"], "ours is not KEY=VALUE. Runs come before --model"),
        (["--model", "my_adapter:Model", "checkpoint=no.pt"], "constructing it fails (FileNotFoundError: "),
    ],
)
def test_wrong_arguments_are_one_sentence(arguments, sentence, here, capsys):
    assert sentence in error_of(capsys, "evaluate", "ours", *arguments)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "forbes evaluate: the following arguments are required: RUN, or --model MODULE:CLASS"),
        (["ours", "--data", "strokes/forbes"], "--data strokes/forbes: is for --model"),
        (MODEL, "--model: on which data? Name a run first, or a configuration: --data strokes/forbes"),
        ([*MODEL, "--data", "strokes/forbs"], "strokes/forbs: no such configuration. Did you mean strokes/forbes"),
    ],
)
def test_data_are_those_of_a_model_only(arguments, sentence, here, capsys):
    assert sentence in error_of(capsys, "evaluate", *arguments)
