r"""Summarise the scores of agents over tasks and seeds (Agarwal et al., 2021, arXiv 2108.13264).

A method has one score per task k and seed i, :math:`x_{k,i}`, on a scale that all tasks share. With few seeds a mean is
ruled by its outliers and says nothing of its own error. So there are three numbers:

- the interquartile mean (IQM) of all scores, a mean that ignores the quarter at either end;
- an interval around it, from a bootstrap that is stratified: seeds are resampled within each task;
- the probability that one method improves on another, on a task chosen at random.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from forbes.seeding import generator

__all__ = [
    "Interval",
    "Scores",
    "Summary",
    "aggregate",
    "interquartile_mean",
    "probability_of_improvement",
    "stratified_interval",
    "summarise",
]

Scores: TypeAlias = Sequence[Tensor]
"""Scores of a method, one tensor `(..., N_k)` per task, for its N_k seeds. Leading dimensions are resamples."""

_RESAMPLES = 1000


def interquartile_mean(scores: Tensor) -> Tensor:
    r"""Return the mean of the scores without the lowest and the highest quarter, `(..., N)` to `(...)`.

    .. math:: \frac{1}{N - 2c} \sum_{j=c+1}^{N-c} x_{(j)}, \qquad c = \lfloor N / 4 \rfloor

    Fewer than four scores are all averaged.
    """
    count = scores.shape[-1]
    cut = count // 4
    return scores.sort(-1).values[..., cut : count - cut].mean(-1)


def aggregate(scores: Scores) -> Tensor:
    """Return the interquartile mean of all scores of all tasks, `(...)`."""
    return interquartile_mean(torch.cat(list(scores), -1))  # (..., N)


def probability_of_improvement(one: Scores, other: Scores) -> Tensor:
    r"""Return the probability that a seed of one method has a higher score than a seed of the other, `(...)`.

    .. math:: P(X > Y) = \frac1K \sum_k \frac1{N_k M_k} \sum_{i,j} S(x_{k,i}, y_{k,j}), \qquad
              S(x, y) = \begin{cases} 1 & x > y \\ \frac12 & x = y \\ 0 & x < y \end{cases}

    Ties count half, so the probabilities of both directions add up to 1.

    Args:
        one: scores of X on each task.
        other: scores of Y on the same tasks, with the same leading dimensions.
    """
    difference = [x[..., :, None] - y[..., None, :] for x, y in zip(one, other, strict=True)]  # K x (..., N_k, M_k)
    return torch.stack([(0.5 + 0.5 * each.sign()).mean((-2, -1)) for each in difference]).mean(0)


def stratified_interval(
    statistic: Callable[..., Tensor], *methods: Scores, level: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Return the percentile interval of a statistic, with the seeds resampled within each task of each method.

    Args:
        statistic: `aggregate` of one method, or `probability_of_improvement` of two.
        *methods: scores of each method, `(N_k,)` per task. A task with one seed adds no variance.
        level: probability of the interval.
        seed: random seed for the resamples.
    """
    draw = generator(seed, "stratified bootstrap", 0)
    resampled = [[_resample(scores, draw) for scores in method] for method in methods]
    tail = (1 - level) / 2
    values = statistic(*resampled)  # (R,)
    low, high = values.quantile(values.new_tensor([tail, 1 - tail]))
    return low.item(), high.item()


def _resample(scores: Tensor, draw: torch.Generator) -> Tensor:
    """Sample as many scores as there are, with replacement, R times: `(N,)` to `(R, N)`."""
    return scores[torch.randint(len(scores), (_RESAMPLES, len(scores)), generator=draw)]


class Interval(NamedTuple):
    """A statistic with its bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


class Summary(NamedTuple):
    """Several methods on the tasks that all of them have."""

    tasks: list[str]
    iqm: dict[str, Interval]
    """Interquartile mean by method."""
    seeds: dict[str, int]
    """Number of scores by method, over all tasks."""
    improvement: dict[tuple[str, str], Interval]
    """Probability that the first method of each pair improves on the second."""

    def lines(self) -> list[str]:
        """Return a line for each method, and for each pair of methods."""
        wide = max(map(len, self.iqm))
        means = [f"{name:<{wide}}  {found}, {self.seeds[name]} runs" for name, found in self.iqm.items()]
        pairs = [f"P({one} > {other}) = {found}" for (one, other), found in self.improvement.items()]
        return means + pairs


def summarise(methods: Mapping[str, Mapping[str, Sequence[float]]]) -> Summary | None:
    """Summarise the scores of each method, one per seed, by task; None unless two methods have a task in common.

    Without a second seed on any task an interval has no width.
    """
    first, *others = methods.values() if methods else [{}]
    tasks = [task for task in first if all(task in other for other in others)]
    if not others or not tasks:
        return None
    scores = {
        name: [torch.tensor(of_method[task], dtype=torch.float64) for task in tasks]
        for name, of_method in methods.items()
    }
    return Summary(
        tasks,
        {name: _interval(aggregate, each) for name, each in scores.items()},
        {name: sum(map(len, each)) for name, each in scores.items()},
        {
            (one, other): _interval(probability_of_improvement, scores[one], scores[other])
            for one, other in itertools.combinations(scores, 2)
        },
    )


def _interval(statistic: Callable[..., Tensor], *methods: Scores) -> Interval:
    return Interval(statistic(*methods).item(), *stratified_interval(statistic, *methods))
