"""The processes (ranks) of one training or evaluation: who started them, and what they agree on.

`--trainer.devices N` lets Lightning start the others from this one, with the same command line. `torchrun` and SLURM
start all of them.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch.distributed as dist

from forbes.distributed import num_ranks, rank
from forbes.errors import ForbesError

__all__ = ["chosen_by_first", "connected", "is_first", "launched_devices", "lost_process", "num_from_torchrun"]

_RUN = "FORBES_RUN_FOLDER"
_RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID")
"""Variables with the number of a process: of torchrun, of Lightning (which SLURM's would hide), and of SLURM."""


def is_first() -> bool:
    """Return whether this is the process that writes; known before the processes are connected."""
    if num_ranks() > 1:
        return rank() == 0
    return int(next((os.environ[name] for name in _RANKS if name in os.environ), 0)) == 0


def launched_devices() -> tuple[int, int] | None:
    """Return the number of processes per machine and of machines, if torchrun or SLURM started several.

    Raises:
        ForbesError: if SLURM does not say how many are on a machine.
    """
    if dist.is_torchelastic_launched():
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
    if dist.is_torchelastic_launched() and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        address = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store = dist.TCPStore(*address, is_master=False)  # type: ignore[attr-defined]  # from C++
        key = f"{_RUN}/{os.environ['TORCHELASTIC_RESTART_COUNT']}"
        if is_first():
            store.set(key, choose())
        return str(store.get(key).decode())
    if dist.is_torchelastic_launched() or _slurm_tasks() > 1 or not (is_first() or _RUN in os.environ):
        raise ForbesError("forbes fit: several processes train, expected a folder for them. Name it: --run_dir DIR")
    if is_first():
        os.environ[_RUN] = choose()  # Lightning starts the others with this environment
    return os.environ[_RUN]


def num_from_torchrun() -> int:
    """Return the number of processes that torchrun started, of which this is one; 1 without torchrun."""
    return int(os.environ["WORLD_SIZE"]) if dist.is_torchelastic_launched() else 1


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
