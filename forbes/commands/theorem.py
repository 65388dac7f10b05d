"""`forbes theorem`: Theorem 1 on linear-Gaussian processes, and why a higher ELBO is not a better belief."""

import argparse
from collections.abc import Sequence

from rich import box
from rich.table import Table

from forbes.commands.console import console
from forbes.commands.parsers.theorem import parser
from forbes.errors import ForbesError
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.theorem import (
    POSTERIORS,
    PROCESSES,
    ClosedFormProcess,
    belief_scores,
    between,
    exact_filter,
    factorised_optimum,
    identity,
    sample_gap,
)
from forbes.seeding import generator

__all__ = ["main"]

_TIE = 1e-9  # nats
_FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
_MAX_SAMPLES = 30_000_000  # samples times steps; they take 1 GB

_IDENTITY = """\
log p - ELBO equals the sum of the KLs to the smoothing conditionals p(s_t|s_t-1,o_t:T); here they differ by at most \
{apart:.0e}. It does not equal the sum for the filtering posterior p(s_t|o_1:t), as the paper has it. Monte Carlo is \
the mean of log p(o) - log p(s,o) + log q(s|o) over samples."""
_BELIEFS = """\
The exact filter p(s_t|o_1:t) predicts best (PLL) and has its nominal coverage, yet its ELBO is lower than that of \
both q, which are best by the ELBO. Their variances are too small, and they cover less than their nominal 90 %."""
_SCAN = """\
Between the exact filter and the best q(s_t|o_1:t), the ELBO and the prequential score rank the beliefs in opposite \
orders."""

_EXACT = "The four beliefs have the same ELBO up to 1e-9 nats, as with F = 0 or one step, so there is nothing to rank."


def main(argv: Sequence[str]) -> None:
    """Run the command with its arguments."""
    args = parser().parse_args(argv)
    if args.samples * args.steps > _MAX_SAMPLES:
        most = _MAX_SAMPLES // args.steps
        raise ForbesError(f"--samples {args.samples}: expected at most {most} with {args.steps} steps")
    processes = _processes(args)
    screen = console(80)
    table, apart = _identity(processes, args.samples, args.seed)
    if all(_same_bounds(process) for process in processes):
        screen.print(table, _beliefs(processes), _scan(processes), _EXACT, sep="\n", highlight=False)
        return
    screen.print(table, _IDENTITY.format(apart=apart), "", sep="\n", highlight=False)
    screen.print(_beliefs(processes), _BELIEFS, "", sep="\n", highlight=False)
    screen.print(_scan(processes), _SCAN, sep="\n", highlight=False)


def _processes(args: argparse.Namespace) -> list[ClosedFormProcess]:
    """Return the process given by the arguments, or three processes by default."""
    given = (args.transition, args.process_noise, args.observation_noise)
    if given == (None, None, None):
        return [process._replace(steps=args.steps) for process in PROCESSES]
    transition, process_noise, observation_noise = (1.0 if value is None else value for value in given)
    return [ClosedFormProcess(transition, process_noise, observation_noise, args.steps)]


def _same_bounds(process: ClosedFormProcess) -> bool:
    """Return whether the posteriors have the same ELBO, up to `_TIE`."""
    gaps = [belief_scores(process, posterior_of(process)).elbo_gap for posterior_of in POSTERIORS.values()]
    return max(gaps) - min(gaps) < _TIE


def _name(process: ClosedFormProcess) -> str:
    return f"F={process.transition:g} Q={process.process_noise:g} R={process.observation_noise:g}"


def _table(title: str, first: str, *columns: str) -> Table:
    """Return an empty table. A column's name may have several lines."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column(first, overflow="fold")
    for column in columns:
        table.add_column(column, justify="right", overflow="fold")
    return table


def _identity(processes: Sequence[ClosedFormProcess], samples: int, seed: int) -> tuple[Table, float]:
    """Return a table of both sides of the identity, and of the paper's form of it; and how far both sides differ."""
    table = _table(
        f"Theorem 1 in nats per sequence, {processes[0].steps} steps, {samples} samples", "posterior", "log p\n- ELBO",
        "Σ KL,\nsmoothing", "Monte\nCarlo", "paper:\nΣ KL,\nfilter", "its\nerror",
    )  # fmt: skip
    apart = 0.0
    for process in processes:
        table.add_row(f"[bold]{_name(process)}")
        for number, (name, posterior_of) in enumerate(POSTERIORS.items()):
            posterior = posterior_of(process)
            gap, right, paper = identity(process, posterior)
            if not abs(gap - right) <= 1e-8 * max(1.0, gap):
                raise ForbesError(
                    f"{_name(process)}: with {process.steps} steps the precision of float64 does not suffice. "
                    "Choose fewer --steps, or F and the ratio of Q and R closer to 1"
                )
            apart = max(apart, abs(gap - right))
            drawn = Estimate.of(sample_gap(process, posterior, samples, generator(seed, "theorem", number)))
            table.add_row(
                name, f"{gap:.4f}", f"{right:.4f}", f"{drawn.mean:.2f} ± {drawn.standard_error:.2f}",
                f"{paper:.4f}", f"{paper - gap:+.4f}",
            )  # fmt: skip
        table.add_section()
    return table, apart


def _beliefs(processes: Sequence[ClosedFormProcess]) -> Table:
    """Return a table of the scores of each posterior by its ELBO, and as a belief."""
    table = _table(
        "Scores of the same posteriors as beliefs q(s_t|o_1:t)", "belief", "log p\n- ELBO", "log p\n- PLL",
        "Σ KL to\nexact", "state\nNLL per\nstep", "variance\nratio", "coverage",
    )  # fmt: skip
    for process in processes:
        table.add_row(f"[bold]{_name(process)}")
        for name, posterior_of in POSTERIORS.items():
            gap, deficit, kl, nll, ratio, coverage = belief_scores(process, posterior_of(process))
            table.add_row(
                name, f"{gap:.3f}", f"{deficit:.4f}", f"{kl:.3f}", f"{nll:.3f}", f"{ratio:.3f}", f"{coverage:.1%}"
            )
        table.add_section()
    return table


def _scan(processes: Sequence[ClosedFormProcess]) -> Table:
    """Return a table that ranks beliefs between the exact filter and the factorised optimum by ELBO and by PLL."""
    table = _table(
        "Which belief is better?", "interpolation", "log p\n- ELBO", "rank by\nELBO", "log p\n- PLL", "rank by\nPLL"
    )
    for process in processes:
        table.add_row(f"[bold]{_name(process)}")
        ends = exact_filter(process), factorised_optimum(process)
        scores = [belief_scores(process, between(*ends, fraction)) for fraction in _FRACTIONS]
        gaps, deficits = [score.elbo_gap for score in scores], [score.prequential_deficit for score in scores]
        for fraction, gap, deficit in zip(_FRACTIONS, gaps, deficits, strict=True):
            by_elbo, by_prediction = _rank(gap, gaps), _rank(deficit, deficits)
            table.add_row(f"{fraction:.0%}", f"{gap:.3f}", by_elbo, f"{deficit:.4f}", by_prediction)
        table.add_section()
    return table


def _rank(value: float, values: Sequence[float]) -> str:
    """Return the rank of a value, from 1; differences below `_TIE` are ties."""
    return str(1 + sum(other < value - _TIE for other in values))
