"""`forbes completions`: score and draw sampled completions of digits."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from rich.markup import escape
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.completions import parser
from forbes.data import SequenceData, SequenceSource, Strokes
from forbes.data.strokes.classifiers import CLASSIFIERS_SHA256, load_classifiers
from forbes.errors import ForbesError
from forbes.evaluation.adapters import load_all
from forbes.evaluation.digits.completions import select_prefixes
from forbes.evaluation.digits.study import Row, Study, entries, study
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.runs import TrainedRun, data_name, require_comparable, run_titles
from forbes.figures.completions import by_ambiguity, draw_class_scores, draw_completions, draw_errors
from forbes.figures.style import save_png_and_pdf
from forbes.files import replace_file
from forbes.runs.provenance import command_line, commit

__all__ = ["main"]

_DRAWN = 10  # digits per figure


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    runs = load_all(args.runs, args.model, args.data, needs=("sample", "mean"))
    _check(args, runs)
    require_comparable(runs, [_drawings(run.data.source) for run in runs])
    data = _shared_data(runs)
    assert isinstance(data.source, Strokes)
    classifiers = load_classifiers(data.source.origin)
    named = dict(zip(run_titles(runs), runs, strict=True))
    studies = []
    for context in sorted(set(args.prefixes)):
        chosen = select_prefixes(data, args.split, args.sequences, context, classifiers.prefix)
        studies.append(study(named, data, classifiers, chosen, args.split, args.samples, args.seed))
        _print(studies[-1], data.length)
    record = {
        "command": command_line("completions", *argv),
        "commit": commit(),
        "seed": args.seed,
        "data": {"name": data_name(data), "sha256": data.source.sha256()},
        "classifiers": CLASSIFIERS_SHA256,
        "runs": [_describe(name, run) for name, run in named.items()],
    }
    _write(args, record, studies)
    _draw(args, runs, studies)


def _check(args: Any, runs: Sequence[TrainedRun]) -> None:
    """Check the arguments before minutes are spent."""
    for run in runs:
        if not isinstance(run.data.source, Strokes):
            raise ForbesError(f"{run.path}: its data are {data_name(run.data)}, expected Strokes. Name other runs")
        if args.sequences > (size := run.data.source.size(args.split)):
            raise ForbesError(
                f"--sequences {args.sequences}: the {args.split} split of {run.path} has {size}. Choose fewer"
            )
        if (longest := max(args.prefixes)) >= run.data.length:
            raise ForbesError(
                f"--prefixes {longest}: the sequences of {run.path} have {run.data.length} steps, expected fewer. "
                "Choose a smaller prefix"
            )
    if args.samples < 2:
        raise ForbesError(f"--samples {args.samples}: expected at least 2, since completions are compared. Choose more")


def _drawings(source: SequenceSource) -> str:
    """Return what determines the drawings of whole digits: neither the length nor whether ends are observed."""
    assert isinstance(source, Strokes)
    return f"{source.sha256()}, {source.points_per_step} points per step, {source.frames} frames"


def _shared_data(runs: Sequence[TrainedRun]) -> SequenceData:
    """Return the data of the shortest length, and if there are both, with masked ends, as they fit the 5-gram."""

    def order(data: SequenceData) -> tuple[int, bool]:
        assert isinstance(data.source, Strokes)
        return data.length, data.source.end == "observed"

    return min((run.data for run in runs), key=order)


def _describe(name: str, run: TrainedRun) -> dict[str, Any]:
    return {"row": name, "path": run.path, "parameters": run.parameters, "checkpoint": run.checkpoint}


def _write(args: Any, record: dict[str, Any], studies: Sequence[Study]) -> None:
    """Write all scores, paired differences, and the curves over n."""
    found = [entry for one in studies for entry in entries(one, f"{args.split}[:{args.sequences}]")]
    curves = [
        {"row": row.name, "c": one.prefixes.context, "best": row.best, "average": row.average}
        for one in studies
        for row in one.completed
    ]
    content = json.dumps(record | {"scores": found, "curves": curves}, indent=2)
    replace_file(args.output / "completions.json", f"{content}\n".encode())
    replace_file(args.output / "completions.csv", pd.DataFrame(found).to_csv(index=False).encode())


def _draw(args: Any, runs: Sequence[TrainedRun], studies: Sequence[Study]) -> None:
    figures = {"completions-scores": draw_class_scores(studies), "completions-errors": draw_errors(studies)}
    for one in studies:
        place = by_ambiguity(one.prefixes.reference, _DRAWN)
        end = int(one.prefixes.steps[place].max())
        batch = runs[0].data.sequences(args.split, one.prefixes.digits[place], end)
        models = [run.model for run in runs]
        figures[f"completions-c{one.prefixes.context}"] = draw_completions(
            one, models, runs[0].data.source, batch, place, args.seed
        )
    for name, figure in figures.items():
        save_png_and_pdf(figure, args.output, name)
    print(f"completions.json, .csv and {', '.join(figures)} are in {args.output}")


def _print(study: Study, length: int) -> None:
    """Print a table of class scores and a table of pixel scores."""
    title = f"{len(study.prefixes.digits)} digits, {study.prefixes.context} steps seen, {study.samples} completions"
    of_classes = {
        "js[end]": "JS to the\nreference",
        "entropy[end]": "entropy",
        "entropy_gap[end]": "entropy\ngap",
        "nll[end]": "−log p of\nthe label",
        "ece[end]": "ECE",
        "classes[end]": "classes\nabove 5 %",
        "clear[end]": "clear\ndigits",
        f"clear[n<={length}]": f"of those of\n≤ {length} steps",
        "kept[60%]": "class kept\nfrom 60 %",
        "kept[80%]": "class kept\nfrom 80 %",
    }
    of_pixels = {
        f"energy[t<={length}]": f"energy score\nt ≤ {length}",
        "energy[end]": "energy score\nend",
        f"crps[t<={length}]": f"CRPS\nt ≤ {length}",
        "crps[end]": "CRPS\nend",
        "grey[end]": "grey\nink",
        "error[end]": "error\nof one",
        "best[end]": f"error of the\nbest of {study.samples}",
        "average[end]": f"error of the\naverage of {study.samples}",
    }
    screen = console(160)
    rows = [*study.completed, study.reference]
    screen.print(_table(study, f"{title}: their classes, nats", of_classes, rows))
    screen.print(_table(study, f"{title}: their pixels", of_pixels, study.completed))


def _table(study: Study, title: str, columns: Mapping[str, str], rows: Sequence[Row]) -> Table:
    table = Table(title=title)
    table.add_column("", overflow="fold")
    for header in columns.values():
        table.add_column(header, justify="right")
    for row in rows:
        values = {score: _cell(Estimate.of(each)) for score, each in row.scores.items()}
        values["ece[end]"] = f"{row.calibration:.3f}"
        table.add_row(escape(row.name), *(values.get(score, "") for score in columns))
    table.add_section()
    for one, other, scores in study.differences:
        values = {score: _cell(each, sign="+") for score, each in scores.items()}
        table.add_row(escape(f"{one.name} − {other.name}"), *(values.get(score, "") for score in columns))
    return table


def _cell(estimate: Estimate, sign: str = "") -> str:
    """Write a mean above its standard error."""
    if not math.isfinite(estimate.mean):
        return "n/a"
    return f"{estimate.mean:{sign}.3f}\n± {estimate.standard_error:.3f}"
