"""Commands of forbes that end at a chosen instant, each in a process of its own.

An audit hook (PEP 578) sees every operation on a file of a folder: opened to be written, renamed, linked, removed. So a
process can be ended before each of them, at all instants between which the disk differs, and the package needs no
hooks of its own. The processes are forked from one that has imported everything, and begin within milliseconds.
"""

import atexit
import fcntl
import gc
import os
import re
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from forbes.commands.cli import main

__all__ = ["LIMIT", "Ending", "Fault", "changed_file", "left_over", "run", "run_real"]

OPERATIONS = {"os.rename", "os.link", "os.remove", "os.mkdir", "os.truncate"}
LIMIT = 300  # seconds, after which a command hangs
GRACE = 2.0  # seconds in which what a dead process has started must have ended


class Fault(NamedTuple):
    """What ends a process, and when."""

    signal: signal.Signals
    at: int | float
    """Before the operation of this number, from 1; or after so many seconds."""
    group: bool = False
    """To the whole process group, as Ctrl-C on a terminal and `timeout` do."""

    def __str__(self) -> str:
        when = f"before operation {self.at}" if isinstance(self.at, int) else f"after {self.at:.2f} s"
        return f"{self.signal.name} to the {'group' if self.group else 'process'} {when}"


class Ending(NamedTuple):
    """How a command has ended."""

    status: int
    """As `subprocess` has it: minus the signal where one has ended it."""
    output: str
    operations: list[str]
    left_over: list[int]
    """Processes that it has started and that have outlived it."""


def run(
    arguments: list[object], folder: Path, fault: Fault | None = None, before: Callable[[], object] = lambda: None
) -> Ending:
    """Run a command in a fork of this process; watch what it does in a folder, and end it as the fault says.

    Args:
        arguments: of the command.
        folder: where its files are.
        fault: what ends it.
        before: is called in the new process first.
    """
    output, operations = _Pipe(), _Pipe()
    process = os.fork()
    if process == 0:
        gc.freeze()  # what there is belongs to the parent, see `forked`
        files = output.written, operations.written
        _command([str(argument) for argument in arguments], folder, fault, before, *files)
    status = os.waitstatus_to_exitcode(_wait(process, fault))
    return Ending(status, output.content(), operations.content().splitlines(), left_over(process))


class _Pipe:
    """Holds what a process writes; it is no file, since a limit of their size would hold for it too."""

    def __init__(self) -> None:
        self.read, self.written = os.pipe()
        fcntl.fcntl(self.written, fcntl.F_SETPIPE_SZ, 2**20)

    def content(self) -> str:
        """Return what was written, whoever may still write."""
        os.close(self.written)
        os.set_blocking(self.read, False)
        with open(self.read, "rb") as reader:
            return (reader.read() or b"").decode(errors="replace")


def run_real(arguments: list[object], folder: Path, fault: Fault | None = None) -> Ending:
    """Run a command as a user does, start-up and all. Its files are not watched, so faults go by the clock."""
    output = _Pipe()
    command = [sys.executable, "-m", "forbes", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=output.written, stderr=subprocess.STDOUT, start_new_session=True)
    process.returncode = os.waitstatus_to_exitcode(_wait(process.pid, fault))
    return Ending(process.returncode, output.content(), [], left_over(process.pid))


def left_over(session: int) -> list[int]:
    """Return the processes of a session that have not ended within the grace period; end them."""
    deadline = time.monotonic() + GRACE
    while (alive := _of_session(session)) and time.monotonic() < deadline:
        time.sleep(0.02)
    for process in alive:
        os.kill(process, signal.SIGKILL)
    return alive


def _command(
    arguments: list[str],
    folder: Path,
    fault: Fault | None,
    before: Callable[[], object],
    output: int,
    operations: int,
) -> None:
    """Be the forked process."""
    status = 1
    try:
        os.setsid()
        sys.modules["__main__"] = ModuleType("__main__")  # spawned processes would import that of the tests
        os.dup2(output, 1)
        os.dup2(output, 2)
        _watch(folder, fault, operations)
        before()
        status = main(arguments)
        atexit._run_exitfuncs()
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:  # whatever happens, this process is not a second one that injects faults
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def changed_file(event: str, arguments: tuple[object, ...]) -> str | None:
    """Return the file or folder that an audited operation changes, or opens to write; None for any other event."""
    opened = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    named = (opened or event in OPERATIONS) and isinstance(
        arguments[0], str | os.PathLike
    )  # a descriptor is open already
    return str(arguments[0]) if named else None


def _watch(folder: Path, fault: Fault | None, operations: int) -> None:
    prefix, count = f"{folder}{os.sep}", 0

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal count
        path = changed_file(event, arguments)
        if path is None or not path.startswith(prefix):
            return
        count += 1
        name = re.sub(r"\.[0-9a-f]{16}\b", ".*", path.removeprefix(prefix))
        os.write(operations, f"{event} {name}\n".encode())
        if fault is not None and count == fault.at:
            (os.killpg if fault.group else os.kill)(os.getpid(), fault.signal)

    sys.addaudithook(hook)


def _wait(process: int, fault: Fault | None) -> int:
    """Wait for a process, and send what is sent by the clock."""
    start, sent = time.monotonic(), fault is None or isinstance(fault.at, int)
    while time.monotonic() < start + LIMIT:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return status
        if not sent and fault is not None and time.monotonic() >= start + fault.at:
            (os.killpg if fault.group else os.kill)(process, fault.signal)
            sent = True
        time.sleep(0.01)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    raise TimeoutError(f"a command hangs: not ended within {LIMIT} s")


def _of_session(session: int) -> list[int]:
    """Return the living processes of a session."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session, *_ = path.read_text().rpartition(") ")[2].split()
        except OSError:  # it has just ended
            continue
        if int(its_session) == session and state not in "ZX":
            found.append(int(path.parent.name))
    return found
