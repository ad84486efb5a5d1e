"""Neighbours of queries that follow one another, from wider lists around earlier queries."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_rad.retrieval.choice import Candidates, ordered, rounded
from torchrl_rad.retrieval.index import SearchIndex
from torchrl_rad.retrieval.search import ScanIndex

__all__ = ["ListIndex"]

LIST_ENTRIES = 2**21  # entries of states in all lists together: 8 MiB of float32
SHARE = 16  # a list holds at most one row in so many
ENOUGH = 8  # times k rows make a list that lasts; shorter ones cost more than they save
LONGEST_PAUSE = 64  # searches


class Lists(NamedTuple):
    """The rows around one centre a query, nearest first.

    The proofs need distances with the triangle inequality: under cosine similarity all of this is
    about vectors of length one.

    Attributes:
        centre: float64 [Q, D].
        row: int64 [Q, M], of the database.
        place: float32 [Q, M, D], where they lie, seen from the centre.
        offset: float32 [Q, M], minus half of their squared distance from the centre.
        least: float32 [Q, M], neither this entry nor a later one is nearer to the centre.
        reach: float64 [Q], no other row is nearer to the centre.
        served: int64 [Q], searches that a list has answered, with the one it was made for.
    """

    centre: Tensor
    row: Tensor
    place: Tensor
    offset: Tensor
    least: Tensor
    reach: Tensor
    served: Tensor


class ListIndex(SearchIndex):
    """Exact neighbours by :class:`ScanIndex`, or from what it found for the query before.

    Query i of a batch is taken to follow query i of the batch before, as the rows of an environment
    do. Around the earlier one, at distance :math:`m`, a list holds all rows up to a distance
    :math:`r`. Any other row is at least :math:`r - m` away from the later one; if k rows are
    nearer, they are the neighbours. Of the list only rows up to :math:`u + m` are looked at, with u
    the distance of the k-th best among its first rows. Where this proves nothing, all rows are
    searched and a new list is made. So the answers never depend on earlier queries.

    Args:
        scan (ScanIndex): over the rows.

    Examples:
        >>> rows = torch.arange(4000.0)[:, None]
        >>> index = ListIndex(ScanIndex(rows, "euclidean"))
        >>> for state in (700.2, 701.1, 701.9):
        ...     print(index.search(torch.tensor([[state]]), 2)[1].tolist(), index.searches)
        [[700, 701]] 1
        [[701, 702]] 1
        [[702, 701]] 1
    """

    def __init__(self, scan: ScanIndex):
        self.scan, self.rows, self.metric = scan, scan.rows, scan.metric
        self.lists: Lists | None = None
        self.searches = 0  # of all rows, for each query
        self.pause = self.waited = 0

    def order(self, found: Candidates, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`SearchIndex.order`."""
        query = query.double()
        near, index, least = ordered(found, query, self.rows, self.metric, k)
        doubt = ~(found.score[:, -1] < least)
        if doubt.any():
            near[doubt], index[doubt] = self.scan.search(query[doubt], k)
        return near, index

    def candidates(self, query: Tensor, k: int) -> Candidates:
        """As :meth:`SearchIndex.candidates`."""
        query, kept = query.double(), self.scan.kept(k)
        longest = min(LIST_ENTRIES // max(1, query.numel()), len(self.rows) // SHARE)
        if longest < max(kept, ENOUGH * k) or len(query) == 0 or self.waited < self.pause:
            self.waited += 1
            return self._search_all(query, k)
        point = self.scan.unit(query) if self.metric == "cosine" else query
        lists = self.lists
        if lists is None or lists.row.shape != (len(query), longest):
            lists = self._made(query, point, longest)
        needed = self._needed(lists, point, k)
        fails = ~(needed < lists.reach)
        if fails.any() and lists is self.lists:
            lists = self._renewed(lists, fails, query, point)
            needed = self._needed(lists, point, k)
            fails = ~(needed < lists.reach)
        found = self._near(lists, point, needed.masked_fill(fails, 0.0), kept)
        if fails.any():
            for mine, other in zip(found, self._search_all(query[fails], k), strict=True):
                mine[fails] = other
        self.lists = lists._replace(served=lists.served + 1)
        return found

    def _search_all(self, query: Tensor, k: int) -> Candidates:
        self.searches += len(query)
        return self.scan.candidates(query, k)

    def _renewed(self, lists: Lists, fails: Tensor, query: Tensor, point: Tensor) -> Lists:
        # to make a list costs about two searches: those that last for less are not worth it
        useful = bool(lists.served[fails].double().mean() > 4)
        self.pause, self.waited = 0 if useful else min(2 * self.pause + 1, LONGEST_PAUSE), 0
        made = self._made(query[fails], point[fails], lists.row.shape[1])
        return Lists(*(o.index_put((fails,), n) for o, n in zip(lists, made, strict=True)))

    def _made(self, query: Tensor, point: Tensor, longest: int) -> Lists:
        """Lists of the ``longest`` best rows around each query [Q, D]."""
        self.searches += len(query)
        score, row = self.scan.best(query, longest)
        place = self.rows.index_select(0, row.flatten()).view(*row.shape, point.shape[-1]).double()
        if self.metric == "cosine":
            place = self.scan.unit(place)
        place = place.sub_(point[:, None]).float()
        square = place.square().sum(-1)
        # from an entry on: the order is that of rounded scores
        least = square.flip(-1).cummin(-1).values.flip(-1).sqrt() * (1 - 1e-5)
        # as far as a row can be whose score is not among the best
        length = 1.0 if self.metric == "cosine" else point.square().sum(-1) / 2
        reach = 2 * (length - score[:, -1].double() - self.scan.error(query))
        reach = torch.where(score[:, -1].isfinite(), reach, 0.0).clamp_min(0.0).sqrt()
        return Lists(point, row, place, -square / 2, least, reach, torch.zeros_like(row[:, 0]))

    def _scores(self, lists: Lists, point: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (m^2 - d^2) / 2 of the first rows of each list, [Q, count]; m and their error."""
        move = point - lists.centre
        score = torch.baddbmm(
            lists.offset[:, :count, None], lists.place[:, :count], move.float()[..., None]
        ).squeeze(-1)
        moved = move.square().sum(-1).sqrt()
        far = (-2 * lists.offset[:, :count].amin(-1).double()).sqrt()
        terms = 4 * (point.shape[-1] + 4) * torch.finfo(torch.float32).eps
        return score, moved, terms * far * (far + moved)

    def _needed(self, lists: Lists, point: Tensor, k: int) -> Tensor:
        """How far from its centre a list must reach to hold all k neighbours, [Q]."""
        score, moved, error = self._scores(lists, point, 2 * k)
        best = score.topk(k, dim=-1, sorted=False).values.amin(-1).double()
        nearest = (moved.square() - 2 * (best - error)).clamp_min(0.0).sqrt()
        # similarities are equal for distances that differ by rounding, or under cosine by its root
        slack = 1e-13 if self.metric == "cosine" else 1e-24 * (1 + point.square().sum(-1))
        return ((nearest + moved).square() * (1 + 1e-9) + slack).sqrt()

    def _near(self, lists: Lists, point: Tensor, needed: Tensor, kept: int) -> Candidates:
        """The best entries of each list that are not farther from its centre than ``needed``."""
        count = torch.searchsorted(lists.least, needed.float()[:, None], right=True)
        score, moved, error = self._scores(lists, point, max(kept, int(count.amax())))
        score, place = score.topk(kept, dim=-1)
        row = lists.row.gather(-1, place)
        found = Candidates(score.double(), row, error, moved.square() / 2)
        return rounded(found, self.metric, point.shape[-1])
