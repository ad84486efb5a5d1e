"""Inverse dynamics: the action that leads from one state to the next."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_rad.modules.normalizer import Normalizer

__all__ = ["InverseDynamics", "inverse_dynamics_actor"]


class InverseDynamics(nn.Module):
    """MLP from (state, next state) to an action within bounds.

    It is f_a of RAD, section "Planning Module".

    It sees the state and the change of state, each standardised: the change over one step is small
    against the state.

    Args:
        normalizer (Normalizer): of states.
        difference (Normalizer): of (next state - state).
        action_dim (int): A.
        width (int, optional): Defaults to ``256``.
        bound (float, optional): actions lie in [-bound, bound]. Defaults to ``1.0``.

    Examples:
        >>> net = InverseDynamics(Normalizer.identity(4), Normalizer.identity(4), action_dim=2)
        >>> net(torch.zeros(3, 4), torch.ones(3, 4)).shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        normalizer: Normalizer,
        difference: Normalizer,
        action_dim: int,
        width: int = 256,
        bound: float = 1.0,
    ):
        super().__init__()
        self.normalizer, self.difference, self.bound = normalizer, difference, bound
        self.net = nn.Sequential(
            nn.Linear(2 * len(normalizer.mean), width), nn.GELU(),
            nn.Linear(width, width), nn.GELU(),
            nn.Linear(width, action_dim), nn.Tanh(),
        )  # fmt: skip

    def forward(self, state: Tensor, following: Tensor) -> Tensor:
        """Action [*B, A] from states [*B, S] in raw units."""
        change = self.difference(following - state)
        return self.bound * self.net(torch.cat([self.normalizer(state), change], -1))


def inverse_dynamics_actor(
    inverse_dynamics: InverseDynamics,
    in_keys: Sequence[NestedKey] = ("observation", ("next", "observation")),
    out_keys: Sequence[NestedKey] = ("action",),
) -> TensorDictModule:
    """Inverse dynamics as the actor that :class:`torchrl.objectives.BCLoss` trains."""
    return TensorDictModule(inverse_dynamics, in_keys=list(in_keys), out_keys=list(out_keys))
