"""Which row to go for, given the neighbours of a state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_rad.retrieval.windows import WindowMax

if TYPE_CHECKING:
    from torchrl_rad.retrieval.sampler import RetrievalSampler

__all__ = [
    "Choice",
    "NoisyRule",
    "RankedRule",
    "TargetRule",
    "TolerantRule",
    "followed_rule",
    "highest_rule",
]


class Choice(NamedTuple):
    """What a rule chose for each of Q queries.

    Attributes:
        target: int64 [Q], the row to go for; any row where there is no neighbour.
        row: int64 [Q], the neighbour through which it is reached; -1 where there is no row at all.
        similarity: float64 [Q], its; of the most similar row where there is no neighbour.
        hit: bool [Q], whether there is a neighbour.
    """

    target: Tensor
    row: Tensor
    similarity: Tensor
    hit: Tensor


class TargetRule(Protocol):
    """Says which row to go for."""

    def choose(
        self, sampler: RetrievalSampler, storage: Any, query: Tensor, goals: Tensor | None
    ) -> Choice:
        """Asks the sampler for neighbours of queries [Q, S] and chooses for each; goals [Q, G]."""

    def value(self, rows: Tensor, goals: Tensor | None) -> Tensor:
        """Return of rows, float32 [Q]."""


class RankedRule(NamedTuple):
    """Follows the neighbour of the highest rank; of equals the more similar one.

    Where a row leads and how good that is do not depend on the query, so that both are columns.

    Attributes:
        rank: int [N], not negative.
        target: int64 [N], the row to go for from each row.
        values: float32 [N], returns.
    """

    rank: Tensor
    target: Tensor
    values: Tensor

    def choose(
        self, sampler: RetrievalSampler, storage: Any, query: Tensor, goals: Tensor | None = None
    ) -> Choice:
        """As :meth:`TargetRule.choose`."""
        # the order of all neighbours is not needed
        row, near, hit = sampler.best(storage, query, self.rank)
        return Choice(self.target.index_select(0, row.clamp_min(0)), row, near, hit)

    def ranked(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`Ranks.ranked`."""
        return self.target[rows], self.rank[rows]

    def value(self, rows: Tensor, goals: Tensor | None = None) -> Tensor:
        """As :meth:`TargetRule.value`."""
        return self.values.index_select(0, rows)


class Ranks(TargetRule, Protocol):
    """A rule by which the neighbours of a query can be put in order."""

    def ranked(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """For neighbours [Q, k] the row to go for through each, and its rank, not negative."""


class NoisyRule(NamedTuple):
    """One of the best targets of each query, each of them as likely as another.

    It is the spoiled ranking of RAD, appendix "Sensitivity to Imperfect Ranking".

    Attributes:
        rule: says which targets are better.
        among: number of targets; fewer where there are no more.
    """

    rule: Ranks
    among: int

    def choose(
        self, sampler: RetrievalSampler, storage: Any, query: Tensor, goals: Tensor | None = None
    ) -> Choice:
        """As :meth:`TargetRule.choose`; drawn with torch's global generator."""
        rows, near = sampler.nearest(storage, query)  # [Q, k]
        valid = near >= sampler.threshold
        targets, rank = self.rule.ranked(rows.clamp_min(0))
        left = torch.where(valid, rank, -1)
        places = []
        for _ in range(self.among):
            place = left.argmax(-1, keepdim=True)  # of equals the more similar one
            best = left.gather(-1, place)
            places.append(torch.where(best >= 0, place, -1))
            left = torch.where(targets == targets.gather(-1, place), -1, left)
        ranked = torch.cat(places, -1)  # [Q, among]
        count = (ranked >= 0).sum(-1).clamp_min(1)
        drawn = (torch.rand(len(query), device=count.device) * count).long()
        place = ranked.gather(-1, drawn[:, None]).clamp_min(0)
        target, row = targets.gather(-1, place)[:, 0], rows.gather(-1, place)[:, 0]
        return Choice(target, row, near.gather(-1, place)[:, 0], valid[:, 0])

    def value(self, rows: Tensor, goals: Tensor | None = None) -> Tensor:
        """As :meth:`TargetRule.value`."""
        return self.rule.value(rows, goals)


class TolerantRule:
    """``rule="highest"`` with a tolerance: what counts as good enough depends on the query.

    Args:
        values (Tensor): float32 [N], returns.
        remaining (Tensor): int64 [N], steps left in the episode.
        horizon (int): a target lies at most ``horizon - 1`` rows ahead.
        min_offset (int): and at least so many, as far as the episode goes.
        tolerance (float): in units of return.

    Examples:
        >>> values, remaining = torch.tensor([0.0, 2.0, 3.0, 2.5]), torch.tensor([3, 2, 1, 0])
        >>> rule = TolerantRule(values, remaining, horizon=4, min_offset=0, tolerance=1.0)
        >>> rule(torch.tensor([[2, 0]]), torch.tensor([[True, True]]))
        (tensor([1]), tensor([[1]]))
    """

    def __init__(
        self, values: Tensor, remaining: Tensor, horizon: int, min_offset: int, tolerance: float
    ):
        self.table, self.remaining, self.tolerance = (
            WindowMax(values, horizon),
            remaining,
            tolerance,
        )
        self.low, self.high = _window(remaining, min_offset, horizon - 1)
        self.peak = self.table.max(self.low, self.high)

    def choose(
        self, sampler: RetrievalSampler, storage: Any, query: Tensor, goals: Tensor | None = None
    ) -> Choice:
        """As :meth:`TargetRule.choose`."""
        rows, near = sampler.nearest(storage, query)  # [Q, k]
        valid = near >= sampler.threshold
        target, place = self(rows.clamp_min(0), valid)
        hit = valid[:, 0]  # the most similar comes first
        place = torch.where(hit[:, None], place, 0)
        return Choice(target, rows.gather(-1, place)[:, 0], near.gather(-1, place)[:, 0], hit)

    def value(self, rows: Tensor, goals: Tensor | None = None) -> Tensor:
        """As :meth:`TargetRule.value`."""
        return self.table.values.index_select(0, rows)

    def __call__(self, rows: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Chooses a row for each query.

        Args:
            rows (Tensor): int64 [Q, k], neighbours, most similar first.
            valid (Tensor): bool [Q, k], which of them are neighbours; at least one.

        Returns:
            The row to go for, int64 [Q], and the place of its neighbour in ``rows``, int64 [Q, 1].
            Without any neighbour: some row and place 0.
        """
        peak = torch.where(valid, self.peak[rows], -torch.inf)
        top = peak.amax(-1, keepdim=True)
        # float64: the difference of two float32 would be rounded
        fits = valid & (top.double() - peak.double() <= self.tolerance)
        query, place = fits.nonzero(as_tuple=True)
        near = rows[query, place]
        # inside one episode the first row within tolerance is the one with the most steps left
        row = self.table.first(self.low[near], self.high[near], top[query, 0], self.tolerance)
        first = rows.masked_scatter(fits, row)
        left = torch.where(fits, self.remaining[first], -1)
        fits = left == left.amax(-1, keepdim=True)
        value = torch.where(fits, self.table.values[first], -torch.inf)
        fits = value == value.amax(-1, keepdim=True)
        target = torch.where(fits, first, torch.iinfo(torch.int64).max).amin(-1, keepdim=True)
        reaches = valid & (self.low[rows] <= target) & (target <= self.high[rows])
        return target.squeeze(-1), reaches.int().argmax(-1, keepdim=True)


def followed_rule(values: Tensor, remaining: Tensor, ahead: int) -> RankedRule:
    """``rule="followed"``: the neighbour with the largest return; the best of its next rows.

    Args:
        values (Tensor): float32 [N], returns.
        remaining (Tensor): int64 [N], steps left in the episode.
        ahead (int): number of rows looked ahead.
    """
    table = WindowMax(values, ahead + 1)
    low, high = _window(remaining, 0, ahead)
    target = table.first(low, high, table.max(low, high), 0.0)
    return RankedRule(_narrow(values.unique(return_inverse=True)[1]), target, values)


def highest_rule(
    values: Tensor, remaining: Tensor, horizon: int, min_offset: int = 0, tolerance: float = 0.0
) -> RankedRule | TolerantRule:
    """``rule="highest"``, the paper's: arguments as of :class:`TolerantRule`.

    Without tolerance the best row of each row's window can be ranked beforehand. A neighbour whose
    window holds the chosen row leads to that very row: an earlier one as good has more steps left.
    """
    if tolerance > 0:
        return TolerantRule(values, remaining, horizon, min_offset, tolerance)
    table = WindowMax(values, horizon)
    low, high = _window(remaining, min_offset, horizon - 1)
    target = table.first(low, high, table.max(low, high), 0.0)
    rows, place = target.unique(return_inverse=True)
    # by return, then steps left, then the lower row: the last sort decides first
    order = torch.arange(len(rows) - 1, -1, -1, device=rows.device)
    order = order[remaining[rows[order]].sort(stable=True).indices]
    order = order[values[rows[order]].sort(stable=True).indices]
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(rows), device=rows.device)
    return RankedRule(_narrow(rank[place]), target, values)


def _narrow(rank: Tensor) -> Tensor:
    # half as much memory to read for each query
    return rank.to(torch.int32) if len(rank) < 2**31 else rank


def _window(remaining: Tensor, least: int, most: int) -> tuple[Tensor, Tensor]:
    """First and last row, int64 [N], of those ``least`` to ``most`` ahead in the same episode."""
    row = torch.arange(len(remaining), device=remaining.device)
    return row + remaining.clamp_max(least), row + remaining.clamp_max(most)
