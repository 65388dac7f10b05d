"""The scale of returns, by which an actor's objective is divided (DreamerV3, Hafner et al., arXiv 2301.04104)."""

import torch
from torch import Tensor, nn

from forbes.distributed import mean_over_ranks

__all__ = ["ReturnScale"]


class ReturnScale(nn.Module):
    r"""A running range of the returns, so that one weight of the entropy fits tasks of any scale.

    .. math:: S = \max(1,\, \bar P_{95} - \bar P_5), \qquad \bar P \leftarrow d\,\bar P + (1 - d)\, P(V)

    P are percentiles of the returns of an update, and both averages start at 0. In training with several ranks P is the
    mean of theirs. Returns below a range of 1 are not scaled up, which would amplify noise where rewards are sparse.

    Args:
        decay: d; 0.99 in DreamerV3.
    """

    percentiles: Tensor

    def __init__(self, decay: float = 0.99) -> None:
        super().__init__()
        self.decay = decay
        self.register_buffer("percentiles", torch.zeros(2))

    def forward(self, returns: Tensor, valid: Tensor) -> Tensor:
        """Return S, a scalar; in training mode after the percentiles of these returns are taken in.

        Args:
            returns: V, `(M, H - 1)`.
            valid: True for trajectories that count, `(M,)`.
        """
        if self.training:
            counted = returns.detach().float().masked_fill(~valid[:, None], torch.nan)  # (M, H - 1)
            found = torch.stack([counted.nanquantile(at) for at in (0.05, 0.95)])  # (2,)
            self.percentiles.lerp_(mean_over_ranks(found), 1 - self.decay)
        low, high = self.percentiles.unbind()
        return (high - low).clamp(min=1)
