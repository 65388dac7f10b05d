"""`forbes compare`: train several configurations with several seeds, evaluate them, and compare the results."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from rich.markdown import Markdown

from forbes.commands.console import console
from forbes.commands.evaluate import evaluate, wanted_metrics
from forbes.commands.evaluate import main as evaluate_command
from forbes.commands.jobs import Launcher, run_jobs
from forbes.commands.launchers import open_launcher
from forbes.commands.parsers.compare import parser, require_no_scores, require_sweep
from forbes.commands.sweep import sweep
from forbes.commands.trainings import Training, complete_configuration, failures, not_finished, unfinished_jobs
from forbes.errors import ForbesError
from forbes.evaluation.comparison import Comparison, Family, compare, markdown
from forbes.evaluation.record import read_record, require_readable, results_folders
from forbes.evaluation.runs import TrainedRun, find_device, load_runs
from forbes.figures.comparison import draw_differences, draw_per_step, draw_scores
from forbes.figures.style import save_png_and_pdf
from forbes.files import replace_file
from forbes.runs.checkpoint import open_checkpoint
from forbes.runs.configs import find_config
from forbes.runs.folder import RunFolder
from forbes.runs.provenance import command_line, commit
from forbes.runs.worlds import build_world, is_world

__all__ = ["main"]


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    cut = argv.index("--") if "--" in argv else len(argv)
    args, flags = parser().parse_args(argv[:cut]), list(argv[cut + 1 :])
    command = command_line("compare", *argv)
    launcher = open_launcher(args, args.output, args.jobs or 1)
    if args.sweep:
        require_sweep(args)
        find_config(args.configs[0])
        return sweep(args.configs[0], args.sweep, flags, args.seeds, args.output, launcher)
    folders = _run_folders(args.configs, args.seeds, args.output)
    trainings = [
        Training(config, tuple(flags), seed, run)
        for config, of_config in zip(args.configs, folders.values(), strict=True)
        for seed, run in of_config.items()
    ]
    agents = _require_measurable(args, flags)
    if agents:
        require_no_scores(args, "agents are compared by their returns", {"seed", "device"})
    _train(trainings, launcher)
    if agents:
        runs = [training.folder for training in trainings]
        return evaluate_command([*runs, "--seed", str(args.seed), "--device", args.device])
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
        folders_of = results_folders(missing)
        require_readable(folders_of.values())
        evaluate(load_runs(missing, find_device(args.device)), args, command, folders_of)
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


def _require_measurable(args: Any, flags: Sequence[str]) -> bool:
    """Refuse configurations that could not be measured or compared, before days are spent on their training.

    Returns:
        Whether they are of agents, which are compared by their returns.
    """
    untrained, kinds = [], set()
    for name in args.configs:
        config = yaml.safe_load(complete_configuration(name, *flags))
        if config["model"]["class_path"].endswith(".KnownBelief"):
            raise ForbesError(f"{name}: beliefs of a known process have scores of their own. Use forbes beliefs")
        source = config["data"].get("init_args", {}).get("source") or {}  # data of a user's own may have none
        kinds.add(str(source.get("class_path")).endswith(".Experience"))
        if is_world(config):
            world, data = build_world(config, Path(name), args.output)
            untrained.append(TrainedRun(name, world.model, data, checkpoint="", config=config))
    if len(kinds) > 1:
        raise ForbesError("an agent is compared by its return, a world model by its scores. Name one kind")
    if untrained:
        wanted_metrics(untrained, args)
    return kinds == {True}


def _train(trainings: Sequence[Training], launcher: Launcher) -> None:
    """Run the trainings that are not finished to the end."""
    if failed := failures(run_jobs(unfinished_jobs(trainings), launcher)):
        raise not_finished(failed, len(trainings))


def _is_measured(run: str, metrics: Mapping[str, str], seed: int) -> bool:
    """Return whether every metric is recorded for the run's current checkpoint and sequences and this random seed.

    Args:
        run: run folder.
        metrics: hash of the sequences by metric.
        seed: random seed.
    """
    record, checkpoint = read_record(run), open_checkpoint(RunFolder(run).checkpoint).sha256
    return all(
        (entry := record.get(metric, {})).get("checkpoint") == checkpoint
        and entry.get("seed") == seed
        and entry.get("data", {}).get("sha256") == sha256
        for metric, sha256 in metrics.items()
    )


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
