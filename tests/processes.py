"""Whether a process that is not our own child has ended."""

import os
import time

__all__ = ["ends"]


def ends(process, seconds=30):
    """Wait for it."""
    deadline = time.monotonic() + seconds
    while not (ended := _gone(process)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return ended


def _gone(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    with open(f"/proc/{process}/stat") as file:  # nobody may be left to collect it
        return file.read().rpartition(") ")[2].startswith("Z")
