"""n-grams of pen moves: the definition spelled out, and that what they give are probabilities."""

import math
from collections import Counter
from itertools import pairwise

import pytest
import torch

from forbes.data import Strokes
from forbes.evaluation.ngram import ORDERS, NGrams, fit_ngrams

LENGTH = 6
NEIGHBOURS = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]


@pytest.fixture(name="source")
def source_fixture(strokes_file):
    return Strokes(path=str(strokes_file), validation=20)


def paths_of(source, split):
    """Pixels of every digit, cut at LENGTH."""
    points, number = source.gather(split, torch.arange(source.size(split)), LENGTH)
    return [[(int(x), int(y)) for x, y in path[:n]] for path, n in zip(points, number, strict=True)]


def moves_of(path):
    steps = [(x - a, y - b) for (a, b), (x, y) in pairwise(path)]
    return [NEIGHBOURS.index(step) if step in NEIGHBOURS else "jump" for step in steps]


def smoothed(count, total, prior):
    return (count + 5 * prior) / (total + 5)


def log_prob_slowly(train, path, order):
    """The formula of the module, with counts in dictionaries."""
    first = Counter(training[0] for training in train)
    jumps = Counter(p for t in train for p, move in zip(t[1:], moves_of(t), strict=True) if move == "jump")
    total = math.log(smoothed(first[path[0]], len(train), 1 / 784))
    moves = ["start"] * order + moves_of(path)
    for place, move in enumerate(moves[order:], start=order):
        probability = 1 / 9
        for n in range(order + 1):
            context = tuple(moves[place - n : place])
            seen = Counter()
            for training in train:
                known = ["start"] * n + moves_of(training)
                seen.update(known[t] for t in range(n, len(known)) if tuple(known[t - n : t]) == context)
            probability = smoothed(seen[move], seen.total(), probability)
        total += math.log(probability)
        if move == "jump":
            total += math.log(smoothed(jumps[path[place - order + 1]], jumps.total(), 1 / 784))
    return total


@pytest.mark.parametrize("order", ORDERS)
def test_log_prob_is_the_formula(source, order):
    train, test = (paths_of(source, split) for split in ("train", "test"))

    found = NGrams(source, LENGTH).log_prob("test", len(test))[order].sum(1)

    expected = [log_prob_slowly(train, path, order) for path in test]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64))


def test_a_step_of_several_points_adds_up_their_log_probs(source):
    twos = Strokes(path=source.path, validation=20, points_per_step=2)

    one, two = (NGrams(each, length).log_prob("test", 12) for each, length in ((source, 6), (twos, 3)))

    for order in ORDERS:
        torch.testing.assert_close(one[order].unflatten(1, (3, 2)).sum(-1), two[order])


def test_padding_counts_nothing(source):
    batch = source.decode(source.gather("test", torch.arange(12), 12))

    found = NGrams(source, 12).log_prob("test", 12)

    assert not batch.mask.all()
    assert all((values[batch.mask] < 0).all() and not values[~batch.mask].any() for values in found.values())


def test_longer_contexts_tell_more_of_the_bundled_digits():
    found = fit_ngrams(Strokes(), 30).log_prob("test", 10_000)

    means = [found[order].sum(1).mean().item() for order in ORDERS]
    assert means == pytest.approx([-37.816, -36.326, -35.772, -35.185, -34.686], abs=5e-4)
