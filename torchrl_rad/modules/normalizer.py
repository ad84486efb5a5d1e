"""States in and out of the networks' units."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["Normalizer"]


class Normalizer(nn.Module):
    """Standardises states by a fixed mean and deviation, saved with the module that holds it.

    Args:
        mean (Tensor): [S].
        deviation (Tensor): [S]; entries of 0 (constant features) count as 1.

    Examples:
        >>> normalizer = Normalizer.of(torch.tensor([[0.0, 7.0], [2.0, 7.0]]))
        >>> normalizer(torch.tensor([2.0, 7.0]))
        tensor([1., 0.])
        >>> normalizer.inverse(torch.tensor([1.0, 0.0]))
        tensor([2., 7.])
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, mean: Tensor, deviation: Tensor):
        super().__init__()
        self.register_buffer("mean", mean.float())
        self.register_buffer("deviation", torch.where(deviation > 0, deviation, 1.0).float())

    @classmethod
    def of(cls, states: Tensor) -> Normalizer:
        """From recorded states [T, S]; raises ValueError if they hold NaN or Inf."""
        if not states.isfinite().all():
            raise ValueError(
                "states with NaN or Inf give no normaliser; torchrl_rad.data.report says where "
                "they are."
            )
        states = states.double()
        return cls(states.mean(0), states.std(0, correction=0))

    @classmethod
    def identity(cls, size: int) -> Normalizer:
        """Leaves states of ``size`` entries as they are; a saved normaliser is loaded into it."""
        return cls(torch.zeros(size), torch.ones(size))

    def forward(self, states: Tensor) -> Tensor:
        return (states - self.mean) / self.deviation

    def inverse(self, states: Tensor) -> Tensor:
        """From standardised to raw units."""
        return states * self.deviation + self.mean
