"""The short form of `make faults`."""

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]


def test_kills_are_resumed_and_bad_inputs_are_one_sentence():
    """It forks, and so has a process of its own, without the threads of this one."""
    numbers = ["--kills", "20", "--inputs", "60", "--starts", "5", "--epochs", "30"]
    command = [sys.executable, "-m", "faults", "--short", *numbers]
    path = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))

    ended = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)

    assert ended.returncode == 0, ended.stdout + ended.stderr
