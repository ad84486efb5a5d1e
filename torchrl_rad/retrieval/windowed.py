"""The target rules on columns too long to rank: they are read only where the neighbours lie."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from torchrl_rad.retrieval.rules import Choice

__all__ = ["Column", "WindowedRule"]

WINDOW_ENTRIES = 2**21  # entries of windows held at a time


class Column(Protocol):
    """One number a row."""

    def index_select(self, dim: int, index: Tensor) -> Tensor:
        """Those of some rows [M]; ``dim`` is 0."""

    def windows(self, index: Tensor, length: int) -> Tensor:
        """Those of rows [M] and the next ones, [M, length]; anything beyond their episode."""


class WindowedRule:
    """``"followed"`` or ``"highest"``, as RetrievalTargetModule has them, without a table a row.

    Args:
        values (Column): float32 [N], returns.
        remaining (Column): int64 [N], steps left in the episode.
        horizon, min_offset, tolerance: of ``"highest"``, see
            :class:`~torchrl_rad.retrieval.rules.TolerantRule`.
        ahead (int, optional): of ``"followed"``, which is the rule if it is given.
    """

    def __init__(
        self,
        values: Column,
        remaining: Column,
        horizon: int,
        min_offset: int = 0,
        tolerance: float = 0.0,
        ahead: int | None = None,
    ):
        self.values, self.remaining = values, remaining
        self.horizon, self.min_offset, self.tolerance = horizon, min_offset, tolerance
        self.ahead = ahead

    def choose(self, sampler: Any, storage: Any, query: Tensor, goals: Tensor | None = None):
        """As :meth:`~torchrl_rad.retrieval.rules.TargetRule.choose`."""
        rows, near = sampler.nearest(storage, query)  # [Q, k]
        valid = near >= sampler.threshold
        if self.ahead is not None:
            target, place = self._followed(rows.clamp_min(0), valid)
        else:
            many = self._at_a_time(rows)
            parts = zip(rows.clamp_min(0).split(many), valid.split(many), strict=True)
            found = [self._highest(*part) for part in parts]
            target, place = (torch.cat(column) for column in zip(*found, strict=True))
        hit = valid[:, 0]  # the most similar comes first
        place = torch.where(hit[:, None], place, 0)
        return Choice(target, rows.gather(-1, place)[:, 0], near.gather(-1, place)[:, 0], hit)

    def value(self, rows: Tensor, goals: Tensor | None = None) -> Tensor:
        """As :meth:`~torchrl_rad.retrieval.rules.TargetRule.value`."""
        return self.values.index_select(0, rows)

    def ranked(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`~torchrl_rad.retrieval.rules.Ranks.ranked`; ranks are of these rows alone."""
        parts = rows.split(self._at_a_time(rows))
        best = [self._returns(part, *self._limits(part)[1:]).argmax(-1) for part in parts]
        target = rows + torch.cat(best)  # the first of equals
        if self.ahead is not None:
            return target, self._read(self.values, rows).unique(return_inverse=True)[1]
        # by return, then steps left, then the lower row
        merits = (self._read(self.values, target), self._read(self.remaining, target), -target)
        order = torch.stack([column.double() for column in merits], -1)  # [Q, k, 3]
        rank = order.flatten(0, 1).unique(dim=0, return_inverse=True)[1]
        return target, rank.view(rows.shape)

    def _at_a_time(self, rows: Tensor) -> int:
        """Queries whose windows are held at a time."""
        return max(1, WINDOW_ENTRIES // (rows.shape[1] * self.horizon))

    def _read(self, column: Column, rows: Tensor) -> Tensor:
        return column.index_select(0, rows.flatten()).view(rows.shape)

    def _limits(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Steps left from rows [Q, k], and how far ahead the first and last allowed target lie."""
        left = self._read(self.remaining, rows)
        if self.ahead is not None:
            return left, torch.zeros_like(left), left.clamp_max(self.ahead)
        return left, left.clamp_max(self.min_offset), left.clamp_max(self.horizon - 1)

    def _returns(self, rows: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Returns of the rows low..high ahead of each of rows [Q, k]: [Q, k, L], others -inf."""
        length = self.horizon if self.ahead is None else self.ahead + 1
        window = self.values.windows(rows.flatten(), length).view(*rows.shape, length)
        step = torch.arange(length, device=rows.device)
        inside = (low[..., None] <= step) & (step <= high[..., None])
        return torch.where(inside, window, -torch.inf)

    def _followed(self, rows: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Row to go for, [Q], and place of its neighbour, [Q, 1]; rows and valid are [Q, k]."""
        value = torch.where(valid, self._read(self.values, rows), -torch.inf)
        place = value.argmax(-1, keepdim=True)  # of equals the first: the most similar
        row = rows.gather(-1, place)
        _, low, high = self._limits(row)
        return (row + self._returns(row, low, high).argmax(-1))[:, 0], place

    def _highest(self, rows: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`_followed`."""
        left, low, high = self._limits(rows)
        returns = self._returns(rows, low, high)  # [Q, k, H]
        top = torch.where(valid, returns.amax(-1), -torch.inf).amax(-1)[:, None, None]
        # float64: the difference of two float32 would be rounded
        good = top.double() - returns.double() <= self.tolerance
        fits = valid & good.any(-1)
        # inside one episode the first row within tolerance is the one with the most steps left
        first = good.int().argmax(-1, keepdim=True)
        left = torch.where(fits, left - first[..., 0], -1)
        fits &= left == left.amax(-1, keepdim=True)
        value = torch.where(fits, returns.gather(-1, first)[..., 0], -torch.inf)
        fits &= value == value.amax(-1, keepdim=True)
        target = torch.where(fits, rows + first[..., 0], torch.iinfo(torch.int64).max)
        target = target.amin(-1, keepdim=True)
        reaches = valid & (rows + low <= target) & (target <= rows + high)
        return target[:, 0], reaches.int().argmax(-1, keepdim=True)
