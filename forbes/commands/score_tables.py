"""The tables of scores on the page of `forbes reproduce`."""

import statistics
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from forbes.evaluation.contrasts import entry_of, task_of

__all__ = ["Run", "Table", "number", "score_tables"]


class Run(NamedTuple):
    """A run on the page."""

    number: int
    folder: str
    family: str
    measure: str
    """How it is measured: a key of `_COLUMNS`."""
    seed: int
    state: str
    """"done", "missing", or "ended with status 3"."""
    updates: int
    late: float
    """Share of its whole gain by the validation that came in the last tenth of its updates; 0 without validations."""
    hours: float
    commit: str
    command: str


class Table(NamedTuple):
    """A table of scores on the page."""

    title: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[tuple[str, Sequence[str], Sequence[int]]]
    """Family, one cell per column, and the numbers of its runs."""


_COLUMNS = {
    "strokes": {"elbo": "ELBO", "reconstruction": "reconstruction", "kl": "KL", "iwae": "IWAE", "pll": "PLL"},
    "processes": {"log_p": "log p, exact", "elbo": "ELBO", "iwae": "IWAE", "fivo": "FIVO", "pll": "PLL"},
    "beliefs": {
        "forward_kl": "KL(exact ‖ belief)",
        "reverse_kl": "KL(belief ‖ exact)",
        "variance_ratio": "variance ratio",
        "mode_mass_error": "mode mass error",
        "elbo_gap": "log p − ELBO",
    },
    "agents": {
        "return": "return",
        "prior_non_gaussianity": "prior, KL from Gaussian",
        "posterior_non_gaussianity": "posterior, KL from Gaussian",
        "reward_uncertainty": "reward uncertainty",
    },
    "episodes": {"elbo": "ELBO", "reconstruction": "reconstruction", "kl": "KL"},
}
_CAPTIONS = {
    "strokes": "Nats per digit. Higher is better for bounds and PLL; ELBO = reconstruction − KL.",
    "processes": "Nats per sequence. Higher is better; no bound exceeds log p.",
    "beliefs": "Nats per step, variance ratio 1 is exact. Lower is better for all others.",
    "agents": "Undiscounted return of whole episodes without exploration; KL in nats per step.",
    "episodes": "Nats per window of stored episodes. Higher is better for ELBO and reconstruction.",
}
_KINDS = {
    "strokes": "world models",
    "processes": "world models",
    "beliefs": "beliefs of the known process",
    "agents": "agents",
    "episodes": "world models of stored episodes",
}
_TITLES = {
    "forbes": "FORBES",
    "rssm": "RSSM",
    "rssm_wide": "RSSM wide",
    "particle": "Particle",
    "vector": "Vector",
    "known_gaussian": "Gaussian, by log q(state)",
    "known_spline": "spline flow, by log q(state)",
    "known_spline_elbo": "spline flow, by the ELBO",
    "forbes_n1": "FORBES, N = 1",
    "forbes_n2": "FORBES, N = 2",
    "dreamer": "Dreamer",
    "dreamer_n4": "Dreamer, N = 4",
    "dreamer_plus1": "Dreamer, one more layer",
    "dreamer_plus2": "Dreamer, two more layers",
    "world_model_forbes": "FORBES",
    "world_model_rssm": "RSSM",
}
"""Names of families on the page."""
_PER_STEP = ("forward_kl", "reverse_kl", "variance_ratio", "mode_mass_error", "elbo_gap")


def score_tables(runs: Sequence[Run]) -> list[Table]:
    """Return a table of the scores of finished runs for each task and kind of measurement."""
    groups: dict[tuple[str, str], dict[str, list[Run]]] = {}
    for run in runs:
        if run.state == "done":
            groups.setdefault((task_of(run.family), run.measure), {}).setdefault(run.family, []).append(run)
    return [_table(task, kind, families) for (task, kind), families in groups.items()]


def _table(task: str, kind: str, families: Mapping[str, Sequence[Run]]) -> Table:
    """Return the table of one task, with the columns that any of its families has."""
    cells = {header: [_cell(runs, score) for runs in families.values()] for score, header in _COLUMNS[kind].items()}
    columns = {header: column for header, column in cells.items() if any(column)}
    rows = [
        (_TITLES[family.partition("/")[2]], [column[i] for column in columns.values()], [run.number for run in runs])
        for i, (family, runs) in enumerate(families.items())
    ]
    return Table(f"{task.replace('_', ' ')}: {_KINDS[kind]}", _CAPTIONS[kind], [*columns], rows)


def _cell(runs: Sequence[Run], score: str) -> str:
    """Return the mean of a score over seeds, with the lowest and highest, where all were measured alike."""
    found = [one for run in runs if (one := entry_of(run.folder, score))]
    if len({(name, entry.get("data", {}).get("sha256")) for name, entry in found}) > 1:
        return "measured differently"
    entries = [entry for _, entry in found]
    means = [entry["per_step"]["mean"] if score in _PER_STEP else entry["mean"] for entry in entries]
    if not means:
        return ""
    if None in means:
        return "infinite"
    mean = number(statistics.fmean(means))
    return mean if len(means) == 1 else f"{mean} [{number(min(means))}, {number(max(means))}]"


def number(value: float, digits: int | None = None) -> str:
    """Return a number with these digits after the point, by default about four in all, with a minus sign."""
    if digits is None:
        digits = 1 if abs(value) >= 100 else 2 if abs(value) >= 1 else 3
    return f"{value:.{digits}f}".replace("-", "−")
