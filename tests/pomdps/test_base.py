"""What every process promises: it is what its densities say, and its belief is exact. A new one is one line here."""

import math
from functools import partial

import pytest
import torch

from forbes.errors import ForbesError
from forbes.pomdps import (
    LightDark,
    LinearGaussian,
    MirrorSensor,
    MountainHike,
    Process,
    Tiger,
    TMaze,
    Ungm,
)
from forbes.pomdps.distributions import PointMass
from forbes.pomdps.hmm import FiniteProcess

# Coarse grids: what they get wrong is far below what these tests resolve.
PROCESSES = {
    "linear-gaussian": LinearGaussian,
    "linear-gaussian-hard": partial(LinearGaussian, transition_variance=0.1),
    "linear-gaussian-stationary": partial(LinearGaussian, 0.9, 0.3, 0.5),
    "mountain-hike": MountainHike,
    "mountain-hike-multi": partial(MountainHike, "multi", observation_std=1.5),
    "mirror-sensor": partial(MirrorSensor, cells=401),
    "ungm": partial(Ungm, cells=451),
    "light-dark": partial(LightDark, cells_per_step=20),
    "t-maze": partial(TMaze, length=3),
    "t-maze-stochastic": partial(TMaze, length=3, stochasticity=0.2),
    "tiger": Tiger,
}


@pytest.fixture(params=PROCESSES, name="process")
def process_fixture(request) -> Process:
    return PROCESSES[request.param]()


def draw(process, sequences, length, seed=0):
    return process.sample(sequences, length, torch.Generator().manual_seed(seed))


def assert_mean_is_zero(values):
    """Within 5 standard errors, values `(N, ...)` independent over N.

    A mean of 0 exceeds them with probability 6e-7, one of the 500 comparisons of this file with 3e-4.
    """
    values = values.reshape(len(values), -1)  # (N, M)
    assert (values.mean(0).abs() <= 5 * values.std(0) / math.sqrt(len(values)) + 1e-12).all()


def test_trajectories_have_the_dimensions_of_the_process(process):
    trajectories = draw(process, 3, 5)

    for values, dim in zip(trajectories, (process.state_dim, process.observation_dim, process.action_dim), strict=True):
        assert values.shape == (3, 5, dim)
        assert values.dtype == torch.float64
    assert not trajectories.action[:, 0].any()


def test_trajectories_are_a_function_of_the_generator(process):
    first, again, other = draw(process, 4, 6), draw(process, 4, 6), draw(process, 4, 6, seed=1)

    assert all(map(torch.equal, first, again))
    assert not torch.equal(first.observation, other.observation)


def test_a_draw_has_the_density_that_is_given(process):
    r"""Stein: :math:`E\,\partial_d \log p(x) = 0` and :math:`E\,x_d \partial_d \log p(x) = -1`; or a table's mean."""
    state, observation, action = draw(process, 4000, 3)
    parts = [
        (process.initial(state), state[:, 0]),
        (process.transition(state[:, :-1], action[:, 1:]), state[:, 1:]),
        (process.emission(state), observation),
    ]
    for distribution, value in parts:
        if isinstance(distribution, PointMass):
            assert not distribution.log_prob(value).any()
            assert distribution.log_prob(value + 1).isneginf().all()
        elif isinstance(process, FiniteProcess):
            assert_mean_is_zero(value - distribution.mean)
        else:
            value = value.clone().requires_grad_()
            (slope,) = torch.autograd.grad(distribution.log_prob(value).sum(), value)
            assert_mean_is_zero(slope)
            assert_mean_is_zero(1 + slope * value.detach())


def test_the_true_state_is_a_draw_of_the_exact_belief(process):
    """Given o_1:t both have the same law, so any statistic of both has the same mean: simulation-based calibration."""
    length = 8
    state, observation, action = draw(process, 1000, length)

    belief = process.exact_filter(observation, action).belief
    twin = belief.sample(1, torch.Generator().manual_seed(1))[0]  # (B, T, D)

    # Over all steps, and at the last one, for a filter that errs late.
    score = belief.log_prob(state) - belief.log_prob(twin)  # (B, T)
    assert_mean_is_zero(score.mean(1))
    assert_mean_is_zero(score[:, -1])
    assert_mean_is_zero((state - twin).mean(1))
    assert_mean_is_zero((state.square() - twin.square()).mean(1))
    assert_mean_is_zero((state - belief.mean).mean(1))
    assert_mean_is_zero(((state - belief.mean).square() - belief.variance).mean(1))
    assert_mean_is_zero(((state - belief.mean) * observation.mean(-1, keepdim=True)).mean(1))
    if belief.entropy is not None:
        assert_mean_is_zero((belief.log_prob(state) + belief.entropy).mean(1))


def test_the_filter_of_a_prefix_is_the_prefix_of_the_filter(process):
    state, observation, action = draw(process, 3, 6)

    whole = process.exact_filter(observation, action)
    prefix = process.exact_filter(observation[:, :4], action[:, :4])

    torch.testing.assert_close(prefix.step_log_likelihood, whole.step_log_likelihood[:, :4])
    torch.testing.assert_close(prefix.belief.mean, whole.belief.mean[:, :4])
    torch.testing.assert_close(prefix.belief.log_prob(state[:, :4]), whole.belief.log_prob(state)[:, :4])


def test_a_batch_of_one_is_its_row_of_the_batch(process):
    state, observation, action = draw(process, 3, 6)

    whole = process.exact_filter(observation, action)
    row = process.exact_filter(observation[1:2], action[1:2])

    torch.testing.assert_close(row.step_log_likelihood, whole.step_log_likelihood[1:2])
    torch.testing.assert_close(row.belief.mean, whole.belief.mean[1:2])
    torch.testing.assert_close(row.belief.variance, whole.belief.variance[1:2])
    torch.testing.assert_close(row.belief.log_prob(state[1:2]), whole.belief.log_prob(state)[1:2])


def test_densities_broadcast_and_keep_the_dtype(process):
    state, observation, action = (values.float() for values in draw(process, 5, 2))
    particles = state[:, 0].expand(7, -1, -1)  # (7, 5, D)

    moved = process.log_transition(state[:, 1], particles, action[:, 1])
    for log_density in (process.log_initial(particles), moved, process.log_observation(observation[:, 0], particles)):
        assert log_density.shape == (7, 5)
        assert log_density.dtype == torch.float32


def broken(values, *place, value=math.nan):
    values = values.clone()
    values[place] = value
    return values


def test_what_cannot_be_filtered_is_one_clear_sentence(process):
    _, observation, action = draw(process, 3, 4)
    wrong = {
        r"the observation has shape \(3, 4\), expected \(B, T, .*Reshape": (observation[..., 0], action),
        r"the observation has shape \(3, 4, .*\), expected \(B, T": (observation.repeat(1, 1, 2), action),
        r"the action has shape .*, expected \(B, T": (observation, action.new_zeros(3, 4, process.action_dim + 1)),
        r"the observation has shape \(3, 0, .*T at least 1": (observation[:, :0], action[:, :0]),
        r"the observation of sequence 1 at step 2 is nan": (broken(observation, 1, 2), action),
        r"the observation of sequence 2 at step 0 is inf": (broken(observation, 2, 0, value=math.inf), action),
        r"\(3, 4\) and \(3, 3\), expected the same": (observation, action[:, :3]),
    }
    if process.action_dim:
        wrong[r"the action of sequence 0 at step 3 is nan"] = (observation, broken(action, 0, 3))
        wrong[r"the first action is not zero"] = (observation, broken(action, 0, 0, value=1.0))
    for message, arguments in wrong.items():
        with pytest.raises(ForbesError, match=f"^{type(process).__name__}: .*{message}") as error:
            process.exact_filter(*arguments)
        assert "\n" not in str(error.value)


def test_at_least_one_sequence_of_one_step_is_drawn(process):
    with pytest.raises(ForbesError, match="sequences is 0, expected more than 0"):
        draw(process, 0, 3)
    with pytest.raises(ForbesError, match="length is 0, expected more than 0"):
        draw(process, 3, 0)
    assert draw(process, 1, 1).observation.shape == (1, 1, process.observation_dim)
