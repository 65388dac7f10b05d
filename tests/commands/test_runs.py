"""`forbes runs`, as a user calls it."""

import json
import os
import platform
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta

import pytest
from command_line import error_of
from recorded_runs import write_agent, write_run

from forbes.commands.cli import main
from forbes.commands.curves import curve

ELBO = "val/elbo[bernoulli,S=1]"


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")


def write(folder, status=None, hours_ago=3, lines=None, **entry):
    """A world model's run with one start, which ended with this status; None while it runs."""
    lines = (
        [{"update": 10 * k, "epoch": k, ELBO: -100.0 / (k + 1), "val/kl": 3.0} for k in range(9)]
        if lines is None
        else lines
    )
    write_run(folder, "WorldModel", "FlowBelief", "Strokes", {}, lines)
    started = (datetime.now(UTC) - timedelta(hours=hours_ago)).isoformat(timespec="seconds")
    ended = {} if status is None else {"hours": 0.5, "exit_status": status}
    start = {"command": "forbes fit strokes/forbes", "started": started, "commit": "0123abc", "seed": 4}
    (folder / "provenance.json").write_text(json.dumps([start | ended | entry]))
    return folder


def rows(capsys, *arguments):
    """The rows of the table by the name of the run."""
    assert main(["runs", *map(str, arguments)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    return {line.split()[0]: line.split()[1:] for line in lines[3:] if line.strip()}


def test_the_table_says_what_was_trained_how_far_and_how_well(tmp_path, capsys):
    write(tmp_path / "runs" / "compare" / "forbes-0", status=0)

    found = rows(capsys)

    assert found["compare/forbes-0"] == ["FORBES", "Strokes", "4", "80", "elbo", "-11.11", "3", "h", "finished"]


@pytest.mark.parametrize(
    ("status", "state"),
    [(0, "finished"), (130, "stopped"), (143, "stopped"), (138, "stopped"), (3, "failed"), (2, "failed")],
)
def test_the_state_is_that_of_the_exit_status(status, state, tmp_path, capsys):
    write(tmp_path / "runs" / "a", status)

    assert rows(capsys)["a"][-1] == state


@pytest.mark.parametrize(
    ("owner", "state"),
    [
        (f"process {os.getpid()} on {platform.node()}", "running"),
        (f"process 2000000000 on {platform.node()}", "failed"),  # above the largest number of a process
        ("process 1 on another", "running"),  # its metrics are seconds old
        ("", "failed"),
    ],
    ids=["here", "ended", "elsewhere", "unlocked"],  # not the number, which differs between the workers of pytest-xdist
)
def test_a_run_without_an_end_runs_while_its_process_is_alive(owner, state, tmp_path, capsys):
    (write(tmp_path / "runs" / "a") / ".lock").write_text(owner)

    assert rows(capsys)["a"][-1] == state


def test_a_run_elsewhere_that_wrote_nothing_lately_has_failed(tmp_path, capsys):
    run = write(tmp_path / "runs" / "a")
    (run / ".lock").write_text("process 1 on another")
    os.utime(run / "metrics.jsonl", (0, 0))

    assert rows(capsys)["a"][-1] == "failed"


def test_agents_have_env_steps_and_returns(tmp_path, capsys):
    write_agent(tmp_path / "runs" / "agent", "hike", {1000: 1.0, 52_000: 612.34})

    assert rows(capsys)["agent"] == ["FORBES", "hike", "52,000", "52,000", "return", "612.3", "unknown"]


def lines_of(capsys, columns=80):
    """The lines that `forbes runs` prints, none of them wider than the terminal."""
    assert main(["runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns
    return lines


@pytest.mark.parametrize("columns", [70, 80, 120, 160])
def test_names_of_runs_are_never_folded(columns, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("forbes.commands.runs._WIDTH", columns)
    name = "compare/cartpole/forbes_v3-0"
    write_agent(tmp_path / "runs" / name, "dmc_cartpole_swingup_positions_only", {1000: 1.0, 52_000: 612.34})
    write(tmp_path / "runs" / "strokes" / "rssm_wide-0", status=0)

    lines = lines_of(capsys, columns)

    assert sum(name in line for line in lines) == 1
    assert sum("strokes/rssm_wide-0" in line for line in lines) == 1
    assert any("return 612.3" in line for line in lines)
    assert any("dmc_cartpole_swingup_positions_only" in line for line in lines) == (columns == 160)


def test_columns_without_room_are_named(tmp_path, capsys):
    write_agent(tmp_path / "runs" / "compare/cartpole_swingup/forbes_v3-0", "dmc_cartpole_swingup", {52_000: 612.34})

    *_, last = lines_of(capsys)

    assert last == "no room in 80 columns: age, seed, updates, data"


def test_world_models_have_no_column_of_env_steps(tmp_path, capsys):
    write(tmp_path / "runs" / "a", status=0)
    write_agent(tmp_path / "runs" / "b", "hike", {1000: 1.0})

    headers = [line for line in lines_of(capsys) if "method" in line]

    assert ["env steps" in header for header in headers] == [False, True]


def test_another_folder_or_a_run_itself_may_be_named(tmp_path, capsys):
    run = write(tmp_path / "elsewhere" / "a", status=0)

    assert list(rows(capsys, "elsewhere")) == ["a"]
    assert list(rows(capsys, run)) == ["."]


def test_a_damaged_run_is_told_and_the_others_are_listed(tmp_path, capsys):
    write(tmp_path / "runs" / "a", status=0)
    (write(tmp_path / "runs" / "b", status=0) / "provenance.json").write_text("[")

    assert main(["runs"]) == 0

    found = capsys.readouterr()
    assert " b " not in found.out
    assert "runs/b/provenance.json: truncated or not JSON" in found.err


def test_the_last_of_many_lines_count_and_a_cut_one_does_not(tmp_path, capsys):
    lines = [{"update": k, "epoch": k, ELBO: float(-k), "train/kl": 1.0} for k in range(5000)]
    run = write(tmp_path / "runs" / "a", status=0, lines=lines)
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"update": 9999, ')

    assert rows(capsys)["a"][3:6] == ["4,999", "elbo", "-4999.0"]


def test_a_score_that_was_trained_again_since_is_not_shown(tmp_path, capsys):
    lines = [{"update": 500, ELBO: -100.0}, {"update": 900, ELBO: -9000.0}, {"update": 500, "start": True}]

    write(tmp_path / "runs" / "a", status=0, lines=[*lines, {"update": 510, "train/kl": 1.0}])

    assert rows(capsys)["a"][3:6] == ["510", "elbo", "-100.0"]


def test_a_real_run_is_listed_and_shown(tiny_run, tmp_path, capsys):
    shutil.copytree(tiny_run, tmp_path / "runs" / "tiny")
    assert main(["evaluate", "runs/tiny", "--sequences", "4", "--samples", "2", "--scores", "elbo"]) == 0
    capsys.readouterr()

    assert rows(capsys)["tiny"][-1] == "finished"
    assert main(["runs", "show", "runs/tiny"]) == 0

    shown = capsys.readouterr().out
    assert "state    finished, 10 updates in 0." in shown
    assert "command  forbes fit --config" in shown
    assert "val/elbo[bernoulli,S=1], by update; last -" in shown
    assert "test[:4]/elbo[bernoulli,S=2]" in shown
    assert "┤" in shown


def test_a_hundred_runs_are_listed_without_torch(tmp_path):
    for number in range(100):
        write(tmp_path / "runs" / f"run-{number}", status=0)
    program = "import sys; from forbes.commands.cli import main; main(['runs']); print('torch' in sys.modules)"

    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert done.stdout.count("finished") == 100
    assert done.stdout.splitlines()[-1] == "False"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "runs: no such folder. `forbes fit` creates runs/; name another: forbes runs DIR"),
        (["show"], "forbes runs show: expected one run. Name it: forbes runs show RUN"),
        (["show", "nowhere"], "nowhere: not a run folder, config.yaml is missing"),
        (["a", "b"], "forbes runs: expected one folder, got a b"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(arguments, sentence, capsys):
    assert sentence in error_of(capsys, "runs", *arguments)


def heights(lines):
    """The row of the first dot in each column of a curve, from above; None in an empty column."""
    rows = [line.partition("┤")[2] for line in lines[:-1]]
    width = max(map(len, rows))
    padded = [row.ljust(width, chr(0x2800)) for row in rows]
    return [next((k for k, row in enumerate(padded) if ord(row[c]) != 0x2800), None) for c in range(width)]


def test_a_curve_rises_where_its_values_rise():
    lines = curve(range(100), range(100), width=60, height=6)

    found = heights(lines)
    assert len(lines) == 7
    assert max(map(len, lines)) <= 60
    assert None not in found
    assert found == sorted(found, reverse=True)
    assert (found[0], found[-1]) == (5, 0)
    assert lines[0].strip().startswith("99 ┤")
    assert lines[-1].split() == ["0", "99"]


def test_a_curve_of_one_value_or_none_is_drawn():
    assert "5 ┤" in curve([1], [5.0])[0]
    assert curve([1, 2], [float("nan")] * 2) == ["no finite value"]


def test_the_first_values_do_not_flatten_a_curve():
    values = [-1e6, *(-10 + k / 10 for k in range(99))]

    lines = curve(range(100), values, height=4)

    assert lines[3].strip().startswith("≤ -9.")
    assert heights(lines)[-1] == 0


def test_a_curve_without_a_number_is_none(tmp_path, capsys):
    lines = [{"update": 10, "epoch": 0, ELBO: float("nan"), "val/kl": 3.0}]
    assert main(["runs", "show", str(write(tmp_path / "runs/a", 0, lines=lines))]) == 0

    output = capsys.readouterr().out
    assert f"{ELBO}, by update\n" in output
    assert "val/kl, by update; last 3.00" in output
