"""The levels of a coarse-to-fine plan."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Level", "plan_levels", "plan_times"]


class Level(NamedTuple):
    """One level of a plan: ``tokens`` states, ``jump`` steps apart."""

    jump: int
    tokens: int

    @property
    def span(self) -> int:
        """Steps from the first state to the last one."""
        return self.jump * (self.tokens - 1)

    def free(self, number: int) -> slice:
        """Tokens that are to be planned: not the first, nor on finer levels the last."""
        return slice(1, self.tokens if number == 0 else self.tokens - 1)


def plan_levels(horizon: int, jumps: Sequence[int]) -> list[Level]:
    """The levels of a plan of ``horizon`` states: each one refines the first jump of the one above.

    Raises:
        ValueError: the jumps do not multiply out to the horizon.

    Examples:
        >>> plan_levels(129, (32, 8, 1))
        [Level(jump=32, tokens=5), Level(jump=8, tokens=5), Level(jump=1, tokens=9)]
    """
    if horizon < 2:
        raise ValueError(f"horizon is {horizon}; a plan has 2 states or more.")
    spans = [horizon - 1, *jumps]
    fits = all(jump >= 1 and span % jump == 0 for span, jump in pairwise(spans))
    fits = fits and all(jump > finer for jump, finer in pairwise(jumps))
    if not jumps or jumps[-1] != 1 or not fits:
        raise ValueError(
            f"jumps {list(jumps)} do not multiply out to horizon {horizon}: horizon - 1 must be a "
            "multiple of the first, each jump one of the next, and the last must be 1, as in "
            "horizon 129 with jumps (32, 8, 1)."
        )
    return [Level(jump, span // jump + 1) for span, jump in pairwise(spans)]


def plan_times(levels: Sequence[Level]) -> Tensor:
    """Steps from now of the states in a plan: the finest level, then what coarser ones add."""
    times = torch.arange(levels[-1].tokens) * levels[-1].jump
    for level in reversed(levels[:-1]):
        times = torch.cat([times, torch.arange(2, level.tokens) * level.jump])
    return times
