"""Processes of one training on this machine, as `torchrun` would start them."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

__all__ = ["TIMEOUT", "environment", "finish", "start_ranks"]

TIMEOUT = 300
"""Seconds after which a test ends processes that wait for each other."""


def environment():
    """Return the environment of a process that finds the package and what the tests share, with one thread."""
    here = Path(__file__).parent
    path = os.pathsep.join([str(here.parent), str(here), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path}


def start_ranks(*command, ranks=2):
    """Start `python COMMAND` once for each rank, and return the processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = environment() | {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": str(ranks),
        "LOCAL_WORLD_SIZE": str(ranks),
        "TORCHELASTIC_RUN_ID": "test",  # by which Lightning knows that the processes are there
    }
    return [
        subprocess.Popen(
            [sys.executable, *map(str, command)],
            env=shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(ranks)
    ]


def finish(processes):
    """Wait for processes, and return exit status, stdout and stderr of each; end those that hang."""
    end, found = time.monotonic() + TIMEOUT, []
    try:
        for process in processes:
            out, err = process.communicate(timeout=max(0.1, end - time.monotonic()))
            found.append((process.returncode, out, err))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    return found
