"""Exact nearest rows: a chunked scan for any width, a k-d tree for two or three dims."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

__all__ = ["Metric", "ScanIndex", "TreeIndex", "build_index", "similarity"]

Metric = Literal["cosine", "euclidean"]

SCAN_ENTRIES = 2**20  # scores, or entries of states, that a search holds at a time
SPARE = 32  # rows ranked beyond k, at least
TINY, HUGE = 1e-15, 1e15  # sizes whose squares float32 holds
TREE_DIMS = 3  # beyond, a scan of k in the hundreds is faster


def similarity(query: Tensor, rows: Tensor, metric: Metric) -> Tensor:
    r"""Similarity of states, in float64 and the same to the last bit for every batching.

    ``cosine`` is :math:`x \cdot s / (|x||s|)`, -inf where a vector is zero; ``euclidean`` is
    :math:`1 / (1 + |x - s|)`.

    Args:
        query (Tensor): [..., D], broadcast against ``rows``.
        rows (Tensor): [..., D].
        metric (str): ``"cosine"`` or ``"euclidean"``.

    Returns:
        float64 [...].

    Examples:
        >>> similarity(torch.tensor([0.0, 0.0]), torch.tensor([[3.0, 4.0]]), "euclidean")
        tensor([0.1667], dtype=torch.float64)
        >>> similarity(torch.tensor([1.0, 0.0]), torch.tensor([[2.0, 0.0], [0.0, 0.0]]), "cosine")
        tensor([1., -inf], dtype=torch.float64)
    """
    query, rows = query.double(), rows.double()
    if metric == "euclidean":
        return 1.0 / (1.0 + _sqrt(_sum_last((query - rows).square())))
    product = _sum_last(query * rows)
    size = _sqrt(_sum_last(query.square())) * _sqrt(_sum_last(rows.square()))
    return torch.where(size > 0, product / size.clamp_min(1e-300), -torch.inf)


def _sqrt(values: Tensor) -> Tensor:
    # torch's own on a CPU can be off by the last bit, which decides ties
    if values.is_cpu and not values.requires_grad:
        return torch.from_numpy(np.asarray(np.sqrt(values.numpy())))
    return values.sqrt()


def _sum_last(values: Tensor) -> Tensor:
    # one dim after the other: torch.sum orders its additions by the shape, so that a batch could
    # differ from one row
    total = values[..., 0]
    for dim in range(1, values.shape[-1]):
        total = total + values[..., dim]
    return total


def _order(similarity: Tensor, index: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k most similar of each row of candidates [Q, C], ties by the lower index: two [Q, k]."""
    similarity, order = similarity.sort(dim=-1, descending=True, stable=True)
    index = index.gather(-1, order)
    tied = (similarity[:, 1:] == similarity[:, :-1]).any(-1)
    if tied.any():
        places, order = index[tied].sort(dim=-1)
        near, ranked = similarity[tied].gather(-1, order).sort(dim=-1, descending=True, stable=True)
        similarity[tied], index[tied] = near, places.gather(-1, ranked)
    return similarity[:, :k], index[:, :k]


class ScanIndex:
    """Compares a query with every row, in one matrix product a chunk; never holds queries x rows.

    The product is taken in float32 and gives each row a score with a known largest error. The best
    scores are ranked anew in float64; that no other row can be among the k follows from the error,
    and where it does not, all rows that could be are ranked. So answers are exact.

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
        parts = rows.split(max(1, SCAN_ENTRIES // rows.shape[-1]))
        size = torch.cat([part.double().norm(dim=-1) for part in parts])
        self.largest = float(size.max()) if len(rows) else 0.0
        # beyond, squares leave the range of float32
        narrow = bool(((size == 0) | ((size > TINY) & (size < HUGE))).all()) and self.largest > 0
        self.factors = rows.float() if narrow else rows.double()  # no copy of float32 rows
        self.offset = -size.square() / 2 if metric == "euclidean" else 1.0 / size
        self.offset = self.offset.to(self.factors)

    def search(self, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k most similar rows of each query.

        Args:
            query (Tensor): [Q, D], finite.
            k (int): at most the number of rows.

        Returns:
            Similarities, float64 [Q, k], falling, and row numbers, int64 [Q, k]; ties by the lower
            row.
        """
        query = query.double()
        kept = min(len(self.rows), k + max(SPARE, k // 4))
        score, index = self._best(query, kept)
        near, index = _order(similarity(query[:, None], self.rows[index], self.metric), index, k)
        if kept < len(self.rows):
            least = self._least_score(query, near[:, -1])
            for row in (~(score[:, -1] < least)).nonzero().flatten().tolist():  # ties, mostly
                one = query[row : row + 1]
                index[row], near[row] = self._above(one, float(least[row]), k)
        return near, index

    def _scores(self, query: Tensor, begin: int, end: int) -> Tensor:
        """Scores [Q, end - begin] of some rows: cosine, or (|q|^2 - d^2) / 2 without the |q|^2."""
        rows, offset = self.factors[begin:end], self.offset[begin:end]
        if torch.get_float32_matmul_precision() != "highest":  # not even float32 then
            rows, offset = rows.double(), offset.double()
        with torch.autocast(rows.device.type, enabled=False):
            if self.metric == "euclidean":
                return torch.addmm(offset, query.to(rows.dtype), rows.T)
            # 0 x inf is NaN: a zero vector is similar to nothing
            return (self._unit(query).to(rows.dtype) @ rows.T).mul_(offset).nan_to_num_(-torch.inf)

    def _best(self, query: Tensor, count: int) -> tuple[Tensor, Tensor]:
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

    def _unit(self, query: Tensor) -> Tensor:
        return query / query.norm(dim=-1, keepdim=True).clamp_min(1e-300)

    def _least_score(self, query: Tensor, near: Tensor) -> Tensor:
        """What a row as similar as ``near`` [Q] scores at least; [Q]."""
        # twice the bound on rounding: of D products and their sums, of query and offset
        terms = 2 * (query.shape[-1] + 4)
        share, fine = (terms * torch.finfo(d).eps for d in (self.factors.dtype, torch.float64))
        if self.metric == "cosine":
            return near - share
        size = query.norm(dim=-1)
        distance = 1 / near - 1
        distance = distance + fine * (1 + distance)  # as far as rows can be that are as similar
        wrong = share * self.largest * (size + self.largest) + fine * size.square()
        least = (size.square() - distance.square()) / 2 - wrong
        return torch.where(size < HUGE, least, -torch.inf)

    def _above(self, query: Tensor, least: float, k: int) -> tuple[Tensor, Tensor]:
        """The k best of one query [1, D] among all rows that score ``least`` or more."""
        chunk = range(0, len(self.rows), SCAN_ENTRIES)
        fits = [~(self._scores(query, i, i + SCAN_ENTRIES)[0] < least) for i in chunk]
        index = torch.cat(fits).nonzero().T  # [1, C]
        near = similarity(query, self.rows[index[0]], self.metric)[None]
        near, index = _order(near, index, k)
        return index[0], near[0]


class TreeIndex:
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

    def search(self, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`ScanIndex.search`."""
        wanted = min(k + 1, len(self.rows))
        distance, places = self.tree.query(query.double().numpy(), k=np.arange(1, wanted + 1))
        if np.isinf(distance[:, -1:]).any():  # too far for the tree, which then finds nothing
            return ScanIndex(self.rows, self.metric).search(query, k)
        index = torch.from_numpy(places)
        near = self.rows.index_select(0, index.view(-1)).view(*index.shape, self.rows.shape[-1])
        near, index = _order(similarity(query[:, None], near, self.metric), index, wanted)
        if wanted > k:
            # the tree is free in what it takes among rows as far as the last one: look around
            tied = near[:, k] >= near[:, k - 1] * (1 - 1e-12)
            if tied.any():
                radius = distance[tied.numpy(), k]
                near[tied, :k], index[tied, :k] = self._around(query[tied], radius, k)
        return near[:, :k], index[:, :k]

    def _around(self, query: Tensor, radius: np.ndarray, k: int) -> tuple[Tensor, Tensor]:
        """All rows within the radius, ordered: exact among ties."""
        # a little more: distances so close give equal similarities
        found = self.tree.query_ball_point(query.double().numpy(), radius * (1 + 1e-9) + 1e-11)
        results = []
        for row, candidates in zip(query, found, strict=True):
            index = torch.tensor(candidates)
            near = similarity(row, self.rows[index], self.metric)
            results.append(_order(near[None], index[None], k))
        return torch.cat([r[0] for r in results]), torch.cat([r[1] for r in results])


def build_index(rows: Tensor, metric: Metric, backend: str) -> ScanIndex | TreeIndex:
    """The search structure for rows [N, D].

    ``backend`` is ``"scan"``, ``"tree"``, or ``"auto"`` for the faster of both.

    Raises:
        ValueError: a tree is asked for cosine similarity, or for rows that are not on the CPU.
    """
    fits = metric == "euclidean" and rows.device.type == "cpu"
    if backend == "tree" and not fits:
        raise ValueError(
            f"backend='tree' needs metric='euclidean' and rows on the CPU; got metric={metric!r} "
            f"on {rows.device}. Use backend='scan' or 'auto'."
        )
    if backend == "tree" or (backend == "auto" and fits and rows.shape[-1] <= TREE_DIMS):
        return TreeIndex(rows)
    return ScanIndex(rows, metric)
