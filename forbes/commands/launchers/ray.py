"""Jobs as tasks of a Ray cluster. A lost worker or node costs at most the updates since the last checkpoint.

Where a node does not see the output folder, it trains in a temporary copy of the run folder. With each new checkpoint,
the files that have changed are brought back. So a job continues on any node.
"""

import itertools
import os
import queue
import secrets
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import ray
from ray.exceptions import RayError, TaskCancelledError

from forbes.commands.jobs import Job, checkpoint_time
from forbes.commands.launchers.changes import changes, stamps, write_changes
from forbes.commands.launchers.process import end, follow, start
from forbes.errors import ForbesError
from forbes.files import replace_file
from forbes.runs.folder import RunFolder

__all__ = ["Ray"]

_POLL = 1.0  # seconds between looks for a new checkpoint
_UNSEEN = 1000
"""Status of a task that was not run, since its node does not see the output folder; no process ends with it."""


class _Content(NamedTuple):
    """Files that a node needs which does not see the output folder."""

    named: Mapping[str, bytes]
    """Configurations that are named in the command, by their name there."""
    run: Mapping[str, Any]
    """References of the files of the run folder, by their path in it."""


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
        self._address, self._cpus, self._gpus = address, cpus, gpus
        self._mark = (folder / f".seen-{secrets.token_hex(8)}").absolute()
        self._lock, self._stopping = threading.Lock(), False
        self._running: dict[str, Any] = {}  # results of the tasks by name
        self._must_send = False  # whether a node was seen that does not see the output folder

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
        except RuntimeError as error:  # other versions, e.g.
            reason = " ".join(str(error).split())
            raise ForbesError(f"--launcher ray: the cluster cannot be joined ({reason}). Change one of them") from error
        except (OSError, ValueError) as error:
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
        """Run a job as a task, and return its exit status; 1 if its worker or node was lost.

        Raises:
            ForbesError: if the run folder is written to by another process, or cannot be written.
        """
        status = _UNSEEN if self._must_send else self._run(job, None, say)
        if status != _UNSEEN:
            return status
        self._must_send = True
        with RunFolder(job.run).locked() if job.run else nullcontext():  # no node can lock it
            return self._run(job, _content_of(job), say)

    def _run(self, job: Job, content: _Content | None, say: Callable[[str], None]) -> int:
        """Run a task, and return its exit status; `_UNSEEN` if its node needs the content."""
        task = ray.remote(num_cpus=self._cpus, num_gpus=self._gpus, max_retries=0)(_work)
        with self._lock:
            if self._stopping:
                return -signal.SIGTERM
            results = task.options(name=job.name).remote(job, self._cpus, str(Path.cwd()), str(self._mark), content)
            self._running[job.name] = results
        status = 1
        try:
            for result in results:
                found = ray.get(result)
                if isinstance(found, str):
                    say(found)
                elif isinstance(found, dict):
                    write_changes(Path(job.run), found)
                else:
                    status = found
        except TaskCancelledError:
            return -signal.SIGTERM
        except RayError as error:
            say(f"lost: {str(error).strip().splitlines()[-1]}")
            return 1
        except ForbesError:  # the folder cannot be written
            ray.cancel(results)
            raise
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


def _content_of(job: Job) -> _Content:
    """Put the files that a job needs into the cluster, one at a time, since an agent's episodes take gigabytes.

    Data are not among them: a run records where they are, and is resumed and evaluated elsewhere.
    """
    configs = [word for flag, word in itertools.pairwise(job.command) if flag == "--config" and Path(word).is_file()]
    named = {config: Path(config).read_bytes() for config in configs}
    stored = stamps(job.run) if job.run else {}
    return _Content(named, {name: ray.put(Path(job.run, name).read_bytes()) for name in stored})


def _work(
    job: Job, threads: int, place: str, mark: str, content: _Content | None
) -> Iterator[str | dict[str, bytes | None] | int]:
    """Run a job on a node. Yield its lines, what changes in its run folder if it must be sent, and its exit status.

    Args:
        job: job to run.
        threads: CPU threads.
        place: working directory of the command, used without `content`.
        mark: file in the output folder, which shows whether the node sees it.
        content: files that the job needs; None to use those of the output folder. If the node does not see it, the job
            is not run, and `_UNSEEN` is yielded.
    """
    if content is None and not Path(mark).is_file():
        yield _UNSEEN
        return
    yield f"starts on {socket.gethostname()}, node {ray.get_runtime_context().get_node_id()}"
    if content is None:
        with closing(_lines(start(job.current(), threads, place))) as lines:
            yield from (found for found in lines if found != "")
        return
    with tempfile.TemporaryDirectory(prefix="forbes-") as folder:
        moved = _moved(job, content, Path(folder))
        known, sent = stamps(moved.run), checkpoint_time(moved)
        with closing(_lines(start(moved.current(), threads, folder))) as lines:
            for found in lines:
                now = checkpoint_time(moved)
                if now != sent or isinstance(found, int):
                    sent = now
                    yield changes(moved.run, known)
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
    for name, reference in content.run.items():
        replace_file(run / name, ray.get(reference))
    places = {job.run: str(run)}
    for number, (name, of_file) in enumerate(content.named.items()):
        places[name] = str(folder / f"{number}-{Path(name).name}")
        replace_file(Path(places[name]), of_file)
    command, resume = ([places.get(word, word) for word in words] for words in (job.command, job.resume))
    return job._replace(command=command, resume=resume, run=str(run))
