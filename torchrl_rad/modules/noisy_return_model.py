"""The return of a plan that is still noisy, for guidance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.return_model import ReturnScale
from torchrl_rad.modules.temporal_unet import Encoder, TimeCode, check_length, check_sequence

__all__ = ["NoisyReturnModel"]


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
        self.action_dim, self.horizon = action_dim, horizon
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
