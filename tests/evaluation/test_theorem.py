"""Theorem 1 holds with the smoothing conditional and not with the filter; a higher ELBO is not a better belief."""

import contextlib
import io
import math
import re
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import MultivariateNormal

from forbes.commands.cli import main
from forbes.evaluation.theorem import (
    ClosedFormProcess,
    Conditional,
    belief_scores,
    between,
    elbo,
    exact_filter,
    exact_one_step,
    expected_kl,
    factorised_optimum,
    identity,
    log_evidence,
    sample_gap,
    smoothing,
    structured_optimum,
)

CASES = {"1,1,1": (1.0, 1.0, 1.0), "1,.1,1": (1.0, 0.1, 1.0), ".9,.3,.5": (0.9, 0.3, 0.5)}
PROCESSES = [ClosedFormProcess(*case) for case in CASES.values()] + [ClosedFormProcess(-0.7, 2.0, 0.3, 6, 0.4)]
POSTERIORS = [exact_filter, exact_one_step, factorised_optimum, structured_optimum, smoothing]


def arbitrary(process, seed=0):
    """A posterior that is good for nothing, and sees all of the observations."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(process.steps + 2, process.steps, generator=generator, dtype=torch.float64)
    carry = draw[0].clone()
    carry[0] = 0
    return Conditional(carry, draw[2:], draw[1].exp())


def outer_product_of_a_sequence(process):
    generator = torch.Generator().manual_seed(1)
    observation = 2 * torch.randn(process.steps, generator=generator, dtype=torch.float64)
    return observation.outer(observation)


@pytest.mark.parametrize("process", PROCESSES, ids=str)
@pytest.mark.parametrize("posterior_of", [*POSTERIORS, arbitrary])
@pytest.mark.parametrize("moment_of", [ClosedFormProcess.moment, outer_product_of_a_sequence])
def test_the_elbo_gap_is_the_kl_to_the_smoothing_conditionals(process, posterior_of, moment_of):
    posterior, moment = posterior_of(process), moment_of(process)

    gap = log_evidence(process, moment) - elbo(process, posterior, moment)

    kl = expected_kl(posterior, smoothing(process), moment)
    torch.testing.assert_close(gap, kl, rtol=1e-12, atol=1e-8)


@pytest.mark.parametrize("process", PROCESSES, ids=str)
@pytest.mark.parametrize("posterior_of", [*POSTERIORS, arbitrary])
def test_samples_average_to_the_closed_form(process, posterior_of):
    posterior, moment = posterior_of(process), process.moment()

    gap = sample_gap(process, posterior, 5_000, torch.Generator().manual_seed(0))

    closed = expected_kl(posterior, smoothing(process), moment)
    assert abs(gap.mean() - closed) < 4 * gap.std() / math.sqrt(len(gap)) + 1e-10


@pytest.mark.parametrize("process", PROCESSES, ids=str)
def test_the_exact_posterior_has_no_gap_in_any_sample(process):
    gap = sample_gap(process, smoothing(process), 100, torch.Generator().manual_seed(0))

    torch.testing.assert_close(gap, torch.zeros_like(gap), rtol=0, atol=1e-11)


@pytest.mark.parametrize("process", PROCESSES[:3], ids=str)
@pytest.mark.parametrize("posterior_of", POSTERIORS[:4])
def test_the_papers_sum_over_the_filter_is_not_the_gap(process, posterior_of):
    gap, _, filtering = identity(process, posterior_of(process))

    assert abs(filtering - gap) > 0.1


@pytest.mark.parametrize(("case", "error"), [("1,1,1", 5.19), ("1,.1,1", 32.6), (".9,.3,.5", 6.06)])
def test_the_papers_form_is_wrong_by_the_exact_filters_gap(case, error):
    process = ClosedFormProcess(*CASES[case])
    posterior, moment = exact_filter(process), process.moment()

    paper = expected_kl(posterior, exact_filter(process), moment)

    assert paper == 0
    gap = log_evidence(process, moment) - elbo(process, posterior, moment)
    assert gap.item() == pytest.approx(error, abs=0.5 * 10 ** -len(str(error).partition(".")[2]))


def joint_covariance(process):
    """Cov of (s, o), entry by entry: Cov(s_t, s_u) = F^(u-t) Var(s_t) for u ≥ t."""
    variance = [process.first_variance]
    for _ in range(process.steps - 1):
        variance.append(process.transition**2 * variance[-1] + process.process_noise)
    states = torch.tensor(
        [
            [variance[min(t, u)] * process.transition ** abs(t - u) for u in range(process.steps)]
            for t in range(process.steps)
        ],
        dtype=torch.float64,
    )
    seen = states + process.observation_noise * torch.eye(process.steps, dtype=torch.float64)
    return torch.cat((torch.cat((states, states), 1), torch.cat((states, seen), 1)))


def condition(covariance, target, given):
    """Weights and variance of one Gaussian variable given some others."""
    block = covariance[given][:, given]
    weights = torch.linalg.solve(block, covariance[given, target])
    return weights, covariance[target, target] - weights @ covariance[given, target]


@pytest.mark.parametrize("process", PROCESSES, ids=str)
@pytest.mark.parametrize(
    ("posterior_of", "carries", "seen"),
    [
        (exact_filter, False, lambda t, steps: range(t + 1)),
        (exact_one_step, True, lambda t, steps: [t]),
        (smoothing, True, lambda t, steps: range(t, steps)),
        (smoothing, True, lambda t, steps: range(steps)),  # the past adds nothing to s_{t-1}
    ],
    ids=["filter", "one step", "smoothing", "smoothing, all seen"],
)
def test_an_exact_conditional_is_that_of_the_dense_gaussian(process, posterior_of, carries, seen):
    covariance, posterior = joint_covariance(process), posterior_of(process)

    for t in range(process.steps):
        before = [t - 1] if carries and t > 0 else []
        times = list(seen(t, process.steps))
        weights, variance = condition(covariance, t, before + [process.steps + u for u in times])

        expected = torch.zeros(process.steps, dtype=torch.float64)
        expected[times] = weights[len(before) :]
        torch.testing.assert_close(posterior.gain[t], expected, rtol=0, atol=1e-12)
        torch.testing.assert_close(posterior.variance[t], variance, rtol=1e-10, atol=0)
        torch.testing.assert_close(posterior.carry[t : t + 1], weights[: len(before)] if before else 0 * variance[None])


@pytest.mark.parametrize("process", PROCESSES, ids=str)
def test_process_and_evidence_are_those_of_the_dense_gaussian(process):
    covariance, moment = joint_covariance(process), outer_product_of_a_sequence(process)
    observation = moment[0] / moment[0, 0].sqrt()

    evidence = MultivariateNormal(torch.zeros_like(observation), covariance[process.steps :, process.steps :])

    torch.testing.assert_close(process.precision() @ covariance, torch.eye(len(covariance), dtype=torch.float64))
    torch.testing.assert_close(process.moment(), evidence.covariance_matrix)
    torch.testing.assert_close(log_evidence(process, moment), evidence.log_prob(observation))


@pytest.mark.parametrize("process", PROCESSES, ids=str)
@pytest.mark.parametrize(("optimum", "carries"), [(factorised_optimum, False), (structured_optimum, True)])
def test_no_other_posterior_that_sees_the_past_has_a_higher_elbo(process, optimum, carries):
    best, moment = optimum(process), process.moment()
    past = torch.ones_like(best.gain).tril()
    carry, gain, log_variance = (values.requires_grad_() for values in (best.carry, best.gain, best.variance.log()))

    value = elbo(process, Conditional(carry, gain, log_variance.exp()), moment)
    by_carry, by_gain, by_variance = torch.autograd.grad(value, (carry, gain, log_variance))

    assert torch.equal(gain, gain * past)
    zero = torch.zeros_like(gain)
    torch.testing.assert_close(by_gain * past, zero, rtol=0, atol=1e-10)
    torch.testing.assert_close(by_variance, zero[0], rtol=0, atol=1e-10)
    if carries:
        torch.testing.assert_close(by_carry[1:], zero[0, 1:], rtol=0, atol=1e-10)
    generator = torch.Generator().manual_seed(0)
    for scale in (0.01, 0.1, 1.0):  # a stationary point, and no saddle
        steps = scale * torch.randn(process.steps + 2, process.steps, generator=generator, dtype=torch.float64)
        steps[0, 0] = 0
        other = Conditional(best.carry + carries * steps[0], gain + past * steps[2:], best.variance * steps[1].exp())
        assert elbo(process, other, moment) < value


def decimals(text):
    """Half a unit of the last digit that is quoted."""
    return 0.5001 * 10 ** -len(text.partition(".")[2])


# Optima of the ELBO as they were first computed, independently of this code (T = 15): gap, deficit, KL, state NLL,
# variance ratio and coverage in per cent, the last two at the middle step.
QUOTED = {
    ("1,1,1", exact_filter): ("5.19", "0.0000", "0", "1.170", "1", "90"),
    ("1,1,1", factorised_optimum): ("3.22", "0.113", "1.35", "1.310", "0.539", "76.4"),
    ("1,1,1", structured_optimum): ("2.235", ".079", ".60", None, ".724", "83.0"),
    ("1,.1,1", exact_filter): ("32.6", "0.0000", "0", "0.809", "1", "90"),
    ("1,.1,1", factorised_optimum): ("6.05", "0.586", "8.89", "3.087", "0.175", "46.2"),
    ("1,.1,1", structured_optimum): ("2.640", ".430", "2.87", None, ".581", "73.9"),
    (".9,.3,.5", exact_filter): ("6.06", "0.0000", "0", "0.739", "1", "90"),
    (".9,.3,.5", factorised_optimum): ("3.31", "0.123", "1.79", "0.939", "0.496", "74.2"),
    (".9,.3,.5", structured_optimum): ("1.946", ".085", ".66", None, ".746", "83.4"),
    ("1,1,.1", structured_optimum): (".583", ".0004", ".03", None, ".923", "88.6"),
}


@pytest.mark.parametrize(("case", "posterior_of"), QUOTED)
def test_scores_are_those_quoted(case, posterior_of):
    process = ClosedFormProcess(*CASES.get(case, (1.0, 1.0, 0.1)))

    scores = belief_scores(process, posterior_of(process))

    *values, coverage = scores
    for value, quoted in zip([*values, 100 * coverage], QUOTED[case, posterior_of], strict=True):
        if quoted is not None:
            assert value == pytest.approx(float(quoted), abs=decimals(quoted))


def test_scores_are_means_over_simulated_sequences():
    process = ClosedFormProcess(0.9, 0.3, 0.5, steps=4)
    belief, samples = structured_optimum(process).marginal(), 20_000
    factor = torch.linalg.cholesky(joint_covariance(process))
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(samples, 8, generator=generator, dtype=torch.float64) @ factor.T
    state, observation = drawn.chunk(2, 1)
    normal = torch.distributions.Normal(observation @ belief.gain.T, belief.variance.sqrt())

    deficit = torch.zeros(samples, dtype=torch.float64)
    for t in range(1, 4):  # the first observation is predicted without a belief
        spread = process.transition**2 * belief.variance[t - 1] + process.process_noise + process.observation_noise
        predicted = torch.distributions.Normal(process.transition * normal.mean[:, t - 1], spread.sqrt())
        weights, variance = condition(joint_covariance(process), 4 + t, list(range(4, 4 + t)))
        exact = torch.distributions.Normal(observation[:, :t] @ weights, variance.sqrt())
        deficit += exact.log_prob(observation[:, t]) - predicted.log_prob(observation[:, t])
    nll = -normal.log_prob(state).mean(1)
    inside = ((state - normal.mean).abs() < 1.6449 * normal.stddev)[:, 2].double()

    scores = belief_scores(process, structured_optimum(process))
    for values, score in [(deficit, scores[1]), (nll, scores.state_nll), (inside, scores.coverage)]:
        assert abs(values.mean() - score) < 4 * values.std() / math.sqrt(samples)


@settings(deadline=None, max_examples=30, derandomize=True)
@given(
    st.floats(0.1, 1.2),
    st.sampled_from([-1, 1]),
    st.floats(0.05, 5),
    st.floats(0.05, 5),
    st.integers(2, 12),
)
def test_elbo_and_prediction_put_beliefs_in_opposite_orders(transition, sign, process_noise, observation_noise, steps):
    process = ClosedFormProcess(sign * transition, process_noise, observation_noise, steps)
    ends = exact_filter(process), factorised_optimum(process)

    scores = [belief_scores(process, between(*ends, share / 4)) for share in range(5)]

    for before, after in pairwise(scores):
        assert after.elbo_gap < before.elbo_gap
        assert after.prequential_deficit > before.prequential_deficit


@pytest.fixture(scope="module")
def printed():
    """The command's three tables, row by row, and all that is printed."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        assert main(["theorem", "--samples", "500"]) == 0
    cells = [re.split(" {2,}", line.strip()) for line in output.getvalue().splitlines()]
    return [row for row in cells if re.match(r"(exact|best) |\d+%", row[0]) and len(row) > 1], output.getvalue()


def test_the_command_prints_both_sides_and_the_beliefs_worth(printed):
    rows, text = printed
    identity, beliefs, scan = rows[:12], rows[12:24], rows[24:]

    assert max(map(len, text.splitlines())) <= 80
    assert re.search(r"F=1 Q=1 R=1 *\n *exact p\(s_t\|o_1:t\) ", text)
    assert re.search(r"differ by at most \de-1\d\.", " ".join(text.split()))
    for _, gap, kl, drawn, paper, error in identity:
        assert gap == kl
        mean, standard_error = map(float, drawn.split(" ± "))
        assert abs(mean - float(gap)) < 4 * standard_error
        assert float(error) == pytest.approx(float(paper) - float(gap), abs=2e-4)
    assert identity[0][:3] == ["exact p(s_t|o_1:t)", "5.1893", "5.1893"]
    assert identity[0][-1] == "-5.1893"
    assert [row[-1] for row in beliefs[:4]] == ["90.0%", "90.0%", "76.4%", "83.0%"]
    assert [row[2] for row in scan] == list("54321") * 3
    assert [row[4] for row in scan] == list("12345") * 3
    assert "opposite orders" in text


def test_one_process_can_be_chosen(capsys):
    assert main(["theorem", "--transition", "-0.5", "--observation-noise", "2", "--steps", "3", "--samples", "9"]) == 0

    output = capsys.readouterr().out
    assert "3 steps, 9 samples" in output
    assert "F=-0.5 Q=1 R=2" in output
    assert "F=1 " not in output


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--process-noise", "0"], "0 is not a variance above 0"),
        (["--observation-noise", "-1"], "-1 is not a variance above 0"),
        (["--observation-noise", "nan"], "nan is not a number"),
        (["--transition", "fast"], "fast is not a number"),
        (["--transition", "inf"], "inf is not a number"),
        (["--steps", "0"], "0 is not a number above 0"),
        (["--steps", "201"], "201 is above 200"),
        (["--samples", "1"], "1 is below 2, a standard error needs two"),
        (["--samples", "3000000"], "--samples 3000000: expected at most 2000000 with 15 steps"),
        (["--transition", "40", "--steps", "100"], "F=40 Q=1 R=1: with 100 steps the precision of float64"),
        (["--transition", "4", "--steps", "20"], "F=4 Q=1 R=1: with 20 steps the precision of float64"),
        (["surplus"], "unrecognized arguments: surplus"),
    ],
)
def test_a_wrong_argument_is_one_sentence(arguments, expected, capsys):
    assert main(["theorem", *arguments]) == 2

    output = capsys.readouterr().err
    assert output.startswith("forbes: ")
    assert expected in output
    assert output.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--transition", "0"], ["--transition", "1e-5"], ["--steps", "1"]], ids=" ".join)
def test_where_all_beliefs_are_the_same_no_difference_is_claimed(arguments, capsys):
    assert main(["theorem", *arguments, "--samples", "2"]) == 0

    output = " ".join(capsys.readouterr().out.split())
    assert "so there is nothing to rank" in output
    assert "opposite orders" not in output
