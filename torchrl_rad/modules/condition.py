"""The return that a plan is asked to have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor, nn

from torchrl_rad.modules.return_model import check_returns

__all__ = ["ReturnCondition"]

QUANTILES = 1001  # of the recorded returns, kept so that another share can be asked for


class ReturnCondition(nn.Module):
    """Tells networks in training the return of each recorded window, in planning a wanted one.

    It is how DiffuserLite (Dong et al., 2024) plans for locomotion: of data by good and bad
    policies a network that is told nothing plans what is common, one that is told a high return
    what led to it. Each level may be told another one: the finer ones plan the way between two
    states that are settled, and told a high return they hurry on it.

    Args:
        shares (sequence of float): of the recorded returns that lie below the one wanted, in
            [0, 1], one for each level; can be set anew.

    Raises:
        ValueError: a share lies outside [0, 1].

    Examples:
        >>> condition = ReturnCondition([1.0, 0.0]).fit(torch.tensor([1.0, 3.0, 5.0, 7.0]))
        >>> condition.wanted.tolist(), condition(torch.tensor([4.0])).tolist()
        ([7.0, 1.0], [0.0])
        >>> bool(condition()[0] == condition(torch.tensor([7.0])))
        True
    """

    mean: Tensor
    deviation: Tensor
    quantiles: Tensor

    def __init__(self, shares: Sequence[float]):
        super().__init__()
        wrong = [share for share in shares if not 0.0 <= share <= 1.0]
        if wrong:
            raise ValueError(
                f"the share of returns below the wanted one is {wrong[0]}; use 0 to 1."
            )
        self.shares = tuple(shares)
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("deviation", torch.ones(()))
        self.register_buffer("quantiles", torch.zeros(QUANTILES))

    def fit(self, returns: Tensor) -> Self:
        """Takes scale and quantiles from recorded returns [T].

        Raises:
            ValueError: there are none, or they hold NaN or Inf.
        """
        check_returns(returns)
        ordered = returns.flatten().float().sort().values  # quantile() takes 16 million at most
        places = torch.linspace(0, len(ordered) - 1, QUANTILES, dtype=torch.float64).round().long()
        self.quantiles.copy_(ordered[places])
        self.mean.fill_(ordered.double().mean())
        self.deviation.fill_(max(float(ordered.double().std(correction=0)), 1e-6))
        return self

    @property
    def wanted(self) -> Tensor:
        """The returns asked for, [L]."""
        return torch.stack([self.quantiles[round(s * (QUANTILES - 1))] for s in self.shares])

    def forward(self, returns: Tensor | None = None) -> Tensor:
        """What networks are told: of returns [B], or of those wanted, one a level."""
        returns = self.wanted if returns is None else returns
        return (returns - self.mean) / self.deviation
