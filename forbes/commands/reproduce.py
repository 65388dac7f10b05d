"""`forbes reproduce`: train, measure and draw what the paper claims, and report what held."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from forbes.commands.budgets import Planned, Step, collections, figures, measures, trainings
from forbes.commands.console import console
from forbes.commands.jobs import Ended, Job, Launcher, run_jobs
from forbes.commands.launchers import open_launcher
from forbes.commands.launchers.local import Local, num_cpus
from forbes.commands.parsers.reproduce import PARTS, parser
from forbes.commands.report import PAGE, Row, write_report
from forbes.commands.trainings import failures, forbes_command, is_finished, training_job
from forbes.errors import ForbesError
from forbes.files import locked, replace_file
from forbes.reading import read_json
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.provenance import command_line, commit, read_provenance

__all__ = ["main"]

_REMEDY = "Delete it, and repeat the command"


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    folder = args.output or Path("runs/reproduce") / args.budget
    gpu = torch.cuda.is_available()
    jobs_here = args.jobs if args.launcher == "local" else None  # --jobs of a cluster are not of this machine
    at_once = jobs_here or (1 if gpu else min(num_cpus(), 4))
    launcher = open_launcher(args, folder, at_once)
    planned = [one for part in args.only for one in trainings(part, args.budget, folder)]
    _require_budget(folder, args.budget)
    hours = {one.training.folder: one.hours(_measured_rate(one, planned), gpu) for one in planned}
    missing = [one for one in planned if not is_finished(one.training.folder)]
    if args.dry_run or args.budget == "paper":
        _print_plan(planned, missing, hours)
    total = sum(hours[one.training.folder] for one in missing)
    later = sum(step.hours for step in [*measures(planned, args.budget, folder), *figures(planned, folder)])
    here = f": {(total + later) / at_once:.1f} hours with --jobs {at_once}" if args.launcher == "local" else ""
    print(
        f"{len(missing)} of {len(planned)} trainings are missing and take about {total:.1f} hours, measurements and "
        f"figures {later:.1f}{here}",
        flush=True,
    )
    if args.dry_run:
        return
    if args.budget == "paper" and missing and sys.stdin.isatty() and not args.yes:
        _ask()
    with locked(folder, "reproduces here. Wait for it, or choose another folder, -o"):
        replace_file(folder / "reproduce.json", json.dumps({"budget": args.budget}).encode() + b"\n")
        failed = _work(planned, missing, hours, args.budget, folder, at_once, launcher)
        every = [one for part in PARTS for one in trainings(part, args.budget, folder)]
        rows = write_report(every, args.budget, folder, failed, command_line("reproduce", *argv))
    _print_rows(rows, args.budget)
    print(f"report: {folder / PAGE}")
    if failed:
        page = folder / PAGE
        raise ForbesError(f"jobs that failed: {', '.join(failed)}. See {page}, fix them, then repeat the command")


def _require_budget(folder: Path, budget: str) -> None:
    """Refuse a folder of another budget, whose runs have other lengths."""
    path = folder / "reproduce.json"
    if not path.is_file() or (found := read_json(path, _REMEDY)) == {"budget": budget}:
        return
    other = found.get("budget") if isinstance(found, dict) else None
    raise ForbesError(f"{folder}: has the runs of --budget {other}, expected {budget}. Choose another folder, -o")


def _measured_rate(one: Planned, planned: Sequence[Planned]) -> float | None:
    """Return the updates per second of finished runs of the same family; None if there are none."""
    updates, hours = 0, 0.0
    for other in planned:
        if other.family == one.family and is_finished(other.training.folder):
            run = RunFolder(other.training.folder)
            updates += int(read_metrics(run.path).index.max())
            hours += sum(entry.get("hours", 0.0) for entry in read_provenance(run.provenance))
    return updates / hours / 3600 if hours else None


def _print_plan(planned: Sequence[Planned], missing: Sequence[Planned], hours: dict[str, float]) -> None:
    """Print the trainings with their hours."""
    table = Table(title="trainings, and their hours on one core" + " or the GPU" * torch.cuda.is_available())
    for header in ("run", "configuration", "flags"):
        table.add_column(header, overflow="fold")
    for header in ("updates", "updates/s", "hours"):
        table.add_column(header, justify="right")
    for one in planned:
        run, takes = f"{one.family.name}-{one.training.seed}", hours[one.training.folder]
        done = "done" if one not in missing else f"{takes:.2f}"
        flags = " ".join(one.training.flags)
        table.add_row(run, one.training.config, flags, f"{one.updates:,}", f"{one.updates / takes / 3600:.3g}", done)
    console(200).print(table)


def _print_rows(rows: Sequence[Row], budget: str) -> None:
    """Print the claims with their verdicts."""
    title = "what of the paper held" + ": a smoke run, no evidence" * (budget == "smoke")
    table = Table(title=title)
    for header in ("the paper says", "our number", "verdict", "because"):
        table.add_column(header, overflow="fold")
    for row in rows:
        table.add_row(row.claim, row.number, row.verdict.held, row.verdict.reason)
    console(200).print(table)


def _ask() -> None:
    """Ask whether to start."""
    if input("Start? [y/N] ").strip().lower() not in ("y", "yes"):
        raise ForbesError("not started. Use --budget small, or --only for a part")


def _work(
    planned: Sequence[Planned],
    missing: Sequence[Planned],
    hours: dict[str, float],
    budget: str,
    folder: Path,
    at_once: int,
    launcher: Launcher,
) -> dict[str, str]:
    """Train, measure and draw what is missing, and return why each other job is not finished."""
    jobs = {one.training.folder: training_job(one.training, hours[one.training.folder]) for one in planned}
    planned = [one for one in planned if not jobs[one.training.folder].refused]
    later = sum(step.hours for step in [*measures(planned, budget, folder), *figures(planned, folder)])
    failed = _run_steps(collections(missing, folder), folder, at_once, 0.0)
    waiting = {one.training.folder for one in missing}
    todo = [job for name, job in jobs.items() if name in waiting or job.refused]
    failed |= failures(run_jobs(todo, launcher, later))
    finished = [one for one in planned if is_finished(one.training.folder)]
    drawings = figures(finished, folder)
    failed |= _run_steps(measures(finished, budget, folder), folder, at_once, sum(step.hours for step in drawings))
    return failed | _run_steps(drawings, folder, at_once, 0.0)


def _run_steps(steps: Sequence[Step], folder: Path, at_once: int, later: float) -> dict[str, str]:
    """Run the steps that are not done yet, and return why each other one is not finished.

    What a step has read is recorded beside the runs, so that it is repeated if a run is trained further.
    """
    records = {step.name: _record(step) for step in steps}
    missing = [step for step in steps if not _is_done(folder, step.name, records[step.name])]

    def end(ended: Ended) -> None:
        about = {"hours": round(ended.hours, 4), "exit_status": ended.status, "last": ended.last, "commit": commit()}
        content = json.dumps(records[ended.job.name] | about, indent=2)
        replace_file(folder / "steps" / f"{ended.job.name}.json", f"{content}\n".encode())

    jobs = [Job(step.name, forbes_command(*step.arguments), step.hours) for step in missing]
    return failures(run_jobs(jobs, Local(at_once), later, end))


def _record(step: Step) -> dict[str, Any]:
    """Return what determines the result of a step: its command, and the checkpoints of its runs."""
    checkpoints = {run: open_checkpoint(RunFolder(run).checkpoint).sha256 for run in step.runs}
    return {"command": command_line(*step.arguments), "checkpoints": checkpoints}


def _is_done(folder: Path, name: str, record: dict[str, Any]) -> bool:
    """Return whether a step has been run with this command and these checkpoints."""
    path = folder / "steps" / f"{name}.json"
    if not path.is_file():
        return False
    done = read_json(path, _REMEDY)
    return isinstance(done, dict) and done.get("exit_status") == 0 and record.items() <= done.items()
