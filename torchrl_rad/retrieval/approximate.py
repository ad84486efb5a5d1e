"""Approximate neighbours by faiss, for databases too large for an exact search."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchrl_rad.retrieval.choice import (
    Candidates,
    Metric,
    most_similar,
    ordered,
    rounded,
    similarity,
    square_distance,
)
from torchrl_rad.retrieval.index import SearchIndex
from torchrl_rad.retrieval.search import ScanIndex

__all__ = ["FaissIndex"]

RECALL = 0.99  # least share of the true neighbours
SAMPLE = 200  # queries that it is measured with
MOST_PROBED = 4  # of so many cells one is looked at, at most: beyond, a scan is as fast


class FaissIndex(SearchIndex):
    """faiss's inverted file: rows in cells, of which those near a query are looked at.

    How many are, is found out when it is built: as few as find 99 % of the k nearest rows, measured
    on recorded rows that were moved a little. It holds a copy of the rows. Similarities are exact,
    and so is the order of the rows found.

    Args:
        rows (Tensor): [N, D] on the CPU.
        metric (str): ``"cosine"`` or ``"euclidean"``.
        k (int): number of neighbours that will be asked for.

    Attributes:
        recall: share of the k nearest rows that it found when it was built.

    Raises:
        ImportError: faiss is not installed.
        ValueError: a quarter of the cells does not suffice for 99 %; the message has the figure.
    """

    def __init__(self, rows: Tensor, metric: Metric, k: int):
        self.rows, self.metric, self.scan = rows, metric, ScanIndex(rows, metric)
        faiss = _faiss()
        cells = max(1, min(int(4 * math.sqrt(len(rows))), len(rows) // 39))  # faiss asks for 39
        self.index = faiss.IndexIVFFlat(faiss.IndexFlatL2(rows.shape[-1]), rows.shape[-1], cells)
        generator = torch.Generator().manual_seed(0)
        order = torch.randperm(len(rows), generator=generator)
        threads = faiss.omp_get_max_threads()
        faiss.omp_set_num_threads(1)  # sums in one order: the same cells every time
        try:
            self.index.train(self._points(rows[order[: 64 * cells]]))
        finally:
            faiss.omp_set_num_threads(threads)
        for part in rows.split(2**16):
            self.index.add(self._points(part))
        self._tune(rows[order[:SAMPLE]].double(), min(k, len(rows)), cells, generator)

    def _points(self, states: Tensor) -> Any:
        """As float32 array; of length one under cosine similarity, so that distances rank."""
        states = self.scan.unit(states.double()) if self.metric == "cosine" else states
        return states.float().contiguous().numpy()

    def _tune(self, states: Tensor, k: int, cells: int, generator: torch.Generator) -> None:
        aside = torch.randn(states.shape, generator=generator, dtype=torch.float64)
        query = states + 0.01 * aside * states.std(0, correction=0)
        exact = torch.cat([self.scan.search(part, k)[0] for part in query.split(16)])
        most = max(1, cells // MOST_PROBED)
        probes = 1
        while True:
            self.index.nprobe = min(probes, most)
            near = self._found(query, k)[0]
            self.recall = float((near >= exact[:, -1:]).double().mean())  # equals are as good
            if self.recall >= RECALL:
                return
            if probes >= most:
                raise ValueError(
                    f"faiss finds {self.recall:.3f} of the {k} nearest rows in {most} of {cells} "
                    f"cells; {RECALL} are asked for. Use backend='auto', which is exact."
                )
            probes *= 2

    def _found(self, query: Tensor, k: int) -> tuple[Tensor, Tensor, Tensor]:
        """Similarity and row of k rows found, most similar first; and where some are missing."""
        row = torch.from_numpy(self.index.search(self._points(query), k)[1])
        missing = (row < 0).any(-1)
        states = self.rows.index_select(0, row.clamp_min(0).flatten()).view(*row.shape, -1)
        near = similarity(query.double()[:, None], states, self.metric)
        near, row = most_similar(torch.where(row < 0, -torch.inf, near), row)
        return near, row, missing

    def search(self, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """As :meth:`SearchIndex.search`, but some rows may be others, less similar."""
        if len(query) == 0:
            return self.scan.search(query, k)
        near, row, missing = self._found(query, k)
        if missing.any():  # the cells looked at hold fewer than k rows
            near[missing], row[missing] = self.scan.search(query[missing], k)
        return near, row

    def candidates(self, query: Tensor, k: int) -> Candidates:
        """As :meth:`SearchIndex.candidates`, of the rows found."""
        near, row = self.search(query, min(k + 1, len(self.rows)))
        zero = torch.zeros(len(query), dtype=torch.float64)
        found = Candidates(-square_distance(near, self.metric) / 2, row, zero, zero)
        return rounded(found, self.metric, query.shape[-1])

    def order(self, found: Candidates, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        near, row, _ = ordered(found, query.double(), self.rows, self.metric, k)
        return near, row


def _faiss() -> Any:
    try:
        import faiss
    except ImportError as error:
        raise ImportError(
            "backend='faiss' needs faiss: pip install \"torchrl_rad[faiss]\"; or use "
            "backend='auto', which is exact."
        ) from error
    return faiss
