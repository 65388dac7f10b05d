"""Run folders: all files of one training, in a folder locked by its process."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import forbes
from forbes.bundled import run_path
from forbes.errors import ForbesError
from forbes.files import locked, remove_halves, require_no_links
from forbes.reading import is_number, read_yaml

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["RunFolder", "experiment_name", "read_config", "read_metrics"]


class RunFolder:
    """Paths of the files of a run.

    `runs/<experiment>/<time>-<seed>/`::

        config.yaml        the complete configuration, including defaults
        provenance.json    command, time, versions and data: one entry per start
        metrics.jsonl      one JSON object per line: {"update": n, "epoch": e, name: value, ...}
        checkpoints/       last.ckpt; previous.ckpt, used if the last one is damaged; best.ckpt by the validation bound
                           or an agent's return
        failure.pt         after a divergence: the data to repeat the update that is not finite (`forbes replay`)
        figures/
        evaluation.json    and evaluation.npz, results of `forbes evaluate`
        evaluation-best/   the same for another checkpoint, here checkpoints/best.ckpt
        .lock              locked by the process that trains here; .evaluation.lock while evaluation.json is written

    In config.yaml the `path` of the data is absolute, so that a run can be resumed and evaluated from any folder. The
    run folder itself may be moved, copied or read-only.

    Args:
        path: run folder, which need not exist yet; or one of its checkpoints, e.g. `RUN/checkpoints/best.ckpt`, to use
            instead of the last one; or `pretrained:NAME`, a model that comes with the package.

    Raises:
        ForbesError: if no trained model of this name comes with the package.
    """

    LAST, PREVIOUS, BEST = "last.ckpt", "previous.ckpt", "best.ckpt"

    def __init__(self, path: Path | str) -> None:
        path = run_path(path)
        chosen = path if path.suffix == ".ckpt" else None
        self.path = path if chosen is None else path.parent.parent
        self.config = self.path / "config.yaml"
        self.provenance = self.path / "provenance.json"
        self.metrics = self.path / "metrics.jsonl"
        self.failure = self.path / "failure.pt"
        last = self.path / "checkpoints" / self.LAST
        self.checkpoint = chosen or last
        self.results = self.path if self.checkpoint == last else self.path / f"evaluation-{self.checkpoint.stem}"
        self.figures = self.path / "figures"

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def new(cls, experiment: str, started: str, seed: int) -> "RunFolder":
        """Create a new folder for a run of an experiment that starts now."""
        first = path = Path("runs") / experiment / f"{started}-{seed}"
        number = 1
        while True:
            try:
                path.mkdir(parents=True)
            except FileExistsError:  # another started in the same second
                number += 1
                path = first.with_name(f"{first.name}-{number}")
            else:
                return cls(path)

    @classmethod
    def existing(cls, path: Path | str) -> "RunFolder":
        """Return a run folder that exists.

        Raises:
            ForbesError: if it does not.
        """
        run = cls(path)
        if not run.path.is_dir():
            raise ForbesError(f"{run}: no such run folder. `forbes fit` creates one in runs/")
        return run

    @classmethod
    def trained(cls, path: Path | str) -> "RunFolder":
        """Return the folder of a run that has a checkpoint.

        Raises:
            ForbesError: if the run does not exist or has no checkpoint yet, or if a folder in it is a symbolic link,
                through which results would be written elsewhere.
        """
        run = cls.existing(path)
        if not run.config.is_file():
            raise ForbesError(f"{run}: not a run folder, config.yaml is missing. Name a folder written by `forbes fit`")
        if run.results != run.path and not run.checkpoint.is_file():
            existing = sorted(path.name for path in run.checkpoint.parent.glob("*.ckpt"))
            raise ForbesError(f"{run.checkpoint}: no such checkpoint. There are {', '.join(existing) or 'none'}")
        if not run.checkpoint.is_file():
            raise ForbesError(f"{run}: has no checkpoint yet. Train it: forbes fit {run.config}")
        require_no_links(path for path in run.path.iterdir() if path.is_dir())
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock this folder against training by other processes. The system unlocks it when the process dies."""
        with locked(self.path, "trains here. Choose another --run_dir"):
            remove_halves(self.path, self.config.name, self.provenance.name, self.failure.name)
            remove_halves(self.checkpoint.parent, "*.ckpt")
            yield


def experiment_name(configs: Sequence[str]) -> str:
    """Return the name of an experiment by its first configuration: configs/strokes/forbes.yaml is strokes/forbes."""
    if not configs:
        return "unnamed"
    parts = Path(configs[0]).with_suffix("").parts
    if "configs" in parts:
        return "/".join(parts[len(parts) - parts[::-1].index("configs") :])
    return parts[-1]


def read_config(path: Path, sections: Sequence[str] = ("model", "data")) -> dict[str, Any]:
    """Read the config.yaml of a run, with the current public name of each class.

    Args:
        path: the file.
        sections: sections that it must have.

    Raises:
        ForbesError: if it is not a file written by `forbes fit`.
    """
    remedy = "Restore it, or name another run"
    config = read_yaml(path, remedy)
    if not isinstance(config, dict):
        raise ForbesError(
            f"{path}: holds a {type(config).__name__}, expected sections {' and '.join(sections)}. {remedy}"
        )
    for name in sections:
        section = config.get(name)
        if not isinstance(section, dict) or not isinstance(section.get("class_path"), str):
            raise ForbesError(f"{path}: its section {name} has no class_path, expected the name of a class. {remedy}")
        if not isinstance(section.setdefault("init_args", {}), dict):
            raise ForbesError(f"{path}: {name}.init_args is not a mapping, expected arguments by name. {remedy}")
    renamed: dict[str, Any] = _with_public_names(config)
    return renamed


def _with_public_names(section: Any) -> Any:
    """Return a part of a configuration with `forbes.WorldModel` in the place of `forbes.training.WorldModel`."""
    if isinstance(section, list):
        return [_with_public_names(value) for value in section]
    if isinstance(section, dict):
        return {key: _with_public_names(value) for key, value in section.items()}
    module, _, name = section.rpartition(".") if isinstance(section, str) else ("", "", "")
    return f"forbes.{name}" if module and forbes.MODULES.get(name) == module else section


def read_metrics(run: Path | str) -> "pd.DataFrame":
    """Read a run's metrics: one row per update, one column per name, with the last of several values.

    A run that was killed and resumed repeats the updates after its checkpoint. The lines before the kill are dropped.

    Raises:
        ForbesError: if the file is missing or has an invalid line.
    """
    import pandas as pd  # it takes longer to import than a run folder to check

    path = RunFolder(run).metrics
    if not path.is_file():
        raise ForbesError(f"{path}: no such file. Name a run folder written by `forbes fit`")
    rows: dict[int, dict[str, Any]] = {}
    *lines, _ = path.read_bytes().split(b"\n")  # the last line may be truncated by a kill, or still being written
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            record = None
        if not _is_line_of_metrics(record):
            raise ForbesError(f"{path}: line {number} is not a line of metrics. Repair or delete it")
        update = record.pop("update")
        if record.pop("start", False):
            rows = {known: row for known, row in rows.items() if known <= update}
        else:
            rows.setdefault(update, {}).update(record)
    table = pd.DataFrame.from_dict(dict(sorted(rows.items())), orient="index")
    table.index.name = "update"
    return table


def _is_line_of_metrics(record: Any) -> bool:
    """Return whether this is a line of `JsonLinesLogger`: an update, and numbers."""
    if not isinstance(record, dict) or type(record.get("update")) is not int:
        return False
    return all(is_number(value) for name, value in record.items() if name != "start")
