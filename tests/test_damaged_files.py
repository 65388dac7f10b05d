"""Damaged files: every reader returns what it can read or says one sentence, whatever the bytes are."""

import random
import shutil

import pytest
from damage import KINDS, damaged, read_or_sentence

from forbes.commands.cli import main

INPUTS = 300


@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
@pytest.mark.filterwarnings("ignore")  # of a parser, on bytes it was not made for
def test_a_damaged_file_is_read_or_one_sentence(kind, tmp_path):
    path, generator = tmp_path / kind.name, random.Random(0)
    kind.write(path)
    whole = path.read_bytes()
    assert read_or_sentence(kind.read, path) is None

    sentences = set()
    for _ in range(INPUTS):
        path.write_bytes(damaged(whole, generator))
        sentences.add(read_or_sentence(kind.read, path))

    assert len(sentences) > 2


CONFIGURATIONS = [
    b"",
    b"\xff\xfe\x00",
    b"[1, 2]",
    b"model: 3\ndata: 4\n",
    b"? [a]\n: 1\n",
    b"a: 2001-99-99\n",
    b"model: {class_path: WorldModel, init_args: 3}\ndata: {class_path: SequenceDataModule}\n",
    b"model: {class_path: ''}\ndata: {class_path: SequenceDataModule}\n",
]


@pytest.mark.parametrize("content", CONFIGURATIONS)
@pytest.mark.parametrize("command", ["evaluate", "resume", "config"])
def test_a_configuration_of_another_kind_is_one_sentence(command, content, tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    (run / "config.yaml").write_bytes(content)
    arguments = {
        "evaluate": ["evaluate", str(run)],
        "resume": ["fit", "--resume", str(run)],
        "config": ["fit", "--config", str(run / "config.yaml"), "--run_dir", str(tmp_path / "new")],
    }

    assert main(arguments[command]) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("forbes: ")
    assert len(line.replace(str(tmp_path), "")) < 300


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("class_path: forbes.FlowBelief", "class_path: ''"),
        ("layers: 2", "layers: -3"),
        ("width: 8", "width: -1"),
    ],
)
def test_an_error_inside_a_named_class_is_one_sentence(old, new, tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    text = (run / "config.yaml").read_text()
    assert old in text
    (run / "config.yaml").write_text(text.replace(old, new))

    for arguments in (["evaluate", str(run)], ["fit", "--resume", str(run)]):
        assert main(arguments) == 2
        *_, line = capsys.readouterr().err.splitlines()
        assert line.startswith("forbes: ")
        assert len(line.replace(str(tmp_path), "")) < 300


@pytest.mark.parametrize("content", [b"", b"\xff", b"3", b'{"a": 1}', b"[1]"])
def test_a_broken_provenance_is_said_before_a_training_goes_on(content, tiny_run, tmp_path, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    (run / "provenance.json").write_bytes(content)

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "3"]) == 2

    assert "provenance.json: " in capsys.readouterr().err
    assert (run / "provenance.json").read_bytes() == content


@pytest.mark.parametrize("name", ["evaluation.json", "evaluation.npz"])
def test_a_broken_record_is_said_before_anything_is_measured(name, tiny_run, tmp_path, monkeypatch, capsys):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    (run / name).write_bytes(b"PK\x03\x04")
    monkeypatch.setattr("forbes.commands.evaluate.load_all", lambda *_: pytest.fail("measured"))

    assert main(["evaluate", str(run)]) == 2

    assert f"{name}: truncated or not" in capsys.readouterr().err
