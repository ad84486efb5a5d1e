"""The levels of a coarse-to-fine plan."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from torchrl_rad.modules.normalizer import Normalizer

__all__ = [
    "Level",
    "change_of",
    "decode_states",
    "encode_states",
    "level_changes",
    "plan_levels",
    "plan_times",
]


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


def change_of(changes: nn.ModuleList | None, number: int) -> Normalizer | None:
    """The scale of one level's changes; None where plans are not relative."""
    return None if changes is None else cast(Normalizer, changes[number])


def encode_states(states: Tensor, normalizer: Normalizer, change: Normalizer | None) -> Tensor:
    """Planned states [*B, n, S] in a network's units.

    Args:
        states (Tensor): raw units; the first one is the current state.
        normalizer (Normalizer): of states.
        change (Normalizer, optional): of changes from the current state, as which all states but
            that one are given then.

    Examples:
        >>> plan = torch.tensor([[3.0], [3.5], [4.0]])
        >>> change = Normalizer(torch.zeros(1), torch.tensor([0.5]))
        >>> encode_states(plan, Normalizer.identity(1), change).squeeze()
        tensor([3., 1., 2.])
    """
    if change is None:
        return normalizer(states)
    now = states[..., :1, :]
    return torch.cat([normalizer(now), change(states[..., 1:, :] - now)], -2)


def decode_states(
    units: Tensor, now: Tensor, normalizer: Normalizer, change: Normalizer | None
) -> Tensor:
    """The way back of :func:`encode_states`, ``now`` [*B, 1, S] being the current state."""
    if change is None:
        return normalizer.inverse(units)
    return torch.cat([now, change.inverse(units[..., 1:, :]) + now], -2)


def level_changes(states: Tensor, episode: Tensor, level: Level) -> Normalizer:
    """The scale of the changes from the first state of a level to the others, in recorded steps.

    It is the root of the mean square, not a deviation about the mean: to stay counts as 0.

    Args:
        states (Tensor): [T, S], raw units, whole episodes one after the other.
        episode (Tensor): int64 [T].
        level (Level): whose grid it is.

    Examples:
        >>> states = torch.tensor([[0.0], [1.0], [3.0], [9.0]])
        >>> level_changes(states, torch.tensor([0, 0, 0, 1]), Level(jump=1, tokens=2)).deviation
        tensor([1.5811])
    """
    squares, count = torch.zeros(states.shape[-1], dtype=torch.float64), 0
    for ahead in range(level.jump, level.span + 1, level.jump):
        within = episode[:-ahead] == episode[ahead:]
        change = (states[ahead:] - states[:-ahead])[within].double()
        squares += change.square().sum(0).cpu()
        count += len(change)
    scale = (squares / max(1, count)).sqrt()
    return Normalizer(torch.zeros_like(scale), scale)
