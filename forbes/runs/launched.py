"""The processes (ranks) of one training or evaluation: who started them, what they agree on, how they end together.

`--trainer.devices N` lets Lightning start the others from this one, with the same command line. `torchrun` and SLURM
start all of them.
"""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch.distributed as dist
from lightning import Callback, LightningModule, Trainer
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.pytorch.utilities import rank_zero_only

from forbes.errors import ForbesError
from forbes.runs.folder import RunFolder

__all__ = [
    "EndTogether",
    "chosen_by_first",
    "connected",
    "is_first",
    "launched_devices",
    "lost_process",
    "num_from_torchrun",
]

_RUN = "FORBES_RUN_FOLDER"
_GRACE = 5.0
"""Seconds for a process to end by itself after another has."""


def is_first() -> bool:
    """Return whether this is the process that writes; known before the processes are connected."""
    rank: int = rank_zero_only.rank  # type: ignore[attr-defined]  # an attribute of a function
    return rank == 0


def launched_devices() -> tuple[int, int] | None:
    """Return the number of processes per machine and of machines, if torchrun or SLURM started several.

    Raises:
        ForbesError: if SLURM does not say how many are on a machine.
    """
    if TorchElasticEnvironment.detect():
        here, everywhere = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
        return here, everywhere // here
    if (tasks := _slurm_tasks()) == 1:
        return None
    if "SLURM_NTASKS_PER_NODE" not in os.environ:
        raise ForbesError(f"SLURM: has {tasks} tasks, expected --ntasks-per-node too. Add it to the job")
    here = int(os.environ["SLURM_NTASKS_PER_NODE"])
    return here, tasks // here


def _slurm_tasks() -> int:
    """Return the number of processes that `srun` started; an interactive shell is one."""
    interactive = os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive")
    return 1 if interactive else int(os.environ.get("SLURM_NTASKS", 1))


def chosen_by_first(choose: Callable[[], str]) -> str:
    """Return the folder that the first process chooses, in all processes of a training.

    Raises:
        ForbesError: if the processes have no way to agree yet.
    """
    if TorchElasticEnvironment.detect() and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        address = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store = dist.TCPStore(*address, is_master=False)  # type: ignore[attr-defined]  # from C++
        key = f"{_RUN}/{os.environ['TORCHELASTIC_RESTART_COUNT']}"
        if is_first():
            store.set(key, choose())
        return str(store.get(key).decode())
    if TorchElasticEnvironment.detect() or _slurm_tasks() > 1 or not (is_first() or _RUN in os.environ):
        raise ForbesError("forbes fit: several processes train, expected a folder for them. Name it: --run_dir DIR")
    if is_first():
        os.environ[_RUN] = choose()  # Lightning starts the others with this environment
    return os.environ[_RUN]


def num_from_torchrun() -> int:
    """Return the number of processes that torchrun started, of which this is one; 1 without torchrun."""
    return int(os.environ["WORLD_SIZE"]) if TorchElasticEnvironment.detect() else 1


@contextmanager
def connected() -> Iterator[None]:
    """Connect the processes that torchrun has started, if it has, for a command without Lightning's Trainer.

    Raises:
        ForbesError: if one of them ends.
    """
    if num_from_torchrun() == 1:
        yield
        return
    dist.init_process_group("gloo")
    try:
        yield
    except RuntimeError as error:
        if not lost_process(error):
            raise
        raise ForbesError("a process of this command has ended, so all end. Repeat it to continue") from error
    finally:
        dist.destroy_process_group()


def lost_process(error: BaseException) -> bool:
    """Return whether an error says that another process of the training has ended."""
    return isinstance(error, dist.DistError) or any(text in str(error) for text in ("closed by peer", "gloo/"))


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
