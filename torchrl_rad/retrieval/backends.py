"""Which search structure serves some rows."""

from __future__ import annotations

from torch import Tensor

from torchrl_rad.retrieval.approximate import FaissIndex
from torchrl_rad.retrieval.choice import Metric
from torchrl_rad.retrieval.index import SearchIndex
from torchrl_rad.retrieval.joint import JointIndex
from torchrl_rad.retrieval.lists import ListIndex
from torchrl_rad.retrieval.search import ScanIndex, TreeIndex

__all__ = ["BACKENDS", "build_index", "grow_index"]

BACKENDS = ("auto", "scan", "tree", "faiss")
TREE_DIMS = 3  # beyond, a scan of k in the hundreds is faster


def build_index(rows: Tensor, metric: Metric, backend: str, k: int) -> SearchIndex:
    """The search structure for rows [N, D] of which k are asked for.

    ``backend`` is one of ``BACKENDS``; ``"auto"`` takes what is fastest along a trajectory.

    Raises:
        ImportError: faiss is asked for and is not installed.
        ValueError: a tree is asked for cosine similarity, a tree or faiss for rows that are not on
            the CPU; faiss misses too many neighbours.
    """
    fits = metric == "euclidean" and rows.device.type == "cpu"
    if backend == "faiss":
        if rows.device.type != "cpu":
            raise ValueError(
                f"backend='faiss' needs rows on the CPU, got {rows.device}. Use backend='auto'."
            )
        return FaissIndex(rows, metric, k)
    if backend == "tree" and not fits:
        raise ValueError(
            f"backend='tree' needs metric='euclidean' and rows on the CPU; got metric={metric!r} "
            f"on {rows.device}. Use backend='scan' or 'auto'."
        )
    if backend == "tree" or (backend == "auto" and fits and rows.shape[-1] <= TREE_DIMS):
        return TreeIndex(rows)
    scan = ScanIndex(rows, metric)
    # on a GPU a scan takes less time than the comparison of two queries
    return ListIndex(scan) if backend == "auto" and rows.device.type == "cpu" else scan


def grow_index(
    index: SearchIndex, rows: Tensor, metric: Metric, backend: str, k: int
) -> SearchIndex:
    """The search structure for rows [N, D] of which the first ones are those of ``index``.

    Those behind get a structure of their own, until they are a fifth of all: each row is then
    looked at some five times however often rows are added.
    """
    first = index.first if isinstance(index, JointIndex) else index
    count = len(first.rows)
    if 5 * (len(rows) - count) >= len(rows):
        return build_index(rows, metric, backend, k)
    # faiss wants many rows, and measures its recall: few are searched exactly
    behind = build_index(rows[count:], metric, "auto" if backend == "faiss" else backend, k)
    return JointIndex(rows, first, behind)
