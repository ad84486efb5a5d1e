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
        without (sequence of float, optional): the same for plans without a target. Defaults to
            ``shares``.

    Raises:
        ValueError: a share lies outside [0, 1].

    Examples:
        >>> condition = ReturnCondition([1.0, 0.0]).fit(torch.tensor([1.0, 3.0, 5.0, 7.0]))
        >>> condition.wanted().tolist(), condition(torch.tensor([4.0])).tolist()
        ([7.0, 1.0], [0.0])
    """

    mean: Tensor
    deviation: Tensor
    quantiles: Tensor

    def __init__(self, shares: Sequence[float], without: Sequence[float] | None = None):
        super().__init__()
        self.shares = tuple(shares)
        self.without = self.shares if without is None else tuple(without)
        wrong = [share for share in self.shares + self.without if not 0.0 <= share <= 1.0]
        if wrong:
            raise ValueError(
                f"the share of returns below the wanted one is {wrong[0]}; use 0 to 1."
            )
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

    def wanted(self, target: bool = True) -> Tensor:
        """The returns asked for, [L], of plans with a target or without one."""
        shares = self.shares if target else self.without
        return torch.stack([self.quantiles[round(share * (QUANTILES - 1))] for share in shares])

    def forward(self, returns: Tensor) -> Tensor:
        """What networks are told of returns [B]."""
        return (returns - self.mean) / self.deviation
