"""The target rules with returns that depend on the goal of the query."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchrl_rad.retrieval import goals, search
from torchrl_rad.retrieval.goals import GoalReturns, GoalTable
from torchrl_rad.retrieval.rules import Choice
from torchrl_rad.retrieval.sampler import RetrievalSampler

__all__ = ["GoalRule", "goal_followed", "goal_highest", "goal_neighbours"]

MORE = 1.25  # times as many rows are looked at as should hold k of demonstrations


Found = tuple[Tensor, Tensor, Tensor, Tensor]


def goal_neighbours(
    sampler: RetrievalSampler,
    storage: Any,
    query: Tensor,
    table: GoalTable,
    returns: GoalReturns,
    goal: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """The neighbours of queries among the rows of demonstrations for their goals.

    Each goal gets a search structure of those rows, as long as all of them together are not larger
    than SUBSET_ENTRIES. Beyond, as many of the nearest of all rows are looked at as hold k of them.

    Args:
        sampler (RetrievalSampler): finds the rows.
        storage (Storage): where they are.
        query (Tensor): [Q, S] in raw units.
        table, returns: the table, and what it gave for the goals.
        goal (Tensor): int64 [Q], which of them each query has.

    Returns:
        Rows, int64 [Q, k], most similar first; their similarities, float64; and which of them are
        neighbours, bool: none where nobody reaches the goal.
    """
    k = min(sampler.k, len(returns.last))
    rows = goal.new_zeros(len(query), k)
    near, valid = torch.zeros_like(rows, dtype=torch.float64), torch.zeros_like(rows).bool()
    todo = (returns.share[goal] > 0).nonzero()[:, 0]
    if len(todo):
        share = float(returns.share[goal[todo].unique()].sum())
        fits = share * len(returns.last) <= _most(sampler, storage)
        search_in = _in_subsets if fits else _among_all
        for part, *found in search_in(sampler, storage, query, table, returns, goal, todo):
            for column, value in zip((rows, near, valid), found, strict=True):
                column[part, : value.shape[1]] = value
    return rows, near, valid


def _most(sampler: RetrievalSampler, storage: Any) -> int:
    """Rows in the structures of all goals."""
    return goals.SUBSET_ENTRIES // sampler.compared(storage)


def _in_subsets(sampler, storage, query, table, returns, goal, todo) -> Iterator[Found]:
    most = _most(sampler, storage)
    for number in goal[todo].unique().tolist():
        part = todo[goal[todo] == number]
        own, index = table.subset(number, partial(sampler.subset, storage), most)
        rows, near = sampler.nearest(storage, query[part], among=index)
        yield part, own[rows.clamp_min(0)], near, near >= sampler.threshold


def _among_all(sampler, storage, query, table, returns, goal, todo) -> Iterator[Found]:
    total = len(returns.last)
    k = min(sampler.k, total)
    # powers of two, so that many queries look at as many rows
    count = (MORE * k / returns.share[goal[todo]]).log2().ceil().exp2().long().clamp(1, total)
    while len(todo):
        most = int(count.min())
        now = (count == most).nonzero()[:, 0][: max(1, search.SCAN_ENTRIES // most)]
        part = todo[now]
        rows, near = sampler.nearest(storage, query[part], most)
        rows = rows.clamp_min(0)  # of a query with NaN
        valid = near >= sampler.threshold
        settled = ~valid[:, -1] | (most == total)
        valid &= returns.experts[goal[part][:, None], returns.episode[rows]]
        rank = valid.cumsum(-1)  # of those that are neighbours; all others go to a last place
        settled |= rank[:, -1] >= k
        place = torch.where(valid & (rank <= k), rank - 1, k)[settled]
        rows, near, valid = (
            column.new_zeros(len(place), k + 1).scatter_(1, place, column[settled])[:, :k]
            for column in (rows, near, valid)
        )
        yield part[settled], rows, near, valid
        count[now] = min(2 * most, total)
        left = torch.ones_like(todo, dtype=torch.bool)
        left[now[settled]] = False
        todo, count = todo[left], count[left]


def goal_followed(
    returns: GoalReturns, goal: Tensor, rows: Tensor, valid: Tensor, ahead: int
) -> tuple[Tensor, Tensor]:
    """``rule="followed"``: the neighbour with the largest return; the best of its next rows.

    Args:
        returns (GoalReturns): of the goals.
        goal (Tensor): int64 [Q], which goal each query has.
        rows (Tensor): int64 [Q, C], neighbours, most similar first.
        valid (Tensor): bool [Q, C], which of them are neighbours; at least one.
        ahead (int): number of rows looked ahead.

    Returns:
        The row to go for, int64 [Q], and the place of its neighbour in ``rows``, int64 [Q, 1].
    """
    goal = goal[:, None]
    value, _ = returns.value_and_end(rows, goal)
    place = torch.where(valid, value, -torch.inf).argmax(-1, keepdim=True)  # the first of equals
    row = rows.gather(-1, place)
    _, end = returns.value_and_end(row, goal)
    return returns.best(row, torch.minimum(row + ahead, end), goal)[1][:, 0], place


def goal_highest(
    returns: GoalReturns, goal: Tensor, rows: Tensor, valid: Tensor, horizon: int, min_offset: int
) -> tuple[Tensor, Tensor]:
    """``rule="highest"``, the paper's, without tolerance; arguments as of :func:`goal_followed`.

    ``horizon`` and ``min_offset`` are those of
    :class:`~torchrl_rad.modules.RetrievalTargetModule`.
    """
    goal = goal[:, None]
    _, end = returns.value_and_end(rows, goal)
    low, high = (torch.minimum(rows + most, end) for most in (min_offset, horizon - 1))
    peak, first = returns.best(low, high, goal)
    peak = torch.where(valid, peak, -torch.inf)
    fits = valid & (peak == peak.amax(-1, keepdim=True))
    # of the rows that pay most the one with the most steps left, then the lowest
    left = returns.value_and_end(first, goal)[1] - first
    left = torch.where(fits, left, -1)
    fits &= left == left.amax(-1, keepdim=True)
    target = torch.where(fits, first, torch.iinfo(torch.int64).max).amin(-1, keepdim=True)
    reaches = valid & (low <= target) & (target <= high)
    return target[:, 0], reaches.int().argmax(-1, keepdim=True)


class GoalRule:
    """Either rule with the returns of the goal that comes with each query.

    Args:
        table (GoalTable): of the database.
        horizon, min_offset (int): of :func:`goal_highest`.
        ahead (int, optional): of :func:`goal_followed`, which is the rule if it is given.
    """

    def __init__(self, table: GoalTable, horizon: int, min_offset: int, ahead: int | None = None):
        self.table, self.horizon, self.min_offset, self.ahead = table, horizon, min_offset, ahead

    def choose(
        self, sampler: RetrievalSampler, storage: Any, query: Tensor, goals: Tensor | None
    ) -> Choice:
        """As :meth:`~torchrl_rad.retrieval.rules.TargetRule.choose`."""
        assert goals is not None
        number, returns = self.table.look_up(goals)
        asked = (query, self.table, returns, number)
        rows, nears, valid = goal_neighbours(sampler, storage, *asked)
        if self.ahead is None:
            limits = (self.horizon, self.min_offset)
            target, place = goal_highest(returns, number, rows, valid, *limits)
        else:
            target, place = goal_followed(returns, number, rows, valid, self.ahead)
        hit = valid.any(-1)
        row, near = rows.gather(-1, place)[:, 0], nears.gather(-1, place)[:, 0]
        none = ~hit
        if none.any():
            some, most = sampler.nearest(storage, query[none], 1)
            row[none], near[none] = some[:, 0], most[:, 0]
        return Choice(target, row, near, hit)

    def value(self, rows: Tensor, goals: Tensor | None) -> Tensor:
        """Return of rows for the goal of each, float32 [Q]."""
        assert goals is not None
        number, returns = self.table.look_up(goals)
        return returns.value_and_end(rows, number)[0]
