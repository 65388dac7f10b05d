"""The page that `forbes reproduce` writes: claims with their verdicts, figures, scores, and origins of the numbers."""

import base64
import math
import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from jinja2 import Environment, StrictUndefined
from PIL import Image

from forbes.commands.budgets import Planned, Step, figures, measures
from forbes.commands.score_tables import Run, number, score_tables
from forbes.commands.trainings import is_finished
from forbes.errors import ForbesError
from forbes.evaluation.claims import CLAIMS, Claim, Held, Verdict, by_chance, decide, mean_over_seeds
from forbes.evaluation.contrasts import Runs, contrast
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.theorem import POSTERIORS, PROCESSES, identity
from forbes.files import replace_file
from forbes.reading import read_json
from forbes.runs.folder import RunFolder, read_metrics
from forbes.runs.provenance import commit, read_provenance
from forbes.runs.summary import objective_of

__all__ = ["PAGE", "Row", "late_gain", "write_report"]

_FLAT = 0.01
"""Late gain up to which a learning curve counts as flat."""

PAGE = Path("report/index.html")
"""The page in the output folder."""


class Measure(NamedTuple):
    """A measurement or a drawing on the page."""

    number: int
    name: str
    runs: tuple[str, ...]
    pictures: str
    state: str
    hours: float
    commit: str
    command: str
    last: str
    """Last line of its output."""


class Row(NamedTuple):
    """A claim on the page."""

    claim: str
    where: str
    measured: str
    number: str
    seeds: str
    """Difference of each seed."""
    verdict: Verdict
    rising: str
    """Which runs were still learning, or empty."""
    origin: str
    """Hours and commits."""
    runs: Sequence[int]
    steps: Sequence[int]


class Figure(NamedTuple):
    """A figure on the page."""

    title: str
    images: Sequence[tuple[str, float]]
    """PNG images as data URIs, and their widths in inches."""
    step: int


def write_report(
    planned: Sequence[Planned], budget: str, folder: Path, failed: Mapping[str, str], command: str
) -> list[Row]:
    """Write `report/index.html`, one file with everything in it, and return its rows of claims.

    Args:
        planned: trainings of all parts of the budget, whether or not they have been run.
        budget: name of the budget.
        folder: output folder of `forbes reproduce`.
        failed: why each job that failed is not finished.
        command: command line, for the page.
    """
    finished = [one for one in planned if is_finished(one.training.folder) and one.training.folder not in failed]
    runs = [_run(number, one, failed) for number, one in enumerate(planned, start=1)]
    steps = [*measures(finished, budget, folder), *figures(finished, folder)]
    measured = [_measure(number, step, folder) for number, step in enumerate(steps, start=1)]
    rows = [*(_claim(claim, finished, runs, measured, folder) for claim in CLAIMS), _theorem()]
    drawn = sorted(measured, key=lambda one: not one.command.startswith("forbes figures"))  # the paper's come first
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(files("forbes.commands").joinpath("report.html").read_text("utf-8"))
    page = template.render(
        budget=budget,
        command=command,
        date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        commit=_short(commit()),
        hours=sum(run.hours for run in runs) + sum(one.hours for one in measured),
        finished=len(finished),
        rows=rows,
        tables=score_tables(runs),
        figures=[_figure(one) for one in drawn if one.pictures and one.state == "done"],
        failed=failed,
        runs=runs,
        steps=measured,
        Held=Held,
        by_chance=by_chance,
        flat=_FLAT,
    )
    replace_file(folder / PAGE, page.encode())
    return rows


def _run(number: int, one: Planned, failed: Mapping[str, str]) -> Run:
    """Describe a training, from what its folder has recorded."""
    run = RunFolder(one.training.folder)
    entries = read_provenance(run.provenance) if run.provenance.is_file() else []
    metrics = read_metrics(run.path) if run.metrics.is_file() else None
    status = entries[-1].get("exit_status") if entries else None
    return Run(
        number,
        one.training.folder,
        one.family.name,
        one.family.measure,
        one.training.seed,
        failed.get(one.training.folder) or ("missing" if not entries else _state(status)),
        0 if metrics is None or metrics.empty else int(metrics.index.max()),
        0.0 if metrics is None else late_gain(metrics),
        sum(entry.get("hours", 0.0) for entry in entries),
        ", ".join(dict.fromkeys(_short(entry.get("commit")) for entry in entries)),
        "\n".join(dict.fromkeys(str(entry.get("command", "")) for entry in entries)),
    )


def late_gain(metrics: pd.DataFrame) -> float:
    """Return the share of the whole gain of the validation that came in the last tenth of the updates.

    Args:
        metrics: metrics of a run by update. Without two validations, or without a gain, the share is 0.
    """
    name = objective_of([name for name in metrics if name.startswith("val/")])
    curve = metrics[name].dropna() if name else pd.Series(dtype=float)
    if len(curve) < 2 or curve.iloc[0] == curve.iloc[-1]:
        return 0.0
    before = curve[curve.index <= 0.9 * curve.index[-1]]
    last, first = curve.iloc[-1], curve.iloc[0]
    return float((last - (before.iloc[-1] if len(before) else first)) / (last - first))


def _rising(runs: Sequence[Run]) -> str:
    """Return which runs were still learning."""
    late = [run for run in runs if run.late > _FLAT]
    if not late:
        return ""
    names = ", ".join(f"r{run.number}" for run in late)
    return (
        f"not flat: up to {max(run.late for run in late):.0%} of the gain of {names} came in the last tenth of updates"
    )


def _measure(number: int, step: Step, folder: Path) -> Measure:
    """Describe a step, from its record."""
    path = folder / "steps" / f"{step.name}.json"
    found = read_json(path, "Delete it, and repeat the command") if path.is_file() else {}
    state = _state(found.get("exit_status")) if found else "missing"
    hours, last = found.get("hours", 0.0), found.get("last", "")
    command = found.get("command", "")
    return Measure(
        number, step.name, step.runs, step.pictures, state, hours, _short(found.get("commit")), command, last
    )


def _state(status: int | None) -> str:
    if status is None:
        return "was killed, or is running"
    return "done" if status == 0 else f"ended with status {status}"


def _short(full: str | None) -> str:
    """Return the first letters of a commit, with its mark of changed files."""
    if full is None:
        return ""
    name, mark, _ = full.partition("+")
    return name[:7] + mark + ("dirty" if mark else "")


def _claim(
    claim: Claim, finished: Sequence[Planned], runs: Sequence[Run], measured: Sequence[Measure], folder: Path
) -> Row:
    """Measure and decide a claim."""
    folders: Runs = {(one.family.name, one.training.seed): one.training.folder for one in finished}
    completions = {seed: folder / f"completions-{seed}" / "completions.json" for _, seed in folders}
    try:
        differences = contrast(claim, folders, completions)
    except ForbesError as error:  # e.g. a run was evaluated on other sequences by hand
        return Row(claim.says, claim.where, claim.measured, "", "", Verdict(Held.UNTESTED, str(error)), "", "", [], [])
    used = [run for run in runs if run.family in claim.families and run.seed in differences]
    verdict = decide(differences, min((run.updates for run in used), default=0), claim.updates)
    commands = ("forbes completions",) if claim.score in ("clear", "js") else ("forbes evaluate", "forbes beliefs")
    folders_used = {run.folder for run in used}
    steps = [one for one in measured if one.command.startswith(commands) and folders_used & {*one.runs}]
    commits = ", ".join(dict.fromkeys([run.commit for run in used] + [one.commit for one in steps]))
    return Row(
        claim.says,
        claim.where,
        claim.measured,
        *_difference(differences, claim.unit),
        verdict,
        _rising(used),
        f"{sum(run.hours for run in used):.2f} h, commit {commits}" if used else "",
        [run.number for run in used],
        [one.number for one in steps],
    )


def _theorem() -> Row:
    """Check Theorem 1, in closed form."""
    sides = [identity(process, posterior_of(process)) for process in PROCESSES for posterior_of in POSTERIORS.values()]
    filtering = [abs(each.filtering - each.gap) for each in sides]
    held = max(filtering) < 1e-8
    return Row(
        "The gap log p − ELBO is the sum of KLs to the filtering beliefs",
        "Theorem 1",
        "three linear-Gaussian processes of 15 steps, four posteriors each, in closed form: error of the identity; "
        "it holds with the smoothing conditionals instead",
        f"{min(filtering):.2f} to {max(filtering):.1f} nats",
        f"with the smoothing conditionals at most {max(abs(each.smoothing - each.gap) for each in sides):.0e}",
        Verdict(Held.YES if held else Held.NO, "no training, no sampling: the limit is 1e-8 nats"),
        "",
        f"command: forbes theorem, commit {_short(commit())}",
        [],
        [],
    )


def _figure(measured: Measure) -> Figure:
    """Inline the pictures of a step, which are in the last argument of its command."""
    images = sorted(Path(shlex.split(measured.command)[-1]).glob("*.png"))
    return Figure(measured.pictures, [(_data_uri(image), _inches(image)) for image in images], measured.number)


def _data_uri(image: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(image.read_bytes()).decode()}"


def _inches(path: Path) -> float:
    """Return the width of a PNG in print."""
    with Image.open(path) as image:
        return float(image.width / image.info["dpi"][0])


def _digits(error: float) -> int:
    """Return the digits after the point that a number with this standard error has: two of the error's."""
    return min(4, max(0, 1 - math.floor(math.log10(error)))) if 0 < error < math.inf else 2


def _difference(differences: Mapping[int, Estimate], unit: str) -> tuple[str, str]:
    """Return the mean difference with its error, and the difference of each seed."""
    if not differences:
        return "", ""
    mean, error = mean_over_seeds(differences)
    digits = _digits(error)
    each = ", ".join(_signed(difference.mean, digits) for difference in differences.values())
    seeds = f"seed{'s' * (len(differences) > 1)} {', '.join(map(str, differences))}: {each}"
    return f"{_signed(mean, digits)} ± {number(error, digits)} {unit}".rstrip(), seeds


def _signed(value: float, digits: int) -> str:
    return ("+" if value >= 0 else "") + number(value, digits)
