"""What every search structure answers."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from torchrl_rad.retrieval.choice import Candidates, Metric

__all__ = ["SearchIndex"]


class SearchIndex(ABC):
    """Rows that can be searched.

    Attributes:
        rows: [N, D].
        metric: ``"cosine"`` or ``"euclidean"``.
    """

    rows: Tensor
    metric: Metric

    def search(self, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The k most similar rows of each query.

        Args:
            query (Tensor): [Q, D], finite.
            k (int): at most the number of rows.

        Returns:
            Similarities, float64 [Q, k], falling, and row numbers, int64 [Q, k]; ties by the lower
            row.
        """
        return self.order(self.candidates(query, k), query, k)

    @abstractmethod
    def candidates(self, query: Tensor, k: int) -> Candidates:
        """Rows among which the k most similar ones are; arguments as of :meth:`search`."""

    @abstractmethod
    def order(self, found: Candidates, query: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """The answer of :meth:`search` from that of :meth:`candidates`."""
