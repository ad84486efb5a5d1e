"""The return of a plan that is still noisy, for guidance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.return_model import ReturnScale
from torchrl_rad.modules.temporal_unet import Encoder, TimeCode, check_length, check_sequence

__all__ = ["NoisyReturnModel", "PlainReturnModel", "StepReturns"]


class NoisyReturnModel(ReturnScale):
    """Predicts C(tau) from noisy states and actions: the first half of a :class:`TemporalUNet`.

    It is J of RAD at diffusion step k (section "Planning Module"). It is shown what the planner is
    shown: known entries are clean, and a mask says which they are.

    Args:
        normalizer (Normalizer): of states.
        action_dim (int): A; actions are used as they are.
        horizon (int): H, steps of a plan.
        width (int, optional): as of the U-Net; half its width makes a gradient cheaper than a call
            of it. Defaults to ``16``.
        multiples (sequence of int, optional): of ``width``. Defaults to ``(1, 2, 4, 8)``.

    Raises:
        ValueError: the horizon cannot be halved as often as there are resolutions.

    Examples:
        >>> model = NoisyReturnModel(Normalizer.identity(4), action_dim=2, horizon=32)
        >>> model(torch.zeros(3, 32, 6), torch.zeros(3, 32, 1, dtype=torch.bool)).shape
        torch.Size([3])
    """

    def __init__(
        self,
        normalizer: Normalizer,
        action_dim: int,
        horizon: int,
        width: int = 16,
        multiples: Sequence[int] = (1, 2, 4, 8),
    ):
        check_length(horizon, len(multiples))
        super().__init__(normalizer)
        self.action_dim, self.horizon, self.multiples = action_dim, horizon, tuple(multiples)
        self.entries = len(normalizer.mean) + action_dim
        self.time = TimeCode(width)
        self.encoder = Encoder(self.entries + 1, width, multiples)
        flat = width * multiples[-1] * (horizon >> (len(multiples) - 1))
        self.mix = nn.Linear(flat + width, 8 * width)
        self.head = nn.Sequential(nn.Mish(), nn.Linear(8 * width, 1))

    def normalised(self, plans: Tensor) -> Tensor:
        """Plans [*B, H, S + A] in raw units as :meth:`standardised` reads them."""
        states, actions = plans.split([self.entries - self.action_dim, self.action_dim], -1)
        return torch.cat([self.normalizer(states), actions], -1)

    def standardised(self, plans: Tensor, mask: Tensor, time: Tensor) -> Tensor:
        """Predicted return [B] in units of the deviation.

        Args:
            plans (Tensor): [B, H, S + A], noisy, normalised.
            mask (Tensor): bool [B, H, 1], True where the state is known.
            time (Tensor): of the process, [B] or [1].
        """
        check_sequence(plans, mask, self.entries, 1)
        if plans.shape[1] != self.horizon:
            raise ValueError(
                f"the plans have {plans.shape[1]} steps; this return model was built for "
                f"{self.horizon}."
            )
        code = self.time(time)
        x = torch.cat([plans, mask.to(plans.dtype)], -1).transpose(1, 2)
        low = self.encoder(x, code)[-1].flatten(1)
        return self.head(self.mix(torch.cat([low, code.expand(len(low), -1)], -1))).squeeze(-1)

    def forward(self, plans: Tensor, mask: Tensor) -> Tensor:
        """Return [B] of finished plans [B, H, S + A] in raw units."""
        time = torch.zeros(1, device=plans.device)
        predicted = self.standardised(self.normalised(plans), mask, time)
        return predicted * self.deviation + self.mean


class StepReturns(Protocol):
    """A noisy return model at the times of a sampler."""

    def value(self, x: Tensor, mask: Tensor, step: int) -> Tensor:
        """Predicted return [B] of normalised plans [B, H, D], in units of the deviation."""

    def gradient(self, x: Tensor, mask: Tensor, step: int) -> Tensor:
        """Of that return with respect to ``x``."""


class PlainReturnModel:
    """Calls a return model as it is, and autograd.

    Args:
        model (nn.Module): has ``standardised``, as :class:`NoisyReturnModel`.
        times (sequence of float): of the process, one a step.

    Examples:
        >>> model = NoisyReturnModel(Normalizer.identity(2), 1, 8, width=8, multiples=(1, 2))
        >>> plain, mask = PlainReturnModel(model, [1.0]), torch.zeros(3, 8, 1, dtype=torch.bool)
        >>> plain.gradient(torch.randn(3, 8, 3), mask, 0).shape
        torch.Size([3, 8, 3])
    """

    def __init__(self, model: nn.Module, times: Sequence[float]):
        self.model, self.times = model, times

    def value(self, x: Tensor, mask: Tensor, step: int) -> Tensor:
        time = torch.full((1,), self.times[step], device=x.device)
        return self.model.standardised(x, mask, time)  # type: ignore[operator]

    def gradient(self, x: Tensor, mask: Tensor, step: int) -> Tensor:
        # tensors of inference mode cannot be differentiated; copies made outside of it can
        with torch.inference_mode(False), torch.enable_grad():
            x = x.clone().requires_grad_()
            return torch.autograd.grad(self.value(x, mask.clone(), step).sum(), x)[0]
