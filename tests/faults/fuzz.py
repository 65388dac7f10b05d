"""Inputs that nobody meant: damaged files for every reader, configurations with odd values for `forbes fit`."""

import contextlib
import copy
import io
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from damage import Kind, damaged, read_or_sentence
from faults.outcome import Outcome
from faults.victims import changed_file

from forbes.commands.cli import main

__all__ = ["configurations", "reader"]

HANGS = 60  # seconds
LIMITS = ["--trainer.max_steps", "1", "--trainer.limit_val_batches", "0"]
COMMAND = "touch OWNED"
ODD: list[Any] = [
    *(None, "", "x", "é\0", "../../x", "/", True, -1, 0, 1, 0.5, 7, 10**30, 1e308, float("nan"), float("inf")),
    *([], {}, [1], {"a": 1}, {"class_path": None}, {"class_path": "x", "init_args": 3}, "forbes.models.MLPEncoder"),
    {"class_path": "os.system", "init_args": {"command": COMMAND}},
    {"class_path": "torch.utils.collect_env.run", "init_args": {"command": COMMAND}},
    {"class_path": "forbes.files.replace_file", "init_args": {"path": "OWNED", "content": ""}},
]


def reader(kind: Kind, inputs: int, seed: int) -> Outcome:
    """Read damaged files of a kind; complain of what is neither read nor said in one sentence."""
    outcome, generator = Outcome(kind.name, cases=inputs), random.Random(f"{kind.name} {seed}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / kind.name
        kind.write(path)
        whole = path.read_bytes()
        for _ in range(inputs):
            path.write_bytes(damaged(whole, generator))
            try:
                with _alarm(), warnings.catch_warnings(action="ignore"):
                    read_or_sentence(kind.read, path)
            except Exception:
                outcome.broken.append(traceback.format_exc(limit=-3))
    return outcome


def configurations(config: Path, folder: Path, inputs: int, seed: int) -> Outcome:
    """Give changed configurations to `forbes fit` for an update.

    Complain of tracebacks, hangs, long sentences, and of what is written outside the run or run as a command.
    """
    outcome, outside = Outcome("a configuration", cases=inputs), list[str]()
    _watch_writes(outside, (str(folder), tempfile.gettempdir(), "/dev/"))
    folder.mkdir(parents=True)
    whole = yaml.safe_load(config.read_text())
    del whole["trainer"]
    for number, changed in enumerate(_changed(whole, inputs, seed)):
        path, output = folder / f"{number}.yaml", io.StringIO()
        path.write_text(yaml.safe_dump(changed))
        command = ["--allow-module", "toy_environments", "fit", "--config", str(path), *LIMITS]
        try:
            with _alarm(), contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                status = main([*command, "--run_dir", str(folder / str(number))])
        except (Exception, SystemExit):
            outcome.broken.append(f"{changed}: {traceback.format_exc(limit=-3)}")
            continue
        sentence = (output.getvalue().strip().splitlines() or [""])[-1].replace(str(folder), "")
        if status not in (0, 2, 3) or (status and len(sentence) >= 300):
            outcome.broken.append(f"{changed}: status {status}: {sentence}")
        if outside:
            outcome.broken.append(f"{changed}: wrote or ran {outside}")
            outside.clear()
        for process in multiprocessing.active_children():  # of an environment; the end of a command would end them
            process.kill()
    return outcome


def _watch_writes(outside: list[str], inside: tuple[str, ...]) -> None:
    """List what this process writes elsewhere, and commands that it runs."""

    def hook(event: str, found: tuple[Any, ...]) -> None:
        path = changed_file(event, found)
        if path is not None:
            if not os.path.realpath(path).startswith(inside):
                outside.append(f"{event} {path}")
        elif event in ("os.system", "subprocess.Popen") and COMMAND in str(found):
            outside.append(f"{event} {found}")

    sys.addaudithook(hook)


def _changed(whole: dict[str, Any], inputs: int, seed: int) -> Iterator[dict[str, Any]]:
    """Give a configuration with one or two of its values, keys or sections changed, left out, or exchanged."""
    generator = random.Random(f"configurations {seed}")
    for _ in range(inputs):
        config = copy.deepcopy(whole)
        for _ in range(generator.choice([1, 1, 2])):
            holder, key = generator.choice(list(_places(config)))
            change = generator.randrange(4)
            if change == 0:
                del holder[key]
            elif change == 1:
                other, name = generator.choice(list(_places(config)))
                holder[key] = copy.deepcopy(other[name])
            elif change == 2 and isinstance(key, str):
                holder[generator.choice(["", "x", f"{key}s", key.upper()])] = holder.pop(key)
            else:
                holder[key] = copy.deepcopy(generator.choice(ODD))
        yield config


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Give every (holder, key) of a tree of mappings and lists."""
    for key, value in list(node.items() if isinstance(node, dict) else enumerate(node)):
        yield node, key
        if isinstance(value, dict | list):
            yield from _places(value)


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    def hangs(*_: object) -> None:
        raise TimeoutError(f"hangs for {HANGS} s")

    before = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(HANGS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
