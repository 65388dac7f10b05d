"""The tiger: its belief counts what was heard since a door was opened."""

import pytest
import torch

from forbes.errors import ForbesError
from forbes.pomdps import Tiger
from forbes.pomdps.tiger import LISTEN


@pytest.mark.parametrize("accuracy", [0.5, 0.85, 1.0])
def test_the_belief_counts_sounds_since_the_last_opened_door(accuracy):
    _, observation, action = Tiger(accuracy).sample(60, 12, torch.Generator().manual_seed(0))

    exact = Tiger(accuracy).exact_filter(observation, action)
    left = exact.belief.mean[..., [0, 2]].sum(-1)  # (B, T)

    for row in range(60):
        odds, chance = 1.0, 0.5  # of the left door; of what is heard next
        for time in range(12):
            heard_left = bool(observation[row, time, 0])
            if time > 0 and action[row, time, LISTEN]:
                share = odds / (1 + odds) if odds < float("inf") else 1.0
                says_left = share * accuracy + (1 - share) * (1 - accuracy)
                chance = says_left if heard_left else 1 - says_left
                right, wrong = (accuracy, 1 - accuracy) if heard_left else (1 - accuracy, accuracy)
                odds = odds * right / wrong if wrong else float("inf")
            else:
                odds, chance = 1.0, 0.5
            expected = odds / (1 + odds) if odds < float("inf") else 1.0
            assert left[row, time].item() == pytest.approx(expected, abs=1e-12)
            assert exact.step_log_likelihood[row, time].exp().item() == pytest.approx(chance, abs=1e-12)


def test_an_accuracy_is_a_probability():
    with pytest.raises(ForbesError, match=r"^Tiger: accuracy is 1.2, expected a probability. Choose one in"):
        Tiger(1.2)
