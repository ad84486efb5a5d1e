"""Exact nearest rows: a chunked scan for any width, a k-d tree for two or three dims."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

__all__ = ["Metric", "ScanIndex", "TreeIndex", "build_index", "similarity"]

Metric = Literal["cosine", "euclidean"]

SCAN_ENTRIES = 2**22  # entries of states that a search compares at a time
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
    """Compares a query with every row, a chunk at a time; never holds queries x rows.

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

    def search(self, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k most similar rows of each query.

        Args:
            query (Tensor): [Q, D], finite.
            k (int): at most the number of rows.

        Returns:
            Similarities, float64 [Q, k], falling, and row numbers, int64 [Q, k]; ties by the lower
            row.
        """
        count = len(self.rows)
        chunk = max(k, SCAN_ENTRIES // max(1, len(query) * self.rows.shape[-1]))
        best = query.new_empty(len(query), 0, dtype=torch.float64)
        index = torch.empty(len(query), 0, dtype=torch.int64, device=query.device)
        for begin in range(0, count, chunk):
            rows = self.rows[begin : begin + chunk]
            near = similarity(query[:, None], rows, self.metric)  # [Q, chunk]
            kept, place = _leading(near, min(k, near.shape[-1]))
            best = torch.cat([best, kept], -1)
            index = torch.cat([index, place + begin], -1)
            best, index = _order(best, index, min(k, best.shape[-1]))
        return best, index


def _leading(near: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Top k of [Q, C], where of equal values at the border those in the lower places are taken."""
    if k == near.shape[-1]:
        return near, torch.arange(k, device=near.device).expand(len(near), k)
    border = near.topk(k, dim=-1, sorted=False).values.amin(-1, keepdim=True)
    above = near > border
    room = k - above.sum(-1, keepdim=True)
    equal = near == border
    take = above | (equal & (equal.cumsum(-1) <= room))  # exactly k a row
    place = take.nonzero()[:, 1].reshape(len(near), k)
    return near.gather(-1, place), place


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
