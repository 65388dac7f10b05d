"""What a training says while it runs."""

import os
import re
import signal

import pytest

from forbes.commands.cli import main
from forbes.runs.progress import PlainProgress, TerminalProgress, progress
from forbes.training import WorldModel


@pytest.mark.parametrize(("terminal", "kind"), [(True, TerminalProgress), (False, PlainProgress)])
def test_a_bar_is_drawn_on_a_terminal_only(terminal, kind, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)

    assert type(progress()) is kind


def test_a_log_file_gets_one_line_an_epoch(tiny_config, tmp_path, capsys):
    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run")]) == 0

    output = capsys.readouterr()
    lines = [line for line in output.out.splitlines() if line.startswith("epoch")]
    pattern = (
        r"epoch {0}/2  update {1}/10  \d:\d\d:\d\d  \d+\.\d updates/s  train/elbo\[bernoulli,S=1\] -\d+\.\d  "
        r"val/elbo\[bernoulli,S=1\] -\d+\.\d  left \d:\d\d:\d\d"
    )
    assert [re.sub(r"\s+$", "", line) for line in lines] == lines
    assert re.fullmatch(pattern.format(1, 5), lines[0])
    assert re.fullmatch(pattern.format(2, 10), lines[1])
    assert len(lines) == 2
    assert output.err == ""


def test_the_terminal_bar_shows_the_bounds(tiny_config, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("forbes.commands.fit.progress", TerminalProgress)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")

    assert main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run")]) == 0

    assert "val/elbo[bernoulli,S=1]" in capsys.readouterr().out


def test_a_training_without_end_has_no_time_left(tiny_config, tmp_path, capsys, monkeypatch):
    def interrupt(self, loss):
        if self.global_step == 5:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(WorldModel, "on_before_backward", interrupt)
    main(["fit", "--config", str(tiny_config), "--run_dir", str(tmp_path / "run"), "--trainer.max_epochs", "-1"])

    assert re.search(r"^epoch 1  update 5  .* updates/s  .*elbo\S+ -\d+\.\d$", capsys.readouterr().out, re.MULTILINE)
