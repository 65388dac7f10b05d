"""Jobs as tasks of a Ray cluster. A lost worker or node costs at most the updates since the last checkpoint.

Where a node does not see the output folder, it trains in a temporary folder, and each new checkpoint is brought back
with the rest of the run folder. So a job continues on any node.
"""

import os
import queue
import secrets
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import ray
from ray.exceptions import RayError, TaskCancelledError

from forbes.commands.jobs import Job, checkpoint_time
from forbes.commands.launchers.process import end, follow, start
from forbes.errors import ForbesError
from forbes.files import replace_file

__all__ = ["Ray"]

_POLL = 1.0  # seconds between looks for a new checkpoint


class Ray:
    """Runs jobs on an existing Ray cluster, whose nodes have this package.

    Args:
        folder: output folder of the command.
        address: address of the cluster; None for RAY_ADDRESS or a cluster on this machine.
        cpus: CPUs, and threads, of each job.
        gpus: GPUs of each job; jobs with 0.25 share one by four.
        at_once: largest number of jobs that are submitted at the same time.
    """

    def __init__(self, folder: Path, address: str | None, cpus: int, gpus: float, at_once: int) -> None:
        self.at_once = at_once
        self._folder, self._address, self._cpus, self._gpus = folder, address, cpus, gpus
        self._mark = (folder / f".seen-{secrets.token_hex(8)}").absolute()
        self._lock, self._stopping = threading.Lock(), False
        self._running: dict[str, Any] = {}  # results of the tasks by name

    @contextmanager
    def ready(self, jobs: Sequence[Job]) -> Iterator[None]:
        """Connect to the cluster.

        Raises:
            ForbesError: if there is none.
        """
        handler, address = signal.getsignal(signal.SIGTERM), self._address or os.environ.get("RAY_ADDRESS", "auto")
        try:
            _require_answer(address)
            ray.init(address=address, log_to_driver=False, logging_level="WARNING")
            signal.signal(signal.SIGTERM, handler)  # Ray's own would end this process before its jobs
        except (OSError, RuntimeError, ValueError) as error:
            where = "here" if address == "auto" else f"at {address}"
            raise ForbesError(
                f"--launcher ray: no Ray cluster {where}. Start one: ray start --head, or name one: --address HOST:PORT"
            ) from error
        self._say_if_too_small()
        replace_file(self._mark, b"")
        try:
            yield
        finally:
            self._mark.unlink(missing_ok=True)
            ray.shutdown()

    def attempt(self, job: Job, say: Callable[[str], None]) -> int:
        """Run a job as a task, and return its exit status; 1 if its worker or node was lost."""
        task = ray.remote(num_cpus=self._cpus, num_gpus=self._gpus, max_retries=0)(_work)
        content = ray.put(_Content(_files_named(job), _files_of(job.run) if job.run else {}))
        with self._lock:
            if self._stopping:
                return -signal.SIGTERM
            results = task.options(name=job.name).remote(job, self._cpus, str(Path.cwd()), str(self._mark), [content])
            self._running[job.name] = results
        status = 1
        try:
            for result in results:
                found = ray.get(result)
                if isinstance(found, str):
                    say(found)
                elif isinstance(found, dict):
                    _write(Path(job.run), found)
                else:
                    status = found
        except TaskCancelledError:
            return -signal.SIGTERM
        except RayError as error:
            say(f"lost: {str(error).strip().splitlines()[-1]}")
            return 1
        finally:
            with self._lock:
                del self._running[job.name]
        return status

    def stop(self) -> None:
        """Cancel all tasks. A running one stops its training at an update, with a checkpoint."""
        with self._lock:
            self._stopping = True
            for results in self._running.values():
                ray.cancel(results)

    def _say_if_too_small(self) -> None:
        """Print that no node has room for a job; a cluster may grow."""
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(node.get("CPU", 0) >= self._cpus and node.get("GPU", 0) >= self._gpus for node in nodes):
            print(f"no node of the cluster has {self._cpus} CPUs and {self._gpus:g} GPUs: waiting for one", flush=True)


def _require_answer(address: str) -> None:
    """Raise an error if nobody answers at HOST:PORT, since Ray would try for seven minutes."""
    if address != "auto":
        host, _, port = address.rpartition(":")
        with socket.create_connection((host, int(port)), timeout=10):
            pass


class _Content(NamedTuple):
    """Files that a node needs which does not see the output folder."""

    named: Mapping[str, bytes]
    """Files that are named in the command, by their name there."""
    run: Mapping[str, bytes]
    """Files of the run folder, by their path in it."""


def _work(
    job: Job, threads: int, place: str, mark: str, content: Sequence[Any]
) -> Iterator[str | dict[str, bytes] | int]:
    """Run a job on a node. Yield its lines, its run folder after each checkpoint if needed, and its exit status.

    Args:
        job: job to run.
        threads: CPU threads.
        place: working directory of the command, used if the node sees the output folder.
        mark: file in the output folder, which shows whether the node sees it.
        content: reference of a `_Content`, used if it does not.
    """
    yield f"starts on {socket.gethostname()}, node {ray.get_runtime_context().get_node_id()}"
    if Path(mark).is_file():
        with closing(_lines(start(job.current(), threads, place))) as lines:
            yield from (found for found in lines if found != "")
        return
    with tempfile.TemporaryDirectory(prefix="forbes-") as folder:
        moved = _moved(job, ray.get(content[0]), Path(folder))
        sent = checkpoint_time(moved)
        with closing(_lines(start(moved.current(), threads, folder))) as lines:
            for found in lines:
                now = checkpoint_time(moved)
                if now != sent or isinstance(found, int):
                    sent = now
                    yield _files_of(moved.run)
                if found != "":
                    yield found


def _lines(process: subprocess.Popen[str]) -> Generator[str | int, None, None]:
    """Yield the lines of a process, an empty line when it is silent, and its exit status; end it if interrupted."""
    lines: queue.Queue[str | int] = queue.Queue()
    threading.Thread(target=lambda: lines.put(follow(process, lines.put)), daemon=True).start()
    found: str | int = ""
    try:
        while isinstance(found, str):
            try:
                found = lines.get(timeout=_POLL)
            except queue.Empty:
                found = ""
            yield found
    finally:
        end(process)


def _moved(job: Job, content: _Content, folder: Path) -> Job:
    """Write the content to a folder, and return the job with its paths in that folder."""
    run = folder / "run"
    _write(run, content.run)
    places = {job.run: str(run)}
    for number, (name, of_file) in enumerate(content.named.items()):
        places[name] = str(folder / f"{number}-{Path(name).name}")
        replace_file(Path(places[name]), of_file)
    command, resume = ([places.get(word, word) for word in words] for words in (job.command, job.resume))
    return job._replace(command=command, resume=resume, run=str(run))


def _files_named(job: Job) -> dict[str, bytes]:
    """Return the files that are named in a command, e.g. configurations."""
    return {word: Path(word).read_bytes() for word in job.command if Path(word).is_file()}


def _files_of(run: str) -> dict[str, bytes]:
    """Return the files of a run folder: checkpoints first, so that the metrics are not older."""
    paths = [path for path in Path(run).rglob("*") if path.is_file() and not path.name.startswith(".")]
    paths.sort(key=lambda path: (path.parent.name != "checkpoints", path))
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in paths}


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write the files that have changed, the checkpoints last, so that a kill leaves metrics that are not older."""
    for name, of_file in reversed([*files.items()]):
        path = folder / name
        if not path.is_file() or path.read_bytes() != of_file:
            replace_file(path, of_file)
