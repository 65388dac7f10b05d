"""Processes of one training on this machine, as `torchrun` would start them."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

__all__ = ["TIMEOUT", "finish", "start_ranks"]

TIMEOUT = 240
"""Seconds after which a test ends processes that wait for each other."""


def start_ranks(*command, ranks=2, cwd=None, **environment):
    """Start `python COMMAND` once for each rank, and return the processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    here = Path(__file__).parent
    shared = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": str(ranks),
        "LOCAL_WORLD_SIZE": str(ranks),
        "TORCHELASTIC_RUN_ID": "test",  # by which Lightning knows that the processes are there
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(here.parent), str(here), os.environ.get("PYTHONPATH", "")]),
    }
    return [
        subprocess.Popen(
            [sys.executable, *map(str, command)],
            cwd=cwd,
            env=os.environ | shared | environment | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(ranks)
    ]


def finish(processes, timeout=TIMEOUT):
    """Wait for processes, and return exit status, stdout and stderr of each; kill those that hang."""
    end, found = time.monotonic() + timeout, []
    try:
        for process in processes:
            out, err = process.communicate(timeout=max(0.1, end - time.monotonic()))
            found.append((process.returncode, out, err))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    return found
