"""Two search structures as one: rows that were there, and rows that came later."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_rad.retrieval.choice import Candidates, most_similar, ordered
from torchrl_rad.retrieval.index import SearchIndex

__all__ = ["JointIndex"]


class JointIndex(SearchIndex):
    """The k best of both are the k best of all.

    Args:
        rows (Tensor): [N, D], of both.
        first (SearchIndex): of the first ones.
        second (SearchIndex): of the others, of the same metric.

    Examples:
        >>> from torchrl_rad.retrieval.search import ScanIndex
        >>> rows = torch.tensor([[0.0], [2.0], [2.0], [5.0]])
        >>> parts = (ScanIndex(part, "euclidean") for part in (rows[:2], rows[2:]))
        >>> JointIndex(rows, *parts).search(torch.tensor([[1.9]]), 2)[1]
        tensor([[1, 2]])
    """

    def __init__(self, rows: Tensor, first: SearchIndex, second: SearchIndex):
        self.rows, self.metric = rows, first.metric
        self.first, self.second = first, second
        self.border = len(first.rows)

    def candidates(self, query: Tensor, k: int) -> Candidates:
        """As :meth:`SearchIndex.candidates`."""
        one = self.first.candidates(query, min(k, self.border))
        other = self.second.candidates(query, min(k, len(self.second.rows)))
        other = other._replace(row=other.row + self.border)
        # scores from zero on, so that they compare
        score = torch.cat([part.score - part.base[:, None] for part in (one, other)], -1)
        fine = 4 * torch.finfo(torch.float64).eps
        error = torch.maximum(
            one.error + fine * one.base.abs(), other.error + fine * other.base.abs()
        )
        # as many as each part has, unless it has all of its rows: no other row is then better
        sizes = ((one, self.border), (other, len(self.second.rows)))
        known = [part.row.shape[1] for part, count in sizes if part.row.shape[1] < count]
        score, place = score.topk(min([*known, score.shape[1]]), dim=-1)
        row = torch.cat([one.row, other.row], -1).gather(-1, place)
        return Candidates(score, row, error, torch.zeros_like(error))

    def order(self, found: Candidates, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`SearchIndex.order`."""
        query = query.double()
        near, index, least = ordered(found, query, self.rows, self.metric, k)
        doubt = ~(found.score[:, -1] < least)
        if doubt.any():
            near[doubt], index[doubt] = self._both(query[doubt], k)
        return near, index

    def _both(self, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        near, index = self.first.search(query, min(k, self.border))
        others, rows = self.second.search(query, min(k, len(self.second.rows)))
        near, index = torch.cat([near, others], -1), torch.cat([index, rows + self.border], -1)
        near, index = most_similar(near, index)
        return near[:, :k], index[:, :k]
