"""Exact nearest rows: a chunked scan for any width, a k-d tree for few dims."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchrl_rad.retrieval.choice import (
    Candidates,
    Metric,
    most_similar,
    ordered,
    ranked,
    rounded,
    similarity,
)
from torchrl_rad.retrieval.index import SearchIndex

__all__ = ["ScanIndex", "TreeIndex"]

SCAN_ENTRIES = 2**20  # scores, or entries of states, that a search holds at a time
FEW_ENTRIES = 2**20  # of states: so few are compared in float64, which leaves no doubt
SPARE = 32  # rows ranked beyond k, at least
TINY, HUGE = 1e-15, 1e15  # sizes whose squares float32 holds


class ScanIndex(SearchIndex):
    """Compares a query with every row, in one matrix product a chunk; never holds queries x rows.

    The product is taken in float32, of few rows in float64, and gives each row a score with a known
    largest error. The best scores are ranked anew in float64; that no other row can be among the k
    follows from the error, and where it does not, all rows that could be are ranked. So answers are
    exact.

    Args:
        rows (Tensor): [N, D].
        metric (str): ``"cosine"`` or ``"euclidean"``.

    Examples:
        >>> index = ScanIndex(torch.tensor([[0.0], [2.0], [2.0], [5.0]]), "euclidean")
        >>> index.search(torch.tensor([[1.9]]), 2)[1]
        tensor([[1, 2]])
    """

    def __init__(self, rows: Tensor, metric: Metric):
        self.rows, self.metric = rows, metric
        # written in place: results kept between the copies would leave holes in memory
        size = torch.empty(len(rows), dtype=torch.float64, device=rows.device)
        chunk = max(1, SCAN_ENTRIES // rows.shape[-1])
        for part, norm in zip(rows.split(chunk), size.split(chunk), strict=True):
            norm.copy_(part.double().norm(dim=-1))
        self.largest = float(size.max()) if len(rows) else 0.0
        # beyond, squares leave the range of float32
        narrow = bool(((size == 0) | ((size > TINY) & (size < HUGE))).all()) and self.largest > 0
        narrow &= rows.numel() > FEW_ENTRIES
        self.factors = rows.float() if narrow else rows.double()  # no copy of float32 rows
        self.offset = -size.square() / 2 if metric == "euclidean" else 1.0 / size
        self.offset = self.offset.to(self.factors)

    def order(self, found: Candidates, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`SearchIndex.order`."""
        query = query.double()
        near, index, least = ordered(found, query, self.rows, self.metric, k)
        for row in (~(found.score[:, -1] < least)).nonzero().flatten().tolist():  # ties, mostly
            near[row], index[row] = self._above(query[row : row + 1], float(least[row]), k)
        return near, index

    def candidates(self, query: Tensor, k: int) -> Candidates:
        """As :meth:`SearchIndex.candidates`."""
        query = query.double()
        score, index = self.best(query, self.kept(k))
        square = query.square().sum(-1)
        base = square / 2 if self.metric == "euclidean" else torch.ones_like(square)
        found = Candidates(score.double(), index, self.error(query), base)
        return rounded(found, self.metric, query.shape[-1])

    def kept(self, k: int) -> int:
        """How many candidates there are for k neighbours."""
        return min(len(self.rows), k + max(SPARE, k // 4))

    def _scores(self, query: Tensor, begin: int, end: int) -> Tensor:
        """Scores [Q, end - begin] of some rows: cosine, or (|q|^2 - d^2) / 2 without the |q|^2."""
        rows, offset = self.factors[begin:end], self.offset[begin:end]
        if torch.get_float32_matmul_precision() != "highest":  # not even float32 then
            rows, offset = rows.double(), offset.double()
        with torch.autocast(rows.device.type, enabled=False):
            if self.metric == "euclidean":
                return torch.addmm(offset, query.to(rows.dtype), rows.T)
            # 0 x inf is NaN: a zero vector is similar to nothing
            return (self.unit(query).to(rows.dtype) @ rows.T).mul_(offset).nan_to_num_(-torch.inf)

    def best(self, query: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """The best scores of each query and their rows, [Q, count], falling."""
        chunk = max(count, SCAN_ENTRIES // max(1, len(query)))
        best, index = self._scores(query, 0, chunk).topk(count, dim=-1)
        for begin in range(chunk, len(self.rows), chunk):
            score = self._scores(query, begin, begin + chunk)
            better = score > best[:, -1:]
            if better.any():
                most = min(count, int(better.sum(-1).amax()))
                score, place = score.topk(most, dim=-1)
                best, order = torch.cat([best, score], -1).topk(count, dim=-1)
                index = torch.cat([index, place + begin], -1).gather(-1, order)
        return best, index

    def unit(self, query: Tensor) -> Tensor:
        """Vectors of length one; zeros stay."""
        return query / query.norm(dim=-1, keepdim=True).clamp_min(1e-300)

    def error(self, query: Tensor) -> Tensor:
        """How wrong a score of each query [Q, D] can be; float64 [Q]."""
        # twice the bound on rounding: of D products and their sums, of query and offset
        terms = 2 * (query.shape[-1] + 4)
        share, fine = (terms * torch.finfo(d).eps for d in (self.factors.dtype, torch.float64))
        size = query.norm(dim=-1)
        if self.metric == "cosine":
            return torch.full_like(size, share)
        wrong = share * self.largest * (size + self.largest) + fine * size.square()
        return torch.where(size < HUGE, wrong, torch.inf)

    def _above(self, query: Tensor, least: float, k: int) -> tuple[Tensor, Tensor]:
        """The k best of one query [1, D] among all rows that score ``least`` or more."""
        chunk = range(0, len(self.rows), SCAN_ENTRIES)
        fits = [~(self._scores(query, i, i + SCAN_ENTRIES)[0] < least) for i in chunk]
        index = torch.cat(fits).nonzero().T  # [1, C]
        near = similarity(query, self.rows[index[0]], self.metric)[None]
        near, index = most_similar(near, index)
        return near[0, :k], index[0, :k]


class TreeIndex(SearchIndex):
    """scipy's k-d tree for a few dims, with Euclidean similarity.

    Its answers are ranked anew, so that ties fall as in a scan.

    Args:
        rows (Tensor): [N, D] on the CPU.

    Examples:
        >>> index = TreeIndex(torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 0.0]]))
        >>> index.search(torch.tensor([[1.9, 0.0]]), 1)[1]
        tensor([[1]])
    """

    metric: Metric = "euclidean"

    def __init__(self, rows: Tensor):
        self.rows = rows.double().contiguous()
        self.tree = cKDTree(
            self.rows.numpy(), leafsize=32, balanced_tree=False, compact_nodes=False
        )

    def order(self, found: Candidates, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`SearchIndex.order`."""
        if found.score[:, -1:].isinf().any():  # too far for the tree, which then finds nothing
            return ScanIndex(self.rows, self.metric).search(query, k)
        query = query.double()
        near, index = ranked(found.row, query, self.rows, self.metric)
        if index.shape[1] > k:
            # the tree is free in what it takes among rows as far as the last one: look around
            tied = near[:, k] >= near[:, k - 1] * (1 - 1e-12)
            if tied.any():
                radius = (-2 * found.score[tied, k]).sqrt().numpy()
                near[tied, :k], index[tied, :k] = self._around(query[tied], radius, k)
        return near[:, :k], index[:, :k]

    def candidates(self, query: Tensor, k: int) -> Candidates:
        """As :meth:`SearchIndex.candidates`."""
        query, wanted = query.double(), min(k + 1, len(self.rows))
        distance, row = self.tree.query(query.numpy(), k=wanted)
        distance, row = distance.reshape(len(query), wanted), row.reshape(len(query), wanted)
        row = np.minimum(row, len(self.rows) - 1)  # one more means none: a query too far away
        score = torch.from_numpy(distance**2 * -0.5)
        # as of `rounding`, twice for the tree sums squares in another order; on few numbers numpy
        # is quicker than torch
        fine = 4 * (query.shape[-1] + 4) * np.finfo(np.float64).eps
        error = torch.from_numpy(fine * (1 + distance[:, -1]) ** 2)
        return Candidates(score, torch.from_numpy(row), error, torch.zeros_like(error))

    def _around(self, query: Tensor, radius: np.ndarray, k: int) -> tuple[Tensor, Tensor]:
        """All rows within the radius, ordered: exact among ties."""
        # a little more: distances so close give equal similarities
        found = self.tree.query_ball_point(query.double().numpy(), radius * (1 + 1e-9) + 1e-11)
        nears, indices = [], []
        for row, candidates in zip(query, found, strict=True):
            index = torch.tensor(candidates)
            near = similarity(row, self.rows[index], self.metric)
            near, index = most_similar(near[None], index[None])
            nears.append(near[:, :k])
            indices.append(index[:, :k])
        return torch.cat(nears), torch.cat(indices)
