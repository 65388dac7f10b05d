"""The forks of tests."""

import gc
import os

from forked import run_in_a_fork


class Garbage:
    """Something that only the garbage collector finds; it ends a process in which it should not be collected."""

    def __init__(self):
        self.itself, self.made_in = self, os.getpid()

    def __del__(self):
        if os.getpid() != self.made_in:
            os._exit(1)


def test_a_fork_does_not_collect_what_its_parent_left():
    gc.disable()
    try:
        Garbage()
        assert run_in_a_fork(gc.collect) == 0
    finally:
        gc.enable()
