"""The nearest rows of all from the nearest rows of parts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_rad.retrieval.choice import most_similar

__all__ = ["Found", "merged"]

Found = tuple[Tensor, Tensor]  # similarities, float64 [Q, C], and rows, int64 [Q, C]


def merged(parts: Sequence[Found], k: int) -> Found:
    """The k most similar of the rows found in parts, most similar first, ties by the lower row.

    Args:
        parts (sequence): for each part of the rows its C most similar ones to each query; C may
            differ, and is k or the size of the part.
        k (int): number of neighbours.

    Returns:
        Similarities, float64 [Q, min(k, sum of C)], and rows, int64.

    Examples:
        >>> one = torch.tensor([[0.9, 0.5]]), torch.tensor([[3, 0]])
        >>> two = torch.tensor([[0.9, 0.7]]), torch.tensor([[8, 5]])
        >>> merged([two, one], 3)
        (tensor([[0.9000, 0.9000, 0.7000]]), tensor([[3, 8, 5]]))
    """
    near, rows = (torch.cat(column, -1) for column in zip(*parts, strict=True))
    if near.shape[-1] <= k:
        return most_similar(near, rows)
    best, place = near.topk(k + 1, dim=-1)
    tied = best[:, k] == best[:, k - 1]  # which of equals topk takes is its own choice
    found = most_similar(best[:, :k], rows.gather(-1, place[:, :k]))
    if tied.any():
        again = most_similar(near[tied], rows[tied])
        for column, values in zip(found, again, strict=True):
            column[tied] = values[:, :k]
    return found
