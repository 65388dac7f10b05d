"""`forbes configs`: the list has every configuration, `show` prints one, and `copy` makes one that trains."""

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import error_of

from forbes.commands import compare
from forbes.commands.cli import main
from forbes.errors import ForbesError
from forbes.runs.configs import shipped_configs


def test_the_list_has_every_configuration_by_folder_in_80_columns(capsys):
    assert main(["configs"]) == 0

    folder, found = "", []
    lines = capsys.readouterr().out.splitlines()
    for word in [line[:26].rstrip() for line in lines[3:]]:
        if word.endswith("/"):
            folder = word.strip()
        elif word.strip() and "─" not in word and not word.startswith(" " * 5):
            found.append(folder + word.strip())
    assert found == list(shipped_configs())
    assert max(map(len, lines)) <= 80
    assert any("RSSM on digit strokes, scored by the pixel that" in line for line in lines)


def test_the_list_needs_nothing_heavy():
    program = "import sys; from forbes.commands.cli import main; main(['configs']); assert 'torch' not in sys.modules"

    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)


def test_a_configuration_is_printed_as_it_is(capsys):
    assert main(["configs", "show", "strokes/forbes"]) == 0

    assert capsys.readouterr().out == shipped_configs()["strokes/forbes"].read_text()


def test_a_copy_is_the_configuration_with_its_own_command(in_tmp_path, capsys):
    assert main(["configs", "copy", "strokes/forbes", "mine/own.yaml"]) == 0

    original = shipped_configs()["strokes/forbes"].read_text().splitlines()
    copied = Path("mine/own.yaml").read_text().splitlines()
    assert "Train with it: forbes fit mine/own.yaml" in capsys.readouterr().out
    assert copied[1] == "# forbes fit mine/own.yaml"
    assert copied[:1] + copied[2:] == original[:1] + original[2:]


@pytest.mark.parametrize("existing", ["mine.yaml", "."])
def test_a_copy_overwrites_nothing(existing, in_tmp_path, capsys):
    Path("mine.yaml").write_text("mine")

    assert error_of(capsys, "configs", "copy", "debug", existing) == f"{existing}: exists already. Name a new file"
    assert Path("mine.yaml").read_text() == "mine"


def test_a_wrong_name_is_one_sentence(in_tmp_path, capsys):
    for command in (["configs", "show"], ["fit"], ["compare", "debug"], ["fit", "--config"]):
        assert "Did you mean strokes/forbes" in error_of(capsys, *command, "strokes/forbs")
    assert not list(in_tmp_path.iterdir())


def test_a_training_by_names_is_that_of_the_files(in_tmp_path, capsys):
    printed = []
    files = [part for name in ("strokes/forbes", "debug") for part in ("--config", str(shipped_configs()[name]))]
    for arguments in (["strokes/forbes", "debug"], files):
        with pytest.raises(SystemExit) as done:
            main(["fit", *arguments, "--model.state_dim", "3", "--print_config"])
        assert done.value.code == 0
        printed.append(capsys.readouterr().out)

    assert printed[0] == printed[1]
    assert "max_epochs: 2" in printed[0]


def test_a_comparison_names_its_runs_after_the_last_part(in_tmp_path, monkeypatch, capsys):
    trained = []

    def train(trainings, at_once):
        trained.extend((one.config, one.seed, one.folder) for one in trainings)
        raise ForbesError("far enough")

    monkeypatch.setattr(compare, "_train", train)

    assert error_of(capsys, "compare", "strokes/rssm", "strokes/forbes", "-o", "c") == "far enough"
    assert trained == [("strokes/rssm", 0, "c/rssm-0"), ("strokes/forbes", 0, "c/forbes-0")]
