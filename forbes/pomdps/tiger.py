"""The tiger problem: listen at two doors, one of which hides a tiger."""

import torch
from torch import Tensor

from forbes.errors import ForbesError
from forbes.pomdps.hmm import FiniteProcess

__all__ = ["Tiger"]

LISTEN, OPEN_LEFT, OPEN_RIGHT = range(3)


class Tiger(FiniteProcess):
    r"""A tiger behind the left or the right door; listening reveals the door with probability p.

    Opening a door puts the tiger behind a random door, and the observation is then uninformative. Kaelbling, Littman
    and Cassandra (1998); p = 0.85.

    In that paper the observation depends on the action. Here the state includes whether the action was to listen, so
    that the observation depends only on the state: (left, heard), (right, heard), (left, not heard), (right, not
    heard). Nothing is heard before the first action. After l times "left" and r times "right" since the last opening:

    .. math:: P(\text{left}) = \frac{1}{1 + ((1 - p) / p)^{\,l - r}}

    Actions are listen, open left, open right; those of `sample` listen with probability 0.8.

    Args:
        accuracy: probability p that the correct door is heard.

    Example:
        >>> process = forbes.Tiger()
        >>> states, observations, actions = process.sample(4, 10, torch.Generator().manual_seed(0))
        >>> process.exact_filter(observations, actions).log_likelihood.shape
        torch.Size([4])
    """

    def __init__(self, accuracy: float = 0.85) -> None:
        if not 0 <= accuracy <= 1:
            raise ForbesError(f"Tiger: accuracy is {accuracy}, expected a probability. Choose one in [0, 1]")
        self.accuracy = accuracy
        stays = torch.eye(2, dtype=torch.float64)
        anywhere = torch.full((2, 2), 0.5, dtype=torch.float64)
        nowhere = torch.zeros(2, 2, dtype=torch.float64)
        listened = torch.cat((stays, nowhere), 1).repeat(2, 1)  # (4, 4), transitions to the states (…, heard)
        opened = torch.cat((nowhere, anywhere), 1).repeat(2, 1)  # (4, 4)
        heard = accuracy * stays + (1 - accuracy) * (1 - stays)  # (2, 2)
        super().__init__(
            initial=torch.tensor([0.0, 0.0, 0.5, 0.5], dtype=torch.float64),
            transition=torch.stack((listened, opened, opened)),  # (3, 4, 4)
            emission=torch.cat((heard, anywhere)),  # (4, 2)
            policy=torch.tensor([0.8, 0.1, 0.1], dtype=torch.float64),
        )

    def reward(self, state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        """See `Process.reward`: -1 for listening, -100 for the tiger's door, 10 for the other, as in the paper."""
        left = state.argmax(-1) % 2 == 0  # (*), the tiger
        door = action.argmax(-1)  # (*)
        opened = torch.where(left == (door == OPEN_LEFT), -100.0, 10.0)
        return torch.where(door == LISTEN, -1.0, opened).to(state)
