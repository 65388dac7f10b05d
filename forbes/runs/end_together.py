"""How the processes of one training end together."""

import os
import sys
import threading
import time
from typing import Any

from lightning import Callback, LightningModule, Trainer

from forbes.runs.folder import RunFolder
from forbes.runs.launched import is_first, launched_devices

__all__ = ["EndTogether"]

_GRACE = 5.0
"""Seconds for a process to end by itself after another has."""


class EndTogether(Callback):
    """Ends the processes that Lightning has started when one of them dies, with one sentence.

    A process notices that another is gone when it next communicates, unless it waits on a GPU, or the first plays
    episodes. Lightning would kill the first process within five seconds, without a word.

    Args:
        run: run folder, for the sentence.
    """

    def __init__(self, run: RunFolder) -> None:
        self.run = run
        self._over = threading.Event()

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Start to watch, if Lightning has started processes or this is one of them."""
        others: list[Any] = list(getattr(trainer.strategy.launcher, "procs", []))
        for thread in threading.enumerate():
            if thread.name == "child-process-observer":
                thread._child_processes = []  # type: ignore[attr-defined]  # Lightning's has nothing to observe then
        if others:
            threading.Thread(target=self._watch, args=(others,), daemon=True).start()
        elif not is_first() and launched_devices() is None:
            threading.Thread(target=self._follow, args=(os.getppid(),), daemon=True).start()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Stop watching: each process ends by itself now."""
        self._over.set()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Stop watching: this process ends already."""
        self._over.set()

    def sentence(self) -> str:
        """Return what happened, and how to continue."""
        resume = f"Resume from its last checkpoint: forbes fit --resume {self.run}"
        remedy = resume if self.run.checkpoint.exists() else "There is no checkpoint yet; repeat the command"
        return f"{self.run}: a process of this training has ended, so all end. {remedy}"

    def _watch(self, others: list[Any]) -> None:
        while not self._over.wait(0.5):
            if any(process.poll() for process in others):
                time.sleep(_GRACE)  # the main thread may notice, and end in order
                print(f"forbes: {self.sentence()}", file=sys.stderr, flush=True)
                for process in others:
                    process.kill()
                os._exit(2)

    def _follow(self, first: int) -> None:
        while not self._over.wait(0.5):
            if os.getppid() != first:
                time.sleep(_GRACE)
                os._exit(2)
