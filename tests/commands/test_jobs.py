"""Jobs side by side: all end, each says how, and a signal reaches every one once."""

import fcntl
import os
import signal
import subprocess
import sys
import time

import pytest

from forbes.commands.board import Board
from forbes.commands.cli import main
from forbes.commands.jobs import Job, run_jobs
from forbes.commands.launchers import process
from forbes.commands.launchers.local import Local
from forbes.commands.trainings import failures
from forbes.errors import ForbesError


def python(name, code, *arguments, **options):
    return Job(name, ["-c", code, *map(str, arguments)], **options)


def statuses(ended):
    return {one.job.name: one.status for one in ended}


def test_every_job_runs_and_a_failure_stops_no_other(capsys):
    jobs = [python("good", "print('fine')"), python("bad", "raise SystemExit(3)"), python("last", "print('too')")]

    assert statuses(run_jobs(jobs, Local(2))) == {"good": 0, "bad": 3, "last": 0}

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
    raise SystemExit(3)
time.sleep(0.2)
(mine.parent / (mine.name + ".ended")).touch()
""".replace("{long}", str(at_once == 2))
    a, b = str(tmp_path / "a"), str(tmp_path / "b")
    jobs = [python("a", code, a, b), python("b", code, b, a)]

    ended = run_jobs(jobs, Local(at_once))

    assert statuses(ended)["a"] == (0 if at_once == 2 else 3)


def test_the_threads_are_shared_out(capsys, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(8), raising=False)

    run_jobs([python("one", "import os; print(os.environ['OMP_NUM_THREADS'])")], Local(3))

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
from forbes.commands.launchers.local import Local
run_jobs([Job(name, ["-c", sys.argv[1], sys.argv[2] + name]) for name in "abc"], Local(2))
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
    board = Board({"a": 1.0, "b": 1.0, "c": 2.0}, later=1.0)
    board.shown()
    board.say("b", "epoch 1/10  update 10/100")
    board.say("b", "epoch 5/10  update 50/100")
    clock[0] = 10.0

    board.end("a", 0)

    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "1 of 3 jobs have ended, about 0:00:23 left"  # 10 s for 1.5 hours, and 3.5 are left


def test_what_an_earlier_command_did_is_not_counted_in_the_pace(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    board = Board({"agent": 1.0, "done": 0.0}, later=0.0)
    board.shown()
    board.say("agent", "seed episode 5/5: return 1.0")
    clock[0] = 60.0
    board.say("agent", "epoch 16/20  update 160/200")  # resumed at 15

    board.end("done", 0)

    assert capsys.readouterr().out.splitlines()[-1] == "1 of 2 jobs have ended, about 0:04:00 left"


def test_a_job_tells_how_it_ended_and_what_it_said_last():
    ended = []

    run_jobs([python("bad", "print('first'); print('why'); raise SystemExit(3)")], Local(1), on_end=ended.append)

    assert [(one.job.name, one.status, one.last) for one in ended] == [("bad", 3, "why")]
    assert ended[0].reason == "ended with status 3: why"
    assert ended[0].hours > 0


def test_a_job_that_crashes_three_times_is_given_up(tmp_path, capsys):
    crash = "import sys; open(sys.argv[1], 'a').write('x'); raise ValueError('no luck')"
    jobs = [python("bad", crash, tmp_path / "attempts"), python("good", "print('fine')")]

    bad, good = run_jobs(jobs, Local(1))

    assert (tmp_path / "attempts").read_text() == "xxx"
    assert failures([bad, good]) == {"bad": "ended 3 times with status 1: ValueError: no luck"}
    assert good.status == 0
    lines = capsys.readouterr().out.splitlines()
    assert "bad: ended with status 1, begins again (attempt 3)" in lines
    assert "not finished: bad ended 3 times with status 1: ValueError: no luck" in lines


def test_a_crash_after_a_new_checkpoint_is_the_first_again(tmp_path):
    """Each attempt makes a checkpoint and crashes, as on a machine that is taken away again and again; then it ends."""
    code = """
import pathlib, sys
checkpoint = pathlib.Path(sys.argv[1])
checkpoint.parent.mkdir(parents=True, exist_ok=True)
checkpoint.write_text((checkpoint.read_text() if checkpoint.exists() else "") + sys.argv[2])
sys.exit(0 if len(checkpoint.read_text()) == 6 else 1)
"""
    checkpoint = str(tmp_path / "run" / "checkpoints" / "last.ckpt")
    resume = ["-c", code, checkpoint, "r"]

    (ended,) = run_jobs([python("job", code, checkpoint, "s", run=str(tmp_path / "run"), resume=resume)], Local(1))

    assert ended.status == 0
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").read_text() == "srrrrr"  # started once, then resumed


def test_an_interrupted_job_is_no_failure_and_not_repeated(tmp_path):
    kill = "import os, signal, sys; open(sys.argv[1], 'a').write('x'); os.kill(os.getpid(), signal.SIGTERM)"

    (ended,) = run_jobs([python("job", kill, tmp_path / "attempts")], Local(1))

    assert (tmp_path / "attempts").read_text() == "x"
    assert ended.reason == "was interrupted"


def test_a_refused_job_is_not_run_and_says_why(tmp_path, capsys):
    jobs = [python("bad", "print('it ran')", refused="bad: has another configuration"), python("good", "print('fine')")]

    bad, good = run_jobs(jobs, Local(1))

    assert bad.reason == "has another configuration"
    assert good.status == 0
    assert "it ran" not in capsys.readouterr().out


def test_a_job_that_cannot_be_begun_stops_no_other():
    class Refusing(Local):
        def attempt(self, job, say):
            if job.name == "bad":
                raise ForbesError("runs/bad: another process trains here")
            return super().attempt(job, say)

    bad, good = run_jobs([python("bad", "pass"), python("good", "pass")], Refusing(1))

    assert bad.reason == "ended with status 2: forbes: runs/bad: another process trains here"
    assert good.status == 0


STUBBORN = """
import signal, sys, time
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(1000)
"""


def test_a_job_that_ignores_the_signals_is_killed(monkeypatch):
    monkeypatch.setattr(process, "_PATIENCE", ((signal.SIGTERM, 0.2), (signal.SIGTERM, 0.1), (signal.SIGKILL, 4.0)))
    running = process.start(["-c", STUBBORN], 1)
    assert running.stdout.readline() == "ready\n"

    process.end(running)

    assert process.follow(running, print) == -signal.SIGKILL


def test_all_signals_to_a_job_come_within_30_seconds():
    assert sum(seconds for _, seconds in process._PATIENCE) < 30
    assert process._PATIENCE[-1][0] == signal.SIGKILL


def test_a_training_ends_when_its_launcher_is_killed(tiny_config, tmp_path):
    run = tmp_path / "run"
    launcher = f"""
from forbes.commands.jobs import Job, run_jobs
from forbes.commands.launchers.local import Local
command = ["-m", "forbes", "fit", {str(tiny_config)!r}, "--trainer.max_epochs", "-1", "--run_dir", {str(run)!r}]
run_jobs([Job("job", command)], Local(1))
"""
    with subprocess.Popen([sys.executable, "-c", launcher], stdout=subprocess.PIPE, text=True) as parent:
        while "epoch 2" not in parent.stdout.readline():
            pass
        parent.kill()
    with open(run / ".lock", "rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # waits for ever for a training that goes on

    assert main(["fit", "--resume", str(run), "--trainer.max_epochs", "1"]) == 0
