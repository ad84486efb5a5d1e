"""Where a target that is i steps away goes on a coarse grid of plan states."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["PLACEMENTS", "Placement", "TargetPlacement"]


class Placement(NamedTuple):
    """Where one level pins the target.

    Attributes:
        token: int64 [B], grid point, 1 to tokens - 1.
        time: int64 [B], the step whose state is pinned there, counted from the current state.
        active: bool [B], whether this level pins it at all.
    """

    token: Tensor
    time: Tensor
    active: Tensor


PLACEMENTS = ("shifted", "shifted_first", "nearest", "next")


class TargetPlacement:
    """Chooses grid point and state for a target ``step`` steps away, in training as in planning.

    - ``"shifted"``: the nearest grid point >= 1 of each level whose span holds the step; what is
      pinned there is the state of the target's own episode at that grid point's time.
    - ``"shifted_first"``: the same on the first level only.
    - ``"nearest"`` and ``"next"``: the target itself, at the nearest grid point or the next one, on
      each such level. The plan is then told to be there at another time than it can be (the paper
      read literally).

    A step below 1 counts as one at the first grid point; one beyond a level's span is not pinned
    there, and one beyond the horizon nowhere.

    Args:
        name (str): one of the above.

    Raises:
        ValueError: another name.

    Examples:
        >>> TargetPlacement("shifted")(torch.tensor([20, 70]), level=0, jump=32, tokens=5)
        Placement(token=tensor([1, 2]), time=tensor([32, 64]), active=tensor([True, True]))
        >>> TargetPlacement("next")(torch.tensor([20, 70]), level=1, jump=8, tokens=5)
        Placement(token=tensor([3, 4]), time=tensor([20, 70]), active=tensor([ True, False]))
    """

    def __init__(self, name: str):
        if name not in PLACEMENTS:
            raise ValueError(f"placement is {name!r}; expected one of {PLACEMENTS}.")
        self.name = name

    @property
    def first_only(self) -> bool:
        """Whether finer levels never hold a target, so that they are the backbone's."""
        return self.name == "shifted_first"

    def __call__(self, step: Tensor, level: int, jump: int, tokens: int) -> Placement:
        up = jump - 1 if self.name == "next" else jump // 2
        token = ((step + up) // jump).clamp(1, tokens - 1)
        active = step <= jump * (tokens - 1)
        if self.name == "shifted_first" and level > 0:
            active = torch.zeros_like(active)
        time = token * jump if self.name.startswith("shifted") else step
        return Placement(token, time, active)
