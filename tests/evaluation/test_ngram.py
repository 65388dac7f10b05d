"""n-grams of pen moves: the definition spelled out, and that what they give are probabilities."""

import math
from collections import Counter
from itertools import pairwise

import pytest
import torch

from forbes.data import Strokes
from forbes.evaluation.ngram import ORDERS, NGrams, fit_ngrams

LENGTH = 6
P001 = 26.12
"""What a χ² of 8 degrees of freedom exceeds with a probability of 0.001."""
NEIGHBOURS = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]


@pytest.fixture(name="source")
def source_fixture(strokes_file):
    return Strokes(path=str(strokes_file), validation=20)


def paths_of(source, split, length=LENGTH):
    """Pixels of every digit, cut at a length."""
    points, number = source.gather(split, torch.arange(source.size(split)), length)
    return [[(int(x), int(y)) for x, y in path[:n]] for path, n in zip(points, number, strict=True)]


def moves_of(path):
    steps = [(x - a, y - b) for (a, b), (x, y) in pairwise(path)]
    return [NEIGHBOURS.index(step) if step in NEIGHBOURS else "jump" for step in steps]


def smoothed(count, total, prior):
    return (count + 5 * prior) / (total + 5)


def move_probabilities(train, path, order):
    """The probability of each move after a path by the formula of the module, with counts in dictionaries."""
    moves = ["start"] * order + moves_of(path)
    found = dict.fromkeys([*range(8), "jump"], 1 / 9)
    for n in range(order + 1):
        context = tuple(moves[len(moves) - n :])
        seen = Counter()
        for training in train:
            known = ["start"] * n + moves_of(training)
            seen.update(known[t] for t in range(n, len(known)) if tuple(known[t - n : t]) == context)
        found = {move: smoothed(seen[move], seen.total(), prior) for move, prior in found.items()}
    return found


def jump_probability(train, pixel):
    jumps = Counter(p for t in train for p, move in zip(t[1:], moves_of(t), strict=True) if move == "jump")
    return smoothed(jumps[pixel], jumps.total(), 1 / 784)


def log_prob_slowly(train, path, order):
    first = Counter(training[0] for training in train)
    total = math.log(smoothed(first[path[0]], len(train), 1 / 784))
    for place, move in enumerate(moves_of(path), start=1):
        total += math.log(move_probabilities(train, path[:place], order)[move])
        if move == "jump":
            total += math.log(jump_probability(train, path[place]))
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


def probabilities_seen(train, path, order):
    """The probability of each move as one sees it: a jump that lands on a neighbour is a move there."""
    found = move_probabilities(train, path, order)
    (x, y), jump = path[-1], found["jump"]
    landed = {k: jump * jump_probability(train, (x + dx, y + dy)) for k, (dx, dy) in enumerate(NEIGHBOURS)}
    return {move: found[move] + landed[move] for move in range(8)} | {"jump": jump - sum(landed.values())}


@pytest.mark.parametrize("order", [0, 1, 3])
def test_points_are_drawn_with_the_probabilities_of_the_formula(order):
    source = Strokes(validation=59_900)  # a training split of 100 digits
    train = paths_of(source, "train", 30)
    path = paths_of(source, "test", 10)[0]
    expected, *others = (probabilities_seen(train, path, n) for n in (order, *({0, 1, 3} - {order})))
    assert sum(expected.values()) == pytest.approx(1)
    count = 20_000
    torch.manual_seed(0)

    drawn = NGrams(source, 30).complete(torch.tensor([path] * count, dtype=torch.uint8), 1, order)

    found = Counter(moves_of([path[-1], tuple(point)])[0] for point in drawn[:, -1].tolist())

    def chi_square(probabilities):
        return sum((found[move] - count * p) ** 2 / (count * p) for move, p in probabilities.items())

    assert chi_square(expected) < P001 < min(map(chi_square, others))


def test_what_is_drawn_begins_as_given_and_stays_in_the_image(source):
    corners = torch.tensor([[[0, 0]], [[27, 0]], [[0, 27]], [[27, 27]]], dtype=torch.uint8)
    torch.manual_seed(0)

    drawn = NGrams(source, LENGTH).complete(corners.repeat(50, 1, 1), 8, 2)

    assert drawn.shape == (200, 9, 2)
    assert drawn.dtype == torch.uint8
    assert torch.equal(drawn[:, :1], corners.repeat(50, 1, 1))
    assert drawn.max() < 28


def test_padding_counts_nothing(source):
    batch = source.decode(source.gather("test", torch.arange(12), 12))

    found = NGrams(source, 12).log_prob("test", 12)

    assert not batch.mask.all()
    assert all((values[batch.mask] < 0).all() and not values[~batch.mask].any() for values in found.values())


def hazard_slowly(train, steps):
    """The probability that a digit of at least so many steps has no more, with counts in lists."""
    ended, alive = (sum(each) for each in ([n == steps for n in train], [n >= steps for n in train]))
    return (ended + 5 * len(train) / sum(train)) / (alive + 5)


@pytest.mark.parametrize("points_per_step", [1, 2])
def test_an_observed_end_costs_what_its_step_tells(points_per_step):
    length, order = 40 // points_per_step, 3
    source = Strokes(validation=59_900, points_per_step=points_per_step)  # a training split of 100 digits
    observed = Strokes(validation=59_900, points_per_step=points_per_step, end="observed")
    steps, train = source.steps("test")[:100].tolist(), source.steps("train").tolist()

    found = [NGrams(each, length).log_prob("test", 100)[order] for each in (observed, source)]

    hazard = [hazard_slowly(train, steps) for steps in range(length)]
    survival = [math.prod(1 - h for h in hazard[:n]) for n in range(length + 1)]
    ends = {n: survival[n] * hazard[n] for n in range(length)}
    assert sum(ends.values()) + survival[-1] == pytest.approx(1)
    expected = [math.log(ends.get(n, survival[-1])) for n in steps]
    assert max(steps) > length > min(steps)
    torch.testing.assert_close((found[0] - found[1]).sum(1), torch.tensor(expected, dtype=torch.float64))
    after = torch.arange(length) > torch.tensor(steps)[:, None]
    assert not found[0][after].any()


def test_paths_end_as_often_as_their_step_tells_and_for_ever():
    source = Strokes(validation=59_900, end="observed")
    ngrams, count = NGrams(source, 60), 20_000
    path = torch.tensor([paths_of(source, "test", 36)[0]] * count, dtype=torch.uint8)
    torch.manual_seed(0)

    drawn = ngrams.complete(path, 2, 1)

    steps = path.shape[1]
    ended = (drawn[:, steps] == drawn[:, steps - 1]).all(-1)
    train = source.steps("train").tolist()
    hazard, wrong = (hazard_slowly(train, n) for n in (steps, steps - 4))
    z, power = ((ended.sum().item() - count * p) / math.sqrt(count * p * (1 - p)) for p in (hazard, wrong))
    assert abs(z) < 3.3 < abs(power)  # 0.001
    assert (drawn[ended, steps + 1] == drawn[ended, steps]).all()


def test_longer_contexts_tell_more_of_the_bundled_digits():
    found = fit_ngrams(Strokes(), 30).log_prob("test", 10_000)

    means = [found[order].sum(1).mean().item() for order in ORDERS]
    assert means == pytest.approx([-37.816, -36.326, -35.772, -35.185, -34.686], abs=5e-4)
