"""The return of a plan, from its coarse states."""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn

from torchrl_rad.modules.normalizer import Normalizer

__all__ = ["ReturnModel", "ReturnScale"]


def check_returns(returns: Tensor) -> None:
    """Raises ValueError where there are no returns, or NaN or Inf among them."""
    if returns.numel() == 0 or not returns.isfinite().all():
        raise ValueError(f"expected finite returns, got {returns.numel()} with NaN or Inf.")


class ReturnScale(nn.Module):
    """What return models share: their normaliser, and the unit in which their networks predict.

    Args:
        normalizer (Normalizer): of states.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, normalizer: Normalizer):
        super().__init__()
        self.normalizer = normalizer
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("deviation", torch.ones(()))

    def reset_parameters_recursive(self) -> None:
        """Draws new weights, as a TensorDictModule does; the scale stays."""
        for module in self.modules():
            if module is not self and hasattr(module, "reset_parameters"):
                module.reset_parameters()  # type: ignore[operator]

    def fit_scale(self, returns: Tensor) -> Self:
        """Takes mean and deviation of recorded returns as the unit of the network's output.

        Raises:
            ValueError: there are none, or they hold NaN or Inf.
        """
        check_returns(returns)
        self.mean.fill_(float(returns.mean()))
        self.deviation.fill_(max(float(returns.std(correction=0)), 1e-6))
        return self


class ReturnModel(ReturnScale):
    """MLP that predicts C(tau) of a plan from the states on its first level's grid.

    It is J of RAD, equation "loss:g".

    Args:
        normalizer (Normalizer): of states.
        tokens (int): n, grid states of a plan.
        width (int, optional): Defaults to ``256``.

    Examples:
        >>> model = ReturnModel(Normalizer.identity(4), tokens=5)
        >>> model(torch.zeros(3, 5, 4)).shape
        torch.Size([3])
    """

    def __init__(self, normalizer: Normalizer, tokens: int, width: int = 256):
        super().__init__(normalizer)
        self.tokens = tokens
        self.net = nn.Sequential(
            nn.Linear(tokens * len(normalizer.mean), width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, 1),
        )  # fmt: skip

    def standardised(self, states: Tensor) -> Tensor:
        """Predicted return [*B] of raw states [*B, n, S], in units of the deviation."""
        return self.net(self.normalizer(states).flatten(-2)).squeeze(-1)

    def forward(self, states: Tensor) -> Tensor:
        return self.standardised(states) * self.deviation + self.mean
