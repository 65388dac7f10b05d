"""Kinds of actions: an action and its indices are the same, and what cannot be is said."""

import itertools
import re

import numpy as np
import pytest

from forbes.factors import (
    are_one_hot,
    as_discrete,
    as_plain,
    discrete_of,
    factor_sizes,
    problem_of_choices,
    problem_of_discrete,
    to_index,
    to_one_hot,
)

SIZES = [(4,), (3, 2), (2, 2, 2), (1, 5, 2)]


@pytest.mark.parametrize("sizes", SIZES)
def test_every_choice_is_one_action_and_back(sizes):
    every = np.array([*itertools.product(*map(range, sizes))])  # (N, F)

    action = to_one_hot(every, sizes)

    assert action.shape == (np.prod(sizes), sum(sizes))
    assert action.dtype == np.float32
    assert len(np.unique(action, axis=0)) == np.prod(sizes)
    assert are_one_hot(action, sizes)
    np.testing.assert_array_equal(to_index(action, sizes), every)
    np.testing.assert_array_equal(to_one_hot(every[0], sizes), action[0])


@pytest.mark.parametrize("sizes", SIZES)
def test_one_factor_is_a_one_hot_vector(sizes):
    discrete = discrete_of(np.array(sizes))

    assert discrete == (sizes if len(sizes) > 1 else True)
    assert factor_sizes(discrete, sum(sizes)) == sizes
    assert as_plain(discrete) == ([*sizes] if len(sizes) > 1 else True)
    assert as_discrete(as_plain(discrete)) == discrete
    assert problem_of_discrete(discrete, sum(sizes)) == ""
    assert (discrete_of(()), factor_sizes(False, 3)) == (False, ())


@pytest.mark.parametrize("discrete", [1, None, "x", (3,), (), (3, 3), (6, -1), (5, 0), (2.5, 2.5), [3, 2]])
def test_other_kinds_are_one_sentence(discrete):
    assert "expected true or false, or the sizes of at least two factors" in problem_of_discrete(discrete, 5)


def test_an_action_that_is_no_choice_is_named():
    action = to_one_hot(np.array([[0, 0], [2, 1], [1, 1]]), (3, 2))
    action[0] = 0
    assert problem_of_choices(action, (3, 2)) == problem_of_choices(action, False) == ""

    action[2, 3:] = 0.5, 0.5

    sentence = "its action at step 2 is .*, expected one-hot vectors of 3 and 2 numbers, one after the other"
    assert re.match(sentence, problem_of_choices(action, (3, 2)))
    assert problem_of_choices(action, True).endswith("expected a one-hot vector")
