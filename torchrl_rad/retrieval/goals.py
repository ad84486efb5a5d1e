"""What recorded rows are worth for a goal that comes with the query."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.retrieval.index import SearchIndex
from torchrl_rad.retrieval.windows import WindowMax

__all__ = ["GoalReward", "GoalReturns", "GoalTable"]

GOALS = 1024  # for which what was found is kept
SUBSET_ENTRIES = 2**24  # of states in search structures of their own, for all goals together


@dataclass(frozen=True)
class GoalReward:
    """When a goal counts as reached: a reward of 1 for each step that ends within a radius of it.

    Args:
        radius (float, optional): in units of the state. Defaults to ``0.5`` (D4RL's mazes).
        dims (sequence of int, optional): entries of the state that are compared with the goal.
            Defaults to the first ones, as many as a goal has.
        first_visit (bool, optional): an episode ends with the visit of the goal, as a task does
            that is over then: returns are ``gamma ** steps`` to it, and no target lies beyond.
            Defaults to ``False``.
        expert (callable, optional): one episode with that reward -> bool, whether it is a
            demonstration for the goal; those that reach it are asked. Defaults to the rule of the
            database, and to all of them where it has none.

    Raises:
        ValueError: ``radius`` is negative.

    Examples:
        >>> reward = GoalReward(radius=1.0)
        >>> reward(torch.tensor([[0.0, 9.0], [2.0, 9.0]]), torch.tensor([0.5]))
        tensor([ True, False])
    """

    radius: float = 0.5
    dims: Sequence[int] | None = None
    first_visit: bool = False
    expert: Callable[[TensorDictBase], bool] | None = None

    def __post_init__(self):
        if not self.radius >= 0:
            raise ValueError(f"radius is {self.radius}; it must not be negative.")

    def __call__(self, states: Tensor, goal: Tensor) -> Tensor:
        """Whether states [..., S] are within the radius of a goal [G]: bool [...].

        Raises:
            ValueError: the goal has another width than ``dims``, or than a state at most.
        """
        return self.reached(self.places(states, len(goal)), goal)

    def places(self, states: Tensor, width: int) -> Tensor:
        """The entries of states [N, S] that goals of a width are compared with."""
        dims = list(range(width)) if self.dims is None else list(self.dims)
        if len(dims) != width or (dims and max(dims) >= states.shape[-1]):
            raise ValueError(
                f"a goal has {width} entries, compared with entries {dims} of a state of "
                f"{states.shape[-1]}; pass goals of that width, or GoalReward(dims=...)."
            )
        return states[..., dims]

    def reached(self, places: Tensor, goal: Tensor) -> Tensor:
        """As a call, of what :meth:`places` gave."""
        return (places - goal.to(places)).norm(dim=-1) <= self.radius


class _Goal(NamedTuple):
    hits: Tensor  # int64 [M], rows that end within the radius, rising
    returns: Tensor  # float64 [M], from each of them on
    experts: Tensor  # bool [E], which episodes are demonstrations


class GoalReturns(NamedTuple):
    """Returns for a batch of goals, looked up by row.

    Between two visits of a goal the return only grows by the discount, so that the rows of the
    visits, some thousands, say it for all rows.

    Attributes:
        keys: int64 [M], ``goal * N + row`` of each visit, rising.
        returns: WindowMax over float32 [M].
        exact: float64 [M], the same.
        experts: bool [U, E], which episodes are demonstrations for each goal.
        share: float64 [U], of all rows those in such episodes.
        episode: int64 [N], which of the E episodes each row is of.
        last: int64 [N], last row of each row's episode.
        gamma: discount.
        first_visit: as of :class:`GoalReward`.
    """

    keys: Tensor
    returns: WindowMax
    exact: Tensor
    experts: Tensor
    share: Tensor
    episode: Tensor
    last: Tensor
    gamma: float
    first_visit: bool

    def value_and_end(self, rows: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Return from each row on, float32, and the last row that belongs to it, int64.

        Args:
            rows (Tensor): int64 [Q, ...].
            goal (Tensor): int64 of the same number of dims, which goal of the batch.
        """
        last = self.last[rows]
        if len(self.keys) == 0:
            return torch.zeros_like(rows, dtype=torch.float32), last
        base = goal * len(self.last)
        place = torch.searchsorted(self.keys, base + rows).clamp_max(len(self.keys) - 1)
        ahead = self.keys[place] - base - rows
        hit = (ahead >= 0) & (rows + ahead <= last)
        value = self.gamma ** ahead.clamp_min(0).double() * self.exact[place]
        end = torch.where(hit, rows + ahead, last) if self.first_visit else last
        return torch.where(hit, value, 0.0).float(), end

    def best(self, low: Tensor, high: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """The largest return among rows low..high of one episode, float32, and its first row."""
        (first, _), (final, _) = (self.value_and_end(rows, goal) for rows in (low, high))
        value, row = torch.where(final > first, final, first), torch.where(final > first, high, low)
        if len(self.keys) == 0:
            return value, row
        base = goal * len(self.last)
        begin = torch.searchsorted(self.keys, base + low)
        end = torch.searchsorted(self.keys, base + high, right=True) - 1
        some = begin <= end  # visits in between
        begin, end = begin.clamp_max(len(self.keys) - 1), end.clamp_min(0).maximum(begin)
        end = end.clamp_max(len(self.keys) - 1)
        visit = self.returns.max(begin, end)
        place = self.returns.first(begin, end, visit, 0.0).clamp_max(len(self.keys) - 1)
        there = self.keys[place] - base
        if self.gamma == 1:  # rows before a visit are worth as much: back to the visit before
            before = torch.where(place > 0, self.keys[place - 1] - base, -1)
            there = torch.maximum(low, before + 1)
        better = some & ((visit > value) | ((visit == value) & (there < row)))
        return torch.where(better, visit, value), torch.where(better, there, row)


class GoalTable:
    """Finds the rows near each goal, once for each goal.

    Args:
        tables (sequence of TensorDictBase): content of a database, [N] in all, each of whole
            episodes. Of each of its N rows 16 bytes are held, beside the entries of a state that
            are compared with a goal.
        key (NestedKey): the state in it.
        gamma (float): discount of the returns.
        reward (GoalReward): when a goal is reached.
        experts (callable, optional): episodes that reach a goal, with its reward -> bool [E], which
            of them are demonstrations. Defaults to all.
        longest (int, optional): rows of the longest window in which the best is asked for.
            Defaults to any.

    Examples:
        >>> from tensordict import TensorDict
        >>> state = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
        >>> rows = TensorDict({
        ...     "observation": state, "next": {"observation": state + 1},
        ...     "step": torch.arange(4), "remaining": torch.arange(3, -1, -1)}, [4])
        >>> table = GoalTable([rows], "observation", 0.5, GoalReward(radius=0.1))
        >>> number, returns = table.look_up(torch.tensor([[3.0], [9.0], [3.0]]))
        >>> number, returns.experts
        (tensor([0, 1, 0]), tensor([[ True],
                [False]]))
        >>> returns.value_and_end(torch.arange(4), torch.zeros(4, dtype=torch.int64))[0]
        tensor([0.2500, 0.5000, 1.0000, 0.0000])
    """

    def __init__(
        self,
        tables: Sequence[TensorDictBase],
        key: Any,
        gamma: float,
        reward: GoalReward,
        experts: Callable[[Sequence[TensorDictBase]], Tensor] | None = None,
        longest: int | None = None,
    ):
        step, remaining = (torch.cat([t[name] for t in tables]) for name in ("step", "remaining"))
        self.tables, self.key, self.gamma, self.reward = tables, key, gamma, reward
        self.experts, self.longest = experts, longest
        row = torch.arange(len(step), device=step.device)
        self.last = row + remaining
        starts = row[step == 0]
        self.lengths = torch.diff(starts, append=starts.new_tensor([len(step)]))
        self.episode = torch.repeat_interleave(torch.arange(len(starts)), self.lengths)
        self.places: Tensor | None = None  # of them the entries that a goal has
        self.goals: dict[tuple[float, ...], _Goal] = {}
        self.batch: tuple[Any, GoalReturns] | None = None
        self.subsets: dict[tuple[float, ...], tuple[Tensor, SearchIndex]] = {}

    def look_up(self, goals: Tensor) -> tuple[Tensor, GoalReturns]:
        """Which goal of the returned ones each of ``goals`` [Q, G] is, int64 [Q].

        Raises:
            ValueError: goals of another width.
        """
        goals = goals.detach().to(self.last.device, torch.float64)
        goals = torch.where(goals.isfinite(), goals, torch.inf)  # what nobody reaches
        distinct, number = goals.unique(dim=0, return_inverse=True)
        names = tuple(map(tuple, distinct.tolist()))
        if self.batch is None or self.batch[0] != names:
            self.batch = names, self._joined([self._goal(name) for name in names])
        return number, self.batch[1]

    def subset(
        self, number: int, make: Callable[[Tensor], SearchIndex], most: int
    ) -> tuple[Tensor, SearchIndex]:
        """Rows, int64, of the demonstrations for a goal of the last batch, and their structure.

        Those that were not asked for the longest are given up, so that all have ``most`` rows.
        """
        assert self.batch is not None
        names, returns = self.batch
        kept = self.subsets.pop(names[number], None)
        if kept is None:
            rows = returns.experts[number][self.episode].nonzero()[:, 0]
            kept = rows, make(rows)
            held = len(rows) + sum(len(other) for other, _ in self.subsets.values())
            while held > most and self.subsets:
                held -= len(self.subsets.pop(next(iter(self.subsets)))[0])
        self.subsets[names[number]] = kept
        return kept

    def _joined(self, found: list[_Goal]) -> GoalReturns:
        count, none = len(self.last), self.last.new_zeros(0)  # also for no goal at all
        exact = torch.cat([none.double(), *(goal.returns for goal in found)])
        keys = [number * count + goal.hits for number, goal in enumerate(found)]
        experts = self.last.new_zeros(len(found), len(self.lengths), dtype=torch.bool)
        for row, goal in zip(experts, found, strict=True):
            row.copy_(goal.experts)
        return GoalReturns(
            torch.cat([none, *keys]),
            WindowMax(exact.float(), self.longest),
            exact,
            experts,
            (experts * self.lengths).sum(-1).double() / count,
            self.episode,
            self.last,
            self.gamma,
            self.reward.first_visit,
        )

    def _goal(self, name: tuple[float, ...]) -> _Goal:
        if name in self.goals:
            self.goals[name] = self.goals.pop(name)  # the last one used
            return self.goals[name]
        if self.places is None or self.places.shape[1] != len(name):
            following = (_following(table, self.key) for table in self.tables)
            self.places = torch.cat([self.reward.places(one, len(name)) for one in following])
        near = self.reward.reached(self.places, torch.tensor(name, dtype=torch.float64))
        hits = near.nonzero()[:, 0]
        returns = torch.ones(len(hits), dtype=torch.float64, device=hits.device)
        if not self.reward.first_visit:
            returns = _discounted(hits, self.episode[hits], self.gamma)
        made = _Goal(hits, returns, self._experts(near, hits))
        while len(self.goals) >= GOALS:
            self.goals.pop(next(iter(self.goals)))
        self.goals[name] = made
        return made

    def _experts(self, near: Tensor, hits: Tensor) -> Tensor:
        reaches = torch.zeros(len(self.lengths), dtype=torch.bool, device=hits.device)
        reaches[self.episode[hits]] = True
        if self.experts is None or not reaches.any():
            return reaches
        asked = reaches[self.episode]
        kept, end = [], 0
        for table in self.tables:
            rows = slice(end, end := end + len(table))
            steps = table.copy().set(("next", "reward"), near[rows].float()[:, None])[asked[rows]]
            lengths = (steps["remaining"][steps["step"] == 0] + 1).tolist()
            if lengths:
                kept.append(self.experts(steps.split(lengths)))
        return reaches.masked_scatter(reaches, torch.cat(kept).to(reaches.device))


def _following(rows: TensorDictBase, key: Any) -> Tensor:
    """The state after each row; where the last one's of an episode is not recorded, its own."""
    recorded = rows.get(("next", key) if isinstance(key, str) else ("next", *key), None)
    if recorded is not None:
        return recorded
    remaining = rows["remaining"]
    row = torch.arange(len(remaining), device=remaining.device)
    return rows.get(key)[row + remaining.clamp_max(1)]


def _discounted(hits: Tensor, episode: Tensor, gamma: float) -> Tensor:
    """Return from each visit on, float64 [M]: one for it and for each later one of its episode."""
    if len(hits) == 0:
        return torch.zeros(0, dtype=torch.float64, device=hits.device)
    number, lengths = torch.unique_consecutive(episode, return_inverse=True, return_counts=True)[1:]
    first = lengths.cumsum(0) - lengths
    place = torch.arange(len(hits), device=hits.device) - first[number]
    longest = int(lengths.max())
    # the discount up to the next visit; none after the last one
    factor = torch.zeros(longest, len(lengths), dtype=torch.float64, device=hits.device)
    gap = torch.diff(hits, append=hits[-1:]).double()
    factor[place, number] = torch.where(place + 1 < lengths[number], gamma**gap, 0.0)
    value, out = torch.zeros_like(factor[0]), torch.empty_like(factor)
    for visit in range(longest - 1, -1, -1):  # of the episode with most of them
        value = 1.0 + factor[visit] * value
        out[visit] = value
    return out[place, number]
