"""States in and out of the networks' units."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

__all__ = ["Normalizer"]


class Normalizer(nn.Module):
    """Standardises states by a fixed mean and deviation, saved with the module that holds it.

    Args:
        mean (Tensor): [S].
        deviation (Tensor): [S]; where it is 0, or lost in the rounding of the mean (constant
            features), it counts as 1.

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
        varies = deviation > 1e-6 * mean.abs()
        self.register_buffer("deviation", torch.where(varies, deviation, 1.0).float())

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

    def read(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """The states [*B, S] that ``tensordict`` holds under ``key``, in this module's dtype.

        Raises:
            KeyError: there is no such entry.
            ValueError: it has another width, is on another device or is not floating point.
        """
        states = tensordict.get(key, None)
        if states is None:
            held = sorted(map(str, tensordict.keys(True, True)))
            raise KeyError(f"{key!r} is missing in the tensordict, which holds {held}.")
        if states.ndim == 0 or states.shape[-1] != len(self.mean):
            raise ValueError(
                f"{key!r} is {tuple(states.shape)}; expected states of {len(self.mean)} entries, "
                "as the normaliser has."
            )
        if not states.is_floating_point() or states.device != self.mean.device:
            raise ValueError(
                f"{key!r} is {states.dtype} on {states.device}; expected floating point on "
                f"{self.mean.device}: convert or move it."
            )
        return states.to(self.mean.dtype)

    def inverse(self, states: Tensor) -> Tensor:
        """From standardised to raw units."""
        return states * self.deviation + self.mean
