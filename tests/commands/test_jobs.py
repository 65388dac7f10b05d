"""Jobs side by side: all end, each says how, and a signal reaches every one once."""

import os
import signal
import subprocess
import sys
import time

import pytest

from forbes.commands.jobs import Job, _Board, run_jobs


def python(name, code):
    return Job(name, [sys.executable, "-c", code])


def test_every_job_runs_and_a_failure_stops_no_other(capsys):
    jobs = [python("good", "print('fine')"), python("bad", "raise SystemExit(3)"), python("last", "print('too')")]

    assert run_jobs(jobs, 2) == {"good": 0, "bad": 3, "last": 0}

    lines = capsys.readouterr().out.splitlines()
    assert "good: fine" in lines
    assert "good: done. fine" in lines
    assert any(line.startswith("bad: ended with status 3") for line in lines)


@pytest.mark.parametrize("at_once", [1, 2])
def test_no_more_than_asked_run_at_once(at_once, tmp_path):
    """Each job waits for a file that the other leaves; alone it gives up."""
    code = """
import pathlib, sys, time
mine, other = map(pathlib.Path, sys.argv[1:])
mine.touch()
for _ in range(1000 if {long} else 20):
    if other.exists() and not (other.parent / (other.name + ".ended")).exists():
        break
    time.sleep(0.01)
else:
    raise SystemExit(4)
time.sleep(0.2)
(mine.parent / (mine.name + ".ended")).touch()
""".replace("{long}", str(at_once == 2))
    a, b = str(tmp_path / "a"), str(tmp_path / "b")
    jobs = [Job("a", [sys.executable, "-c", code, a, b]), Job("b", [sys.executable, "-c", code, b, a])]

    statuses = run_jobs(jobs, at_once)

    assert statuses["a"] == (0 if at_once == 2 else 4)


def test_the_threads_are_shared_out(capsys, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)

    run_jobs([python("one", "import os; print(os.environ['OMP_NUM_THREADS'])")], 3)

    assert "one: 2" in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_reaches_every_running_job_once(number, tmp_path):
    job = """
import pathlib, signal, sys, time
seen = []
signal.signal(signal.SIGTERM, lambda *_: seen.append(1))
print("ready", flush=True)
while not seen:
    time.sleep(0.01)
time.sleep(0.3)
pathlib.Path(sys.argv[1]).write_text(str(len(seen)))
"""
    parent = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would begin by ignoring it
from forbes.commands.jobs import Job, run_jobs
run_jobs([Job(name, [sys.executable, "-c", sys.argv[1], sys.argv[2] + name]) for name in "abc"], 2)
"""
    arguments = [sys.executable, "-c", parent, job, str(tmp_path / "job-")]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        ready = 0
        while ready < 2:
            ready += process.stdout.readline().rstrip().endswith("ready")
        time.sleep(0.1)
        process.send_signal(number)
        process.stdout.read()

    assert process.returncode != 0
    assert [(tmp_path / f"job-{name}").read_text() for name in "ab"] == ["1", "1"]
    assert not (tmp_path / "job-c").exists()


def test_the_time_left_is_the_work_left_at_the_pace_so_far(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    board = _Board([Job("a", [], 1.0), Job("b", [], 1.0), Job("c", [], 2.0)], later=1.0)
    board.shown()
    board.say("b", "epoch 5/10  update 50/100")
    clock[0] = 10.0

    board.end("a", 0)

    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "1 of 3 jobs have ended, about 0:00:23 left"  # 10 s for 1.5 hours, and 3.5 are left


def test_a_job_tells_how_it_ended_and_what_it_said_last():
    ended = []

    run_jobs([python("bad", "print('first'); print('why'); raise SystemExit(3)")], 1, on_end=ended.append)

    assert [(one.job.name, one.status, one.last) for one in ended] == [("bad", 3, "why")]
    assert ended[0].hours > 0
