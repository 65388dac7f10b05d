"""Claims are decided by a rule with known errors, from differences that are those of the recorded scores."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from forbes.errors import ForbesError
from forbes.evaluation import claims
from forbes.evaluation.claims import CLAIMS, Claim, Held, by_chance, decide, mean_over_seeds
from forbes.evaluation.contrasts import contrast, entry_of
from forbes.evaluation.estimates import Estimate
from forbes.evaluation.metrics import score_of

TRIALS = 20_000


def by_seed(means, error=0.0):
    return {seed: Estimate(float(mean), error) for seed, mean in enumerate(means)}


def share_that_holds(seeds, mean, spread, error=0.0):
    generator = torch.Generator().manual_seed(0)
    drawn = mean + spread * torch.randn(TRIALS, seeds, generator=generator, dtype=torch.float64)
    if error:
        drawn += error * torch.randn(TRIALS, 1, generator=generator, dtype=torch.float64)  # what all seeds share
    return np.mean([decide(by_seed(row, error), 10, 10).held == Held.YES for row in drawn.tolist()])


@pytest.mark.parametrize("freedom", range(1, 10))
def test_the_quantiles_are_those_of_students_t(freedom):
    quantile = claims._QUANTILES[freedom]
    grid = torch.linspace(0, quantile, 200_001, dtype=torch.float64)
    density = torch.distributions.StudentT(torch.tensor(float(freedom), dtype=torch.float64)).log_prob(grid).exp()

    assert 0.5 + torch.trapezoid(density, grid).item() == pytest.approx(0.95, abs=2e-4)  # three digits of t


@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize("error", [0.0, 1.0])
def test_chance_holds_in_at_most_one_case_of_twenty(seeds, error):
    share = share_that_holds(seeds, 0.0, 1.0, error)

    assert share <= 0.05 + 4 * math.sqrt(0.05 * 0.95 / TRIALS)
    assert error or share >= 0.05 - 4 * math.sqrt(0.05 * 0.95 / TRIALS)  # exactly one if sequences add no error


def test_several_claims_hold_by_chance_as_often_as_told():
    """Ten claims that are not true, of three seeds each, in trials of which each is one page."""
    generator = torch.Generator().manual_seed(1)
    pages, tests = 2000, 10
    drawn = torch.randn(pages, tests, 3, generator=generator, dtype=torch.float64).tolist()
    held = torch.tensor([[decide(by_seed(row), 10, 10).held == Held.YES for row in page] for page in drawn]).double()

    mean, any_of_them = by_chance(tests)

    assert held.sum(1).mean() == pytest.approx(mean, abs=4 * math.sqrt(tests * 0.05 * 0.95 / pages))
    share = held.amax(1).mean()
    assert share == pytest.approx(any_of_them, abs=4 * math.sqrt(any_of_them * (1 - any_of_them) / pages))


@pytest.mark.parametrize(("seeds", "least"), [(3, 0.9), (5, 0.99)])
def test_a_difference_of_four_spreads_holds(seeds, least):
    assert share_that_holds(seeds, 4.0, 1.0) >= least


@pytest.mark.parametrize(
    ("means", "updates", "held", "reason"),
    [
        ([], 10, Held.UNTESTED, "no finished"),
        ([1, 1, 1], 9, Held.UNTESTED, "9 updates, at least 10 are needed"),
        ([5, 5.1, 4.9], 10, Held.YES, "3 seeds"),
        ([5, 5.1], 10, Held.DIRECTION, "2 seeds, at least 3 are needed"),
        ([5], 10, Held.DIRECTION, "1 seed, at least 3 are needed"),
        ([39.4, 13.7, -21.0], 10, Held.DIRECTION, "within its error"),
        ([-39.4, -13.7, 21.0], 10, Held.NO, "within its error"),
        ([-5, -5.1, -4.9], 10, Held.NO, "the opposite"),
        ([math.inf, 1, 1], 10, Held.UNTESTED, "not finite"),
    ],
)
def test_a_verdict_says_what_it_lacks(means, updates, held, reason):
    verdict = decide(by_seed(means, 0.01), updates, 10)

    assert verdict.held == held
    assert reason in verdict.reason


def test_the_error_has_a_part_of_the_seeds_and_one_of_the_sequences():
    mean, error = mean_over_seeds({0: Estimate(1.0, 0.3), 1: Estimate(2.0, 0.3), 2: Estimate(6.0, 0.3)})

    assert mean == pytest.approx(3.0)
    assert error == pytest.approx(math.sqrt(7.0 / 3 + 0.09))  # the variance of 1, 2, 6 is 7


@pytest.mark.parametrize(
    ("metric", "score"),
    [("test[:1000]/pll[bernoulli,K=128]", "pll"), ("test/elbo[S=2]", "elbo"), ("return[episodes=2]", "return")],
)
def test_a_score_is_found_in_the_name_of_its_metric(metric, score):
    assert score_of(metric) == score


@pytest.fixture
def recorded(tmp_path):
    """A function that records the scores of a run, and returns its folder."""

    def record(name, data="a", **scores):
        folder = tmp_path / name
        folder.mkdir()
        about = {"data": {"name": data, "sha256": data}, "seed": 0, "date": "2026-01-01"}
        entries = {f"test/{score}[S=1]": {"mean": float(np.mean(values))} | about for score, values in scores.items()}
        (folder / "evaluation.json").write_text(json.dumps(entries))
        arrays = {f"test/{score}[S=1]": np.array(values, float) for score, values in scores.items()}
        np.savez(folder / "evaluation.npz", **arrays)
        return str(folder)

    return record


def claim_of(plus, minus, score, **others):
    return Claim("says", "where", "measured", "nats", plus, minus, score, 1, **others)


def test_a_contrast_is_paired_over_sequences(recorded):
    one, other = np.random.default_rng(0).normal(size=(2, 20))
    runs = {("t/a", 0): recorded("a", elbo=one), ("t/b", 0): recorded("b", elbo=other)}

    (found,) = contrast(claim_of(("t/a",), ("t/b",), "elbo"), runs, {}).values()
    (opposite,) = contrast(claim_of(("t/a",), ("t/b",), "elbo", sign=-1), runs, {}).values()

    assert found == pytest.approx(((one - other).mean(), (one - other).std(ddof=1) / math.sqrt(20)))
    assert opposite.mean == pytest.approx(-found.mean)


def test_tasks_are_summed_and_families_of_a_task_paired(recorded):
    scores = np.random.default_rng(0).normal(size=(4, 20))
    families = ("t/a", "u/a", "t/b", "u/b")
    runs = {(name, 0): recorded(name.replace("/", "-"), elbo=of) for name, of in zip(families, scores, strict=True)}

    (found,) = contrast(claim_of(families[:2], families[2:], "elbo"), runs, {}).values()

    tasks = scores[:2] - scores[2:]
    assert found.mean == pytest.approx(tasks.mean(1).sum())
    assert found.standard_error == pytest.approx(math.hypot(*(tasks.std(1, ddof=1) / math.sqrt(20))))


@pytest.mark.parametrize(("gap", "sign"), [(1.0, -1), (9.0, 1)])
def test_an_order_agrees_if_the_one_with_the_smaller_gap_is_better(recorded, gap, sign):
    """The first belief has a KL of 3, the other 1. It counts for the claim if the first has the larger gap too."""
    runs = {
        ("t/a", 0): recorded("a", forward_kl=[3.0, 3.0], elbo_gap=[gap, gap]),
        ("t/b", 0): recorded("b", forward_kl=[1.0, 1.0], elbo_gap=[5.0, 5.0]),
    }

    (found,) = contrast(claim_of(("t/a",), ("t/b",), "forward_kl", ordered_by="elbo_gap"), runs, {}).values()

    assert found.mean == sign * 2.0


def test_seeds_that_lack_a_family_are_left_out(recorded):
    runs = {("t/a", 0): recorded("a", elbo=[1, 2]), ("t/a", 1): recorded("c", elbo=[1, 2])}
    runs["t/b", 1] = recorded("d", elbo=[0, 0])

    assert list(contrast(claim_of(("t/a",), ("t/b",), "elbo"), runs, {})) == [1]
    assert contrast(claim_of(("t/a",), ("t/b",), "pll"), runs, {}) == {}
    runs["t/b", 0] = recorded("not-measured", pll=[1, 2])
    assert list(contrast(claim_of(("t/a",), ("t/b",), "elbo"), runs, {})) == [1]


def test_other_sequences_are_not_compared(recorded):
    runs = {("t/a", 0): recorded("a", elbo=[1, 2]), ("t/b", 0): recorded("b", data="other", elbo=[1, 2])}

    with pytest.raises(ForbesError, match="its elbo was measured otherwise than that of"):
        contrast(claim_of(("t/a",), ("t/b",), "elbo"), runs, {})


def test_completions_are_read_from_their_record(tmp_path):
    path = tmp_path / "completions.json"
    metric = "test[:4]/clear[c=10,N=2,end]"
    single = {"metric": metric, "minus": None, "mean": 0.5, "standard_error": 0.1}
    path.write_text(json.dumps({"scores": [single, single | {"minus": "b", "mean": 0.02, "standard_error": 0.01}]}))

    found = contrast(claim_of(("t/a",), ("t/b",), "clear"), {("t/a", 0): "a", ("t/b", 0): "b"}, {0: path})

    assert found == {0: Estimate(0.02, 0.01)}


def test_the_newest_entry_of_a_score_is_taken(recorded):
    run = recorded("a", elbo=[1, 2])
    path = Path(run, "evaluation.json")
    record = json.loads(path.read_text())
    record["test[:9]/elbo[S=9]"] = record["test/elbo[S=1]"] | {"mean": 7.0, "date": "2026-01-02"}
    path.write_text(json.dumps(record))

    assert entry_of(run, "elbo")[1]["mean"] == 7.0


def test_each_claim_names_its_families_once():
    for claim in CLAIMS:
        assert len({*claim.families}) == len(claim.families)
        assert claim.sign in (1, -1)
        assert not claim.ordered_by or len(claim.families) == 2
