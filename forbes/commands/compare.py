"""`forbes compare`: train several configurations with several seeds, evaluate them, and compare the results."""

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from rich.markdown import Markdown

from forbes.commands.console import console
from forbes.commands.evaluate import evaluate, wanted_metrics
from forbes.commands.jobs import Job, run_jobs
from forbes.commands.parsers.compare import parser
from forbes.errors import ForbesError
from forbes.evaluation.comparison import Comparison, Family, compare, markdown
from forbes.evaluation.record import read_record
from forbes.evaluation.runs import load_runs
from forbes.figures.comparison import draw_differences, draw_per_step, draw_scores
from forbes.figures.style import save_png_and_pdf
from forbes.files import replace_file
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.configs import find_config
from forbes.runs.configuration import allowed_modules
from forbes.runs.folder import RunFolder, read_config
from forbes.runs.provenance import command_line, commit

__all__ = ["main"]

_SEEDS = ("seed_everything", "model.init_args.seed", "data.init_args.seed")  # the first is linked to the others


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    cut = argv.index("--") if "--" in argv else len(argv)
    args, flags = parser().parse_args(argv[:cut]), list(argv[cut + 1 :])
    command = command_line("compare", *argv)
    folders = _run_folders(args.configs, args.seeds, args.output)
    _train(
        [
            (config, seed, run)
            for config, of_config in zip(args.configs, folders.values(), strict=True)
            for seed, run in of_config.items()
        ],
        flags,
        args.jobs,
    )
    loaded = load_runs([of_config[0] for of_config in folders.values()])
    wanted = wanted_metrics(loaded, args)
    families = [
        Family(name, folders[name], run.parameters, metrics.lacks)
        for name, run, metrics in zip(folders, loaded, wanted, strict=True)
    ]
    missing = [
        run
        for family, metrics in zip(families, wanted, strict=True)
        for run in family.runs.values()
        if not _is_measured(run, metrics.has, args.seed)
    ]
    if missing:
        evaluate(missing, args, command)
    comparison = compare(families, [name for name in wanted[0].names if any(name in metrics.has for metrics in wanted)])
    _write(comparison, families, args.output, command)


def _run_folders(configs: Sequence[str], seeds: int, folder: Path) -> dict[str, dict[int, str]]:
    """Return the run folders of each configuration by seed; a configuration is named after its file."""
    names = [Path(config).stem for config in configs]
    for config, name in zip(configs, names, strict=True):
        find_config(config)
        if names.count(name) > 1:
            raise ForbesError(f"{config}: another configuration is called {name} too. Give the files different names")
    return {name: {seed: str(folder / f"{name}-{seed}") for seed in range(seeds)} for name in names}


def _train(runs: Sequence[tuple[str, int, str]], flags: Sequence[str], at_once: int) -> None:
    """Train all runs, given as (configuration, seed, folder), to the end. Finished runs return at once."""
    jobs = []
    for config, seed, run in runs:
        if RunFolder(run).checkpoint.exists():
            _require_same_configuration(run, config, seed, flags)
            arguments = ["--resume", run]
        else:
            arguments = ["--config", config, *flags, "--seed_everything", str(seed), "--run_dir", run]
        jobs.append(Job(run, _fit_command(arguments)))
    failed = {run: status for run, status in run_jobs(jobs, at_once).items() if status != 0}
    if failed:
        ends = ", ".join(f"{run} with status {status}" for run, status in failed.items())
        raise ForbesError(f"trainings that failed: {ends}. Fix the errors above, then repeat the command")


def _require_same_configuration(run: str, config: str, seed: int, flags: Sequence[str]) -> None:
    """Refuse a run that was trained with another configuration, e.g. with fewer updates.

    Callbacks may differ, since they only observe. Keys that the run's version of this package did not have are ignored.
    """
    trained = _flat(read_config(RunFolder(run).config))
    trained |= {key: str(Path(trained[key]).absolute()) for key in trained if key.endswith(".path") and trained[key]}
    asked = _flat(yaml.safe_load(_configuration(config, *flags))) | {key: seed for key in _SEEDS}
    asked |= {key: str(Path(asked[key]).absolute()) for key in asked if key.endswith(".path") and asked[key]}
    for key in asked:
        if key in trained and trained[key] != asked[key] and key != "trainer.callbacks":
            raise ForbesError(
                f"{run}: was trained with {key} = {trained[key]}, expected {asked[key]}. Use its configuration and "
                "flags, or another folder, -o"
            )


def _flat(section: Any, name: str = "") -> dict[str, Any]:
    """Flatten a nested section: every value by its dotted key, e.g. `model.init_args.state_dim`."""
    if not isinstance(section, dict):
        return {name: section}
    return {k: v for key, value in section.items() for k, v in _flat(value, f"{name}.{key}".strip(".")).items()}


@cache
def _configuration(config: str, *flags: str) -> str:
    """Return the complete configuration that `forbes fit` would train with, as YAML."""
    command = _fit_command(["--config", config, *flags, "--print_config"])
    asked = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if asked.returncode != 0:
        raise ForbesError(f"{config}: `forbes fit` cannot train with it, see the error above. Fix it")
    return asked.stdout


def _fit_command(arguments: Sequence[str]) -> list[str]:
    """Return the command of a `forbes fit` in its own process, so that trainings do not affect each other."""
    return [sys.executable, "-m", "forbes", *allowed_modules(), "fit", *arguments]


def _is_measured(run: str, metrics: Iterable[str], seed: int) -> bool:
    """Return whether every metric is recorded for the run's current checkpoint and this random seed."""
    record, checkpoint = read_record(run), open_checkpoint(RunFolder(run).checkpoint).sha256
    entries = [record.get(metric, {}) for metric in metrics]
    return all(entry.get("checkpoint") == checkpoint and entry.get("seed") == seed for entry in entries)


def _write(comparison: Comparison, families: Sequence[Family], folder: Path, command: str) -> None:
    """Write tables and figures, and print the table."""
    text = markdown(comparison, families)
    tables = {name: _records(getattr(comparison, name)) for name in ("scores", "differences")}
    record = {
        "command": command,
        "commit": commit(),
        **tables,
        "curves": comparison.curves,
        "references": comparison.references,
    }
    replace_file(folder / "comparison.csv", comparison.scores.to_csv(index=False).encode())
    replace_file(folder / "comparison.json", (json.dumps(record, indent=2) + "\n").encode())
    replace_file(folder / "comparison.md", text.encode())
    figures = {"scores": draw_scores(comparison)}
    if steps := draw_per_step(comparison):
        figures["per-step"] = steps
    if len(comparison.differences):
        figures["differences"] = draw_differences(comparison, families[0].name)
    for name, figure in figures.items():
        save_png_and_pdf(figure, folder, name)
    console(200).print(Markdown(text))
    print(f"comparison.csv, .json, .md and {', '.join(figures)} are in {folder}")


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table for JSON, with None for NaN."""
    rows: list[dict[str, Any]] = table.astype(object).where(table.notna(), None).to_dict("records")
    return rows
