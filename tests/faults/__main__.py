"""Break what can be broken, count what is lost, and write it down: `make faults`."""

import argparse
import collections
import functools
import multiprocessing
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from pathlib import Path
from typing import NamedTuple

import small_agents
import small_strokes
import torch
from damage import KINDS
from faults import fuzz, kills, resources
from faults.outcome import Outcome

import forbes.commands.evaluate
import forbes.commands.fit

CHUNK = 100  # inputs of a task
SIZES = 100, 3_000, 30_000, 300_000  # bytes


class Group(NamedTuple):
    """Injections that test one promise."""

    promise: str
    injected: str
    tasks: Sequence[Callable[[], Outcome]]


def main() -> int:
    """Run all groups side by side and print a table; 1 where anything is broken."""
    parser = argparse.ArgumentParser(prog="python -m faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=300, help="signals sent, in all (300)")
    parser.add_argument("--inputs", type=int, default=3000, help="damaged inputs of each reader (3000)")
    parser.add_argument("--starts", type=int, default=1000, help="starts of an environment's process (1000)")
    parser.add_argument("--epochs", type=int, default=300, help="epochs of the long agent (300)")
    parser.add_argument("--short", action="store_true", help="without what other tests and other groups repeat")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="at once (one for each core)")
    parser.add_argument("--only", default="", help="groups whose promise has this in it")
    parser.add_argument("--report", type=Path, help="write the table to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    started = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="faults-"))  # a TemporaryDirectory would be removed by the first fork's end
    folder.chmod(0o755)  # another user finds what is in it
    try:
        groups = [group for group in _groups(folder, options) if options.only in group.promise]
        outcomes = _run(groups, options.processes)
    finally:
        shutil.rmtree(folder)
    rows = [_row(group, found) for group, found in zip(groups, outcomes, strict=True)]
    table = "\n".join(
        ["| promise | test | injected | cases | reached | broken |", "|---|---|---|---:|---:|---:|", *rows]
    )
    minutes = round((time.monotonic() - started) / 60)
    broken = [f"{outcome.what}: {complaint}" for found in outcomes for outcome in found for complaint in outcome.broken]
    notes = sorted({outcome.note for found in outcomes for outcome in found if outcome.note})
    print("\n".join([table, *notes, f"{minutes} minutes, {len(broken)} broken", *broken]))
    if options.report:
        options.report.write_text(REPORT.format(table=table, notes=" ".join(notes), minutes=minutes, **_here()))
    return bool(broken)


def _groups(folder: Path, options: argparse.Namespace) -> Iterator[Group]:
    """Make whole what is to be broken, and list the faults."""
    digits = small_strokes.write_config(folder / "strokes.yaml", small_strokes.write_strokes(folder / "strokes.npz"))
    agent, overlap = small_agents.write_config(folder), folder / "overlap.yaml"
    text = agent.read_text().replace("options: {steps: 8}", "options: {steps: 8}, capacity: 16")
    overlap.write_text(text.replace("seed_episodes: 2", "overlap: true, seed_episodes: 2"))

    strokes, acting = kills.training("strokes", digits), kills.training("agent", agent)
    overlapping = kills.training("agent with overlap and capacity", overlap)
    trained = folder / "whole" / strokes.name / "run"
    evaluation = kills.evaluation(trained)
    collection, starting, comparison = kills.collection(), kills.starting(strokes), kills.comparison(digits)
    shares = {strokes: 0.25, acting: 0.3, overlapping: 0.2, evaluation: 0.1, collection: 0.05}
    shares |= {starting: 0.06, comparison: 0.04}
    wholes = {scenario: scenario.straight(folder / "whole" / scenario.name) for scenario in shares}
    chunks = [(n, min(CHUNK, options.inputs - n)) for n in range(0, options.inputs, CHUNK)]
    read = [] if options.short else chunks  # tests/test_damaged_files.py reads the same kinds
    for scenario, share in shares.items():
        faults = kills.injections(wholes[scenario], max(1, round(share * options.kills)))
        strike = functools.partial(kills.strike, scenario, wholes[scenario].result)
        yield Group(
            f"{scenario.name}: cut off and begun again, it ends with the same bits",
            "SIGKILL before operations on files, one after another; SIGKILL, SIGTERM, SIGINT to process and group "
            "at random",
            [functools.partial(strike, folder / scenario.name / str(n), fault) for n, fault in enumerate(faults)],
        )
    writers = [strokes, acting, evaluation] if options.short else [strokes, acting, overlapping, evaluation]
    for scenario in (*writers, collection):  # of an agent with overlap, too, the parent alone writes
        place, whole = folder / f"without {scenario.name}", wholes[scenario].result
        yield Group(
            f"{scenario.name}: on a full disk it ends with one sentence, and nothing is lost",
            f"no file above {', '.join(f'{size:,}' for size in SIZES)} bytes",
            [functools.partial(resources.limited, scenario, whole, place / str(size), size) for size in SIZES],
        )
    yield Group(
        "a folder that may not be written is one sentence",
        "a training and an evaluation in a folder of another user",
        [
            functools.partial(resources.read_only, each, wholes[each].result, folder / f"read-only {each.name}")
            for each in (strokes, evaluation)
        ],
    )
    yield Group(
        "two at once do what one does, or one of them is refused",
        "two trainings, evaluations, collections, comparisons in one folder",
        [
            functools.partial(resources.two_at_once, each, wholes[each].result, folder / f"two of {each.name}")
            for each in (strokes, acting, evaluation, collection, comparison)
        ],
    )
    yield Group(
        "the clock does not matter",
        "one that goes back by an hour at each look",
        [
            functools.partial(resources.backwards, each, wholes[each].result, folder / f"clock of {each.name}")
            for each in writers
        ],
    )
    yield Group(
        "nothing grows with time",
        f"{options.starts} starts of an environment's process; {options.epochs} epochs of an agent with overlap and "
        "capacity: memory, descriptors, threads, disk",
        [
            functools.partial(resources.workers, options.starts),
            functools.partial(resources.long_agent, overlapping, folder / "long", options.epochs),
        ],
    )
    yield Group(
        "a damaged file is read, or named in one sentence",
        f"{', '.join(kind.name for kind in KINDS)}: bits flipped, bytes cut out, cut off, repeated, put in",
        [functools.partial(fuzz.reader, kind, number, seed) for kind in KINDS for seed, number in read],
    )
    yield Group(
        "a configuration trains, or is refused in one sentence, and writes nowhere else",
        "values, keys and sections of a configuration changed, left out, exchanged",
        [
            functools.partial(fuzz.configurations, agent, folder / f"configurations {seed}", number, seed)
            for seed, number in chunks
        ],
    )


def _run(groups: Sequence[Group], processes: int) -> list[list[Outcome]]:
    """Run every task in one of several processes, which are forked and so know the tasks."""
    tasks = [(number, task) for number, group in enumerate(groups) for task in group.tasks]
    global _execute

    def _execute(n: int) -> Outcome:
        return tasks[n][1]()

    outcomes: list[list[Outcome]] = [[] for _ in groups]
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("fork")) as pool:
        for (number, _), outcome in zip(tasks, pool.map(_execute, range(len(tasks))), strict=True):
            outcomes[number].append(outcome)
            for complaint in outcome.broken:
                print(f"BROKEN {outcome.what}: {complaint}", flush=True)
            if len(outcomes[number]) == len(groups[number].tasks):
                print(_row(groups[number], outcomes[number]), flush=True)
    return outcomes


def _row(group: Group, outcomes: Sequence[Outcome]) -> str:
    count = collections.Counter[str]()
    for outcome in outcomes:
        count.update(cases=outcome.cases, reached=outcome.cases * outcome.reached, broken=len(outcome.broken))
    counted = f"{count['cases']} | {count['reached']} | {count['broken']}"
    return f"| {group.promise} | {_test_of(group)} | {group.injected} | {counted} |"


def _test_of(group: Group) -> str:
    """Name the functions of `tests/faults` that inject the faults of a group."""
    names = {}
    for task in group.tasks:
        function = task
        while isinstance(function, functools.partial):
            function = function.func
        names[f"`{function.__module__.rpartition('.')[2]}.{function.__name__}`"] = None
    return ", ".join(names)


def _here() -> dict[str, str]:
    return {
        "day": date.today().isoformat(),
        "version": forbes.__version__,
        "system": f"{platform.system()}, Python {platform.python_version()}, torch {torch.__version__}",
    }


REPORT = """\
# Reliability

What is promised, how it is tested, and what came of it. `make faults` breaks things and writes this page; a short
form of it is part of `make test`.

{table}

`cases` were tried, in `reached` the fault came before the command had ended, `broken` counts what was lost, differed,
was left over, was not one sentence, or had a traceback. {notes}

- **The same bits:** weights, moments, metrics, episodes, records and the names of all files are compared with those of
  a command that was not cut off. It is begun again as a user would: `forbes fit --resume` where there is a checkpoint,
  else the same command.
- **Before operations on files:** an audit hook (PEP 578) sees files being opened to write, renamed, linked and removed,
  and ends the process before the n-th. These are the instants between which what is on the disk differs, so the
  package needs no failpoints of its own.
- **Left over:** no process of its session lives two seconds after a command has ended; no temporary file is in the
  folder after it has been begun again.
- **Too little memory** is tested in `tests/evaluation/test_scoring.py`: an evaluation whose address space is limited
  scores smaller batches and says so.
- **Not tested:** a power loss (files are synced before they are renamed, but no disk was cut off), network file
  systems, Windows.

forbes {version}, {system}, {day}, {minutes} minutes.
"""

if __name__ == "__main__":
    sys.exit(main())
