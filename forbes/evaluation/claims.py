r"""The paper's claims as data, and the rule by which measured differences decide them.

A claim is a contrast of families of runs: the score of some minus that of others, signed so that the claim says it is
positive. Its differences are paired over the same test sequences or episodes, one for each seed.

The rule: with differences :math:`d_1, \dots, d_n` of n seeds, their mean :math:`\bar d` has the standard error

.. math:: \sigma^2 = \frac{1}{n} \operatorname{Var}(d_i) + \bar e^2,

where :math:`\bar e` is the mean standard error over sequences, which all seeds share. A claim holds if n is at least 3
and :math:`\bar d > t \sigma`, with the 95 % quantile t of Student's distribution with n - 1 degrees of freedom. So a
difference of seeds that is chance is taken for the claim in at most 5 % of all cases. If only :math:`\bar d > 0`, the
claim holds in direction only, else it does not hold. Runs with fewer updates than a claim needs do not test it.

There is one such test for each claim, so some of many would hold by chance: `by_chance`.
"""

import math
import statistics
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

from forbes.evaluation.estimates import Estimate

__all__ = ["CLAIMS", "DMC_TASKS", "LEAST_SEEDS", "Claim", "Held", "Verdict", "by_chance", "decide", "mean_over_seeds"]

LEAST_SEEDS = 3
_LEVEL = 0.05
"""Share of claims that hold by chance."""
_QUANTILES = (math.inf, 6.314, 2.920, 2.353, 2.132, 2.015, 1.943, 1.895, 1.860, 1.833)
"""95 % quantiles of Student's t with 0 to 9 degrees of freedom; the last also serves more, for which it is larger."""


class Held(StrEnum):
    """Whether a claim held."""

    YES = "holds"
    DIRECTION = "in direction only"
    NO = "does not hold"
    UNTESTED = "not tested"


class Verdict(NamedTuple):
    """Whether a claim held, and why it is not more."""

    held: Held
    reason: str


class Claim(NamedTuple):
    """A claim of the paper, and the contrast of scores that tests it."""

    says: str
    where: str
    """Figure or section of the paper."""
    measured: str
    """The contrast in words."""
    unit: str
    plus: tuple[str, ...]
    """Families whose scores are added."""
    minus: tuple[str, ...]
    """Families whose scores are subtracted."""
    score: str
    """Name of the score, e.g. `elbo`."""
    updates: int
    """Least number of updates of each run, from which on the claim counts as tested."""
    sign: int = 1
    """-1 if a lower score is better."""
    ordered_by: str = ""
    """Another score, lower is better: the sign is such that the contrast is positive if both scores agree on which of
    two families is better."""

    @property
    def families(self) -> tuple[str, ...]:
        """All families that it needs."""
        return self.plus + self.minus


def mean_over_seeds(differences: Mapping[int, Estimate]) -> Estimate:
    """Average the differences of several seeds, by seed, which are means over the same sequences."""
    means = [difference.mean for difference in differences.values()]
    error = statistics.fmean(difference.standard_error for difference in differences.values())
    between = statistics.variance(means) / len(means) if len(means) > 1 else 0.0
    return Estimate(statistics.fmean(means), math.sqrt(between + error**2))


def decide(differences: Mapping[int, Estimate], updates: int, needed: int) -> Verdict:
    """Decide a claim by the rule of this module.

    Args:
        differences: difference of each seed, positive if it agrees with the claim.
        updates: number of updates of the run with the fewest.
        needed: least number of updates.
    """
    if not differences:
        return Verdict(Held.UNTESTED, "no finished and measured runs")
    if updates < needed:
        return Verdict(Held.UNTESTED, f"{updates:,} updates, at least {needed:,} are needed")
    mean, error = mean_over_seeds(differences)
    if not math.isfinite(mean):
        return Verdict(Held.UNTESTED, "the difference is not finite")
    seeds = len(differences)
    few = f"{seeds} seed{'s' * (seeds > 1)}, at least {LEAST_SEEDS} are needed"
    quantile = _QUANTILES[min(seeds, len(_QUANTILES)) - 1]
    if abs(mean) > quantile * error:
        if seeds < LEAST_SEEDS:
            return Verdict(Held.DIRECTION if mean > 0 else Held.NO, few)
        return Verdict(Held.YES, f"{seeds} seeds") if mean > 0 else Verdict(Held.NO, f"{seeds} seeds say the opposite")
    within = few if seeds < LEAST_SEEDS else f"{seeds} seeds, the difference is within its error"
    return Verdict(Held.DIRECTION if mean > 0 else Held.NO, within)


def by_chance(tests: int) -> tuple[float, float]:
    """Return how many of so many claims would hold at most if none were true, in the mean; and the chance of any.

    The chance is that of independent tests. Claims that share runs are not independent; the mean is theirs too.
    """
    return _LEVEL * tests, 1 - (1 - _LEVEL) ** tests


_STROKES, _PROCESSES, _AGENTS, _IMAGES = 3000, 2000, 3000, 20_000
DMC_TASKS = ("cartpole_swingup", "finger_spin", "cheetah_run", "walker_walk", "walker_run", "hopper_stand")
"""The tasks of Figure 6."""

CLAIMS = (
    Claim(
        says="FORBES has the higher test ELBO on digit strokes",
        where="Figure 5",
        measured="ELBO: FORBES − RSSM with the same layer sizes",
        unit="nats per digit",
        plus=("strokes/forbes",),
        minus=("strokes/rssm",),
        score="elbo",
        updates=_STROKES,
    ),
    Claim(
        says="More parameters do not explain it",
        where="appendix",
        measured="ELBO: FORBES − RSSM with as many parameters",
        unit="nats per digit",
        plus=("strokes/forbes",),
        minus=("strokes/rssm_wide",),
        score="elbo",
        updates=_STROKES,
    ),
    Claim(
        says="A flow belief can have several modes, a Gaussian cannot",
        where="Figure 1",
        measured="mirror sensor, KL(exact belief ‖ learned belief): Gaussian − spline flow, both by log q(state)",
        unit="nats per sequence",
        plus=("mirror_sensor/known_gaussian",),
        minus=("mirror_sensor/known_spline",),
        score="forward_kl",
        updates=_PROCESSES,
    ),
    Claim(
        says="So its filtering belief is the better one",
        where="Figure 1, section 3.1",
        measured="digit strokes, prequential log-likelihood (PLL): FORBES − RSSM with as many parameters",
        unit="nats per digit",
        plus=("strokes/forbes",),
        minus=("strokes/rssm_wide",),
        score="pll",
        updates=_STROKES,
    ),
    Claim(
        says="Its predictions are precise",
        where="Figure 4",
        measured="fraction of completions that are clear digits: FORBES − RSSM with as many parameters",
        unit="",
        plus=("strokes/forbes",),
        minus=("strokes/rssm_wide",),
        score="clear",
        updates=_STROKES,
    ),
    Claim(
        says="And diverse",
        where="Figure 4",
        measured="JS divergence of the classes of completions from those the beginning leaves open: RSSM − FORBES",
        unit="nats",
        plus=("strokes/forbes",),
        minus=("strokes/rssm_wide",),
        score="js",
        updates=_STROKES,
        sign=-1,
    ),
    Claim(
        says="FORBES has the higher ELBO on DeepMind Control",
        where="appendix",
        measured="ELBO of stored episodes, summed over six tasks: FORBES − RSSM with the same layer sizes",
        unit="nats",
        plus=tuple(f"{task}/world_model_forbes" for task in DMC_TASKS),
        minus=tuple(f"{task}/world_model_rssm" for task in DMC_TASKS),
        score="elbo",
        updates=_IMAGES,
    ),
    Claim(
        says="Its agents earn more than Dreamer's",
        where="Figure 6",
        measured="DeepMind Control from images, return summed over six tasks: FORBES (N = 4) − Dreamer",
        unit="return",
        plus=tuple(f"{task}/forbes" for task in DMC_TASKS),
        minus=tuple(f"{task}/dreamer" for task in DMC_TASKS),
        score="return",
        updates=_IMAGES,
    ),
    Claim(
        says="Its agents earn more than Dreamer's",
        where="Figure 6, another task",
        measured="mountain hike, return: FORBES (N = 4) − Dreamer",
        unit="return",
        plus=("mountain_hike/forbes",),
        minus=("mountain_hike/dreamer",),
        score="return",
        updates=_AGENTS,
    ),
    Claim(
        says="N = 4 imagined trajectories help FORBES",
        where="appendix",
        measured="DeepMind Control from images, return summed over six tasks: FORBES with N = 4 − with N = 1",
        unit="return",
        plus=tuple(f"{task}/forbes" for task in DMC_TASKS),
        minus=tuple(f"{task}/forbes_n1" for task in DMC_TASKS),
        score="return",
        updates=_IMAGES,
    ),
    Claim(
        says="More trajectories do not make Dreamer as good",
        where="Figure 7",
        measured="DeepMind Control from images, return summed over six tasks: FORBES (N = 4) − Dreamer with N = 4",
        unit="return",
        plus=tuple(f"{task}/forbes" for task in DMC_TASKS),
        minus=tuple(f"{task}/dreamer_n4" for task in DMC_TASKS),
        score="return",
        updates=_IMAGES,
    ),
    Claim(
        says="N = 4 imagined trajectories help FORBES",
        where="appendix, another task",
        measured="mountain hike, return: FORBES with N = 4 − with N = 1",
        unit="return",
        plus=("mountain_hike/forbes",),
        minus=("mountain_hike/forbes_n1",),
        score="return",
        updates=_AGENTS,
    ),
    Claim(
        says="More trajectories do not make Dreamer as good",
        where="Figure 7, another task",
        measured="mountain hike, return: FORBES (N = 4) − Dreamer with N = 4",
        unit="return",
        plus=("mountain_hike/forbes",),
        minus=("mountain_hike/dreamer_n4",),
        score="return",
        updates=_AGENTS,
    ),
    Claim(
        says="N = 4 helps FORBES more than it helps Dreamer",
        where="Figure 7, another task",
        measured="mountain hike, return: what N = 4 adds to FORBES − what it adds to Dreamer",
        unit="return",
        plus=("mountain_hike/forbes", "mountain_hike/dreamer"),
        minus=("mountain_hike/forbes_n1", "mountain_hike/dreamer_n4"),
        score="return",
        updates=_AGENTS,
    ),
    Claim(
        says="A higher ELBO means a better belief",
        where="section 3.1",
        measured="mirror sensor, two spline flows, trained by the ELBO and by log q(state): KL(exact belief ‖ learned "
        "belief) of the one with the lower ELBO − of the one with the higher ELBO",
        unit="nats per sequence",
        plus=("mirror_sensor/known_spline_elbo",),
        minus=("mirror_sensor/known_spline",),
        score="forward_kl",
        updates=_PROCESSES,
        ordered_by="elbo_gap",
    ),
    Claim(
        says="Particle filters do worse",
        where="section 5",
        measured="mirror sensor, PLL: FORBES − an RSSM of eight particles trained with FIVO",
        unit="nats per sequence",
        plus=("mirror_sensor/forbes",),
        minus=("mirror_sensor/particle",),
        score="pll",
        updates=_PROCESSES,
    ),
    Claim(
        says="Particle filters do worse",
        where="section 5",
        measured="multi-start hike, PLL: FORBES − an RSSM of eight particles trained with FIVO",
        unit="nats per sequence",
        plus=("multi_start_hike/forbes",),
        minus=("multi_start_hike/particle",),
        score="pll",
        updates=_PROCESSES,
    ),
)
"""The claims that runs can test, in the order of the report. Theorem 1 is checked in closed form (`theorem_gap`)."""
