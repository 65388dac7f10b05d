"""`forbes completions`: whether predictions of digits are precise yet diverse, in numbers and in pictures."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import pandas as pd

from forbes.arguments import ArgumentParser, positive
from forbes.data import Split, Strokes
from forbes.data.digit_classifiers import CLASSIFIERS_SHA256, load_judges
from forbes.errors import ForbesError
from forbes.evaluation.completion_study import Study, entries, print_study, study
from forbes.evaluation.completions import prefixes
from forbes.evaluation.runs import TrainedRun, data_name, data_sha256, load_runs, require_comparable, run_titles
from forbes.figures.completions import by_ambiguity, drawings, errors, scores
from forbes.figures.style import save_figure
from forbes.files import replace_file
from forbes.training.provenance import command_line, commit
from forbes.training.run_folder import RunFolder

__all__ = ["main"]

_DRAWN = 10  # digits in a picture

_DESCRIPTION = """\
Let models complete the beginnings of digits, and let classifiers read what they have drawn.

  forbes completions runs/compare/forbes-0 runs/compare/rssm-0 -o figures

Completions are read at the step at which the true digit ends; models learn no sign of the end, and are told none.

  JS, entropy   distribution of the class over completions, against that of a calibrated classifier of beginnings, the
                reference r(y | o_1..c)
  -log p, ECE   the same distribution against the true class
  clear digits  share of completions that a classifier of digits gives more than 0.9 for one class
  class kept    of the completions whose class was clear after 60 % (80 %) of the rest, those that end in this class
  energy, CRPS  proper scores of the pixels, drawn from the grey values: jointly, and each on its own
  grey ink      share of the ink with a grey value between 0.1 and 0.9
  error         squared, in pixels: of one completion, of the best of N, and of the average picture of N

Beside the models: similar digits, the N training digits that begin most alike, in place of completions; and the true
digits, which bound what concerns one completion and have no diversity. Writes completions.json and .csv, and pictures,
a drawing for each length of the beginning. On one core, a run takes some 80 seconds for each hundred digits."""


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = _parser().parse_args(argv)
    runs = load_runs(args.runs)
    _check(args, runs)
    data = runs[0].data
    hashes = [data_sha256(run.data, args.split, args.sequences) for run in runs]
    require_comparable(runs, hashes)
    assert isinstance(data.source, Strokes)
    judges = load_judges(data.source.origin)
    named = dict(zip(run_titles(runs), runs, strict=True))
    studies = []
    for context in sorted(set(args.prefixes)):
        beginnings = prefixes(data, args.split, args.sequences, context, judges.prefix)
        studies.append(study(named, judges, beginnings, args.split, args.samples, args.seed))
        print_study(studies[-1], data.length)
    record = {
        "command": command_line("completions", *argv),
        "commit": commit(),
        "seed": args.seed,
        "data": {"name": data_name(data), "sha256": hashes[0]},
        "classifiers": CLASSIFIERS_SHA256,
        "runs": [_describe(name, run) for name, run in named.items()],
    }
    _write(args, record, studies)
    _draw(args, runs, studies)


def _parser() -> ArgumentParser:
    parser = ArgumentParser("forbes completions", _DESCRIPTION)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folder that `forbes fit` has made, of strokes")
    parser.add_argument("--split", choices=get_args(Split), default="test", help="default: test")
    parser.add_argument(
        "--sequences", "--digits", type=positive, default=300, help="the first so many of the split (default: 300)"
    )
    parser.add_argument("--samples", type=positive, default=100, help="N, completions of each digit (default: 100)")
    parser.add_argument(
        "--prefixes", type=positive, nargs="+", default=[5, 10, 15], help="steps that models see (default: 5 10 15)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the completions (default: 0)")
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), help="folder (default: figures)")
    return parser


def _check(args: Any, runs: Sequence[TrainedRun]) -> None:
    """Say what does not fit before minutes are spent."""
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


def _describe(name: str, run: TrainedRun) -> dict[str, Any]:
    checkpoint = RunFolder(run.path).checkpoint_sha256()
    return {"row": name, "path": run.path, "parameters": run.parameters, "checkpoint": checkpoint}


def _write(args: Any, record: dict[str, Any], studies: Sequence[Study]) -> None:
    """Write every score with its paired differences, and the curves over n."""
    found = [entry for one in studies for entry in entries(one, f"{args.split}[:{args.sequences}]")]
    curves = [
        {"row": row.name, "c": one.prefixes.context, "best": row.best, "average": row.average}
        for one in studies
        for row in (*one.runs, one.similar, one.truth)
    ]
    content = json.dumps(record | {"scores": found, "curves": curves}, indent=2)
    replace_file(args.output / "completions.json", f"{content}\n".encode())
    replace_file(args.output / "completions.csv", pd.DataFrame(found).to_csv(index=False).encode())


def _draw(args: Any, runs: Sequence[TrainedRun], studies: Sequence[Study]) -> None:
    figures = {"completions-scores": scores(studies), "completions-errors": errors(studies)}
    for one in studies:
        place = by_ambiguity(one.prefixes.reference, _DRAWN)
        end = int(one.prefixes.steps[place].max())
        batch = runs[0].data.sequences(args.split, one.prefixes.digits[place], end)
        models = [run.model for run in runs]
        figures[f"completions-c{one.prefixes.context}"] = drawings(
            one, models, runs[0].data.source, batch, place, args.seed
        )
    for name, figure in figures.items():
        for suffix in (".png", ".pdf"):
            save_figure(figure, args.output / f"{name}{suffix}")
    print(f"completions.json, .csv and {', '.join(figures)} are in {args.output}")
