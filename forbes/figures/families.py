"""Group runs into families, and read what their folders have recorded."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from forbes.errors import ForbesError
from forbes.evaluation.methods import by_configuration
from forbes.evaluation.record import read_record
from forbes.evaluation.runs import TrainedRun, data_sha256, require_comparable, run_titles
from forbes.figures.style import Method, method_styles
from forbes.models import BeliefModel
from forbes.runs.folder import read_metrics

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["RunFamily", "group", "recorded_entries", "require_same_data"]

_COMPARED = 500
"""Number of test sequences that must be the same for all runs."""


class RunFamily(NamedTuple):
    """Runs of one configuration, with different seeds."""

    name: str
    style: Method
    runs: Sequence[TrainedRun]

    @property
    def model(self) -> BeliefModel:
        """Model of the first run."""
        return self.runs[0].model

    @property
    def label(self) -> str:
        """Name, with the number of runs if there are several."""
        return self.name if len(self.runs) == 1 else f"{self.name}, {len(self.runs)} runs"

    def curves(self) -> "list[pd.Series]":
        """Return the training bound of each run on the validation split, indexed by update."""
        return [_curve(run) for run in self.runs]

    def test_elbos(self) -> list[float]:
        """Return the recorded ELBO of each run on the whole test split, if the ELBO is the training bound."""
        return [value for run in self.runs if (value := _test_elbo(run)) is not None]


def group(runs: Sequence[TrainedRun]) -> list[RunFamily]:
    """Group runs into families, whose configurations differ only in the seed."""
    members = by_configuration(runs)
    titles = run_titles([first for first, *_ in members])
    styles = method_styles(titles)
    return [RunFamily(title, styles[title], of_one) for title, of_one in zip(titles, members, strict=True)]


def require_same_data(runs: Sequence[TrainedRun]) -> None:
    """Require that all runs have the same test sequences, at least one, and the same likelihood.

    Raises:
        ForbesError: if a run has no test sequences, or two runs differ; names them.
    """
    for run in runs:
        if not run.data.source.size("test"):
            raise ForbesError(f"{run.path}: its data have no test split, from which sequences are drawn. Name others")
    counts = [min(_COMPARED, run.data.source.size("test")) for run in runs]
    require_comparable(runs, [data_sha256(run.data, "test", count) for run, count in zip(runs, counts, strict=True)])


def recorded_entries(run: TrainedRun) -> dict[str, dict[str, Any]]:
    """Return the entries of `evaluation.json` of this checkpoint, or all of them where the run has none."""
    entries = read_record(run.path)
    return {name: entry for name, entry in entries.items() if run.checkpoint in (None, entry.get("checkpoint"))}


def _curve(run: TrainedRun) -> "pd.Series":
    metrics = read_metrics(run.path)
    name = f"val/{run.model.bound_name}"
    if name not in metrics:
        raise ForbesError(f"{run.path}: metrics.jsonl has no {name}. Train the run to its first validation")
    return metrics[name].dropna()


def _test_elbo(run: TrainedRun) -> float | None:
    if not run.model.bound_name.startswith("elbo["):
        return None
    entries = recorded_entries(run).items()
    return next((entry["mean"] for name, entry in entries if name.startswith("test/elbo[")), None)
