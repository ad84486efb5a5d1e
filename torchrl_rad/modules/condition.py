"""The return that a plan is asked to have."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn

from torchrl_rad.modules.return_model import check_returns

__all__ = ["ReturnCondition"]


class ReturnCondition(nn.Module):
    """Tells networks in training the return of each recorded window, in planning a high one.

    It is how DiffuserLite (Dong et al., 2024) plans for locomotion: of data by good and bad
    policies a network that is told nothing plans what is common, one that is told a high return
    what led to it.

    Args:
        share (float): of the recorded returns that lie below the one wanted, in [0, 1].

    Raises:
        ValueError: the share lies outside [0, 1].

    Examples:
        >>> condition = ReturnCondition(share=1.0).fit(torch.tensor([1.0, 3.0, 5.0, 7.0]))
        >>> float(condition.wanted), condition(torch.tensor([4.0])).tolist()
        (7.0, [0.0])
        >>> bool(condition() == condition(torch.tensor([7.0])))
        True
    """

    mean: Tensor
    deviation: Tensor
    wanted: Tensor

    def __init__(self, share: float):
        super().__init__()
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"the share of returns below the wanted one is {share}; use 0 to 1.")
        self.share = share
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("deviation", torch.ones(()))
        self.register_buffer("wanted", torch.zeros(()))

    def fit(self, returns: Tensor) -> Self:
        """Takes the scale, and the return that is wanted, from recorded returns [T].

        Raises:
            ValueError: there are none, or they hold NaN or Inf.
        """
        check_returns(returns)
        ordered = returns.flatten().float().sort().values  # quantile() takes 16 million at most
        self.wanted.fill_(ordered[round(self.share * (len(ordered) - 1))])
        self.mean.fill_(ordered.double().mean())
        self.deviation.fill_(max(float(ordered.double().std(correction=0)), 1e-6))
        return self

    def forward(self, returns: Tensor | None = None) -> Tensor:
        """What networks are told: of returns [B], or of the one wanted, [1]."""
        returns = self.wanted[None] if returns is None else returns
        return (returns - self.mean) / self.deviation
