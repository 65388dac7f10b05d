"""A SLURM of one machine for tests: sbatch, srun, sacct, scancel and scontrol, as far as submitit calls them."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

__all__ = ["install", "processes_of", "submissions"]

COMMANDS = ("sbatch", "srun", "sacct", "scancel", "scontrol")


def install(folder, monkeypatch):
    """Put the commands into a folder, and the folder on PATH."""
    folder.mkdir()
    for name in COMMANDS:
        path = folder / name
        path.write_text(f'#!/bin/sh\nexec {sys.executable} {__file__} {name} "$@"\n')
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    return folder


def submissions(folder):
    """Return the text of each submitted script."""
    return [path.read_text() for path in sorted(folder.glob("*.script"))]


def processes_of(folder, job):
    """Return the processes of a job to which SLURM sends signals: all but the one that starts the script, and bash."""
    found, children = [], [int((folder / f"{job}.pid").read_text())]
    while children:
        listed = subprocess.run(["ps", "-o", "pid=,comm=", "--ppid", ",".join(map(str, children))], capture_output=True)
        rows = [line.split() for line in listed.stdout.decode().splitlines()]
        children = [int(pid) for pid, *_ in rows]
        found += [int(pid) for pid, name, *_ in rows if name not in ("bash", "sh")]
    return found


def sbatch(folder, script):
    text = Path(script).read_text()
    if "--partition=none" in text:
        sys.exit("sbatch: error: invalid partition specified: none\nsbatch: error: Batch job submission failed")
    number = 100 + len([*folder.glob("*.script")])
    (folder / f"{number}.script").write_text(text)
    array = re.search(r"--array=0-(\d+)", text)
    for task in range(int(array[1]) + 1) if array else [None]:
        name = f"{number}" if task is None else f"{number}_{task}"
        (folder / f"{name}.state").write_text("RUNNING")
        arguments = [sys.executable, __file__, "task", name, f"{folder / str(number)}.script"]
        process = subprocess.Popen(
            arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        (folder / f"{name}.pid").write_text(str(process.pid))
    print(f"Submitted batch job {number}")


def task(folder, name, script):
    """Run a script until it is queued again no more."""
    number, _, index = name.partition("_")
    of_job = {"SLURM_JOB_ID": number, "SLURM_JOB_NUM_NODES": "1", "SLURM_NTASKS": "1", "SLURM_CPUS_PER_TASK": "1"}
    of_array = {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": index} if index else {}
    again = True
    while again:
        status = subprocess.run(["bash", script], env=os.environ | of_job | of_array).returncode
        again = (folder / f"{name}.requeue").exists()
        (folder / f"{name}.requeue").unlink(missing_ok=True)
    if (folder / f"{name}.state").read_text() == "RUNNING":
        (folder / f"{name}.state").write_text("FAILED" if status else "COMPLETED")


def srun(folder, *arguments):
    number, index = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    for option, stream in (("--output", 1), ("--error", 2)):
        path = arguments[arguments.index(option) + 1].replace("%t", "0").replace("%j", os.environ["SLURM_JOB_ID"])
        path = path.replace("%A", str(number)).replace("%a", str(index))
        os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), stream)
    command = arguments[arguments.index("--error") + 2 :]
    cpus = dict(option.lstrip("-").split("=") for option in command if option.startswith("--cpus"))
    os.environ["SLURM_CPUS_PER_TASK"] = cpus.get("cpus-per-task", "1")  # that of the step, not of the job
    os.execv(command[len(cpus)], command[len(cpus) :])


def sacct(folder, *arguments):
    print("JobID|State|NodeList")
    for path in folder.glob("*.state"):
        print(f"{path.stem}|{path.read_text()}|here")


def scancel(folder, job):
    (folder / f"{job}.state").write_text("CANCELLED by 0")
    for process in processes_of(folder, job):
        os.kill(process, signal.SIGTERM)


def scontrol(folder, action, job):
    (folder / f"{job}.{action}").touch()


if __name__ == "__main__":
    name, *rest = sys.argv[1:]
    {**{each: globals()[each] for each in COMMANDS}, "task": task}[name](Path(os.environ["FAKE_SLURM"]), *rest)
