"""Rows among which the neighbours are: the whole order of them, or one chosen by rank."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "Candidates",
    "Metric",
    "choose",
    "first_by_rank",
    "most_similar",
    "ordered",
    "ranked",
    "rounded",
    "similarity",
    "square_distance",
]

Metric = Literal["cosine", "euclidean"]
Number = TypeVar("Number", float, Tensor)


class Candidates(NamedTuple):
    """Rows among which the k most similar ones of each query are, by rounded scores.

    A score is ``base - d^2 / 2`` with d the Euclidean distance; under cosine similarity that of
    vectors of length one.

    Attributes:
        score: float64 [Q, C], falling; C >= k. No other row has a larger one than the last.
        row: int64 [Q, C], which they are.
        error: float64 [Q], how wrong a score can be, and how different those of rows can be besides
            that are equally similar, for similarities are rounded.
        base: float64 [Q].
    """

    score: Tensor
    row: Tensor
    error: Tensor
    base: Tensor


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
    if values.is_cpu:
        return values.cumsum(-1)[..., -1]
    total = values[..., 0]
    for dim in range(1, values.shape[-1]):
        total = total + values[..., dim]
    return total


def square_distance(similarity: Number, metric: Metric) -> Number:
    """The squared distance, as in :class:`Candidates`, of states that are so similar."""
    return 2 - 2 * similarity if metric == "cosine" else (1 / similarity - 1) ** 2


def ordered(
    found: Candidates, query: Tensor, rows: Tensor, metric: Metric, k: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The k most similar candidates in their order, ties by the lower row.

    Args:
        found (Candidates): for each query.
        query (Tensor): float64 [Q, D].
        rows (Tensor): [N, D].
        metric (str): of the similarity.
        k (int): number of neighbours.

    Returns:
        Similarity, float64 [Q, k], falling; row, int64 [Q, k]; and the score, float64 [Q], that a
        row as similar as the last one has at least: where a candidate lies below, none is missing.
    """
    near, index = (column[:, :k] for column in ranked(found.row, query, rows, metric))
    if found.row.shape[1] == len(rows):
        return near, index, torch.full_like(found.base, torch.inf)
    return near, index, found.base - square_distance(near[:, -1], metric) / 2 - found.error


def ranked(row: Tensor, query: Tensor, rows: Tensor, metric: Metric) -> tuple[Tensor, Tensor]:
    """Some rows [Q, C] of each query [Q, D] as :func:`most_similar` has them."""
    states = rows.index_select(0, row.flatten()).view(*row.shape, rows.shape[-1])
    return most_similar(similarity(query[:, None], states, metric), row)


def most_similar(near: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Most similar first, ties by the lower row: two [Q, C]."""
    near, order = near.sort(dim=-1, descending=True, stable=True)
    index = index.gather(-1, order)
    tied = (near[:, 1:] == near[:, :-1]).any(-1)
    if tied.any():
        places, order = index[tied].sort(dim=-1)
        again, ranked = near[tied].gather(-1, order).sort(dim=-1, descending=True, stable=True)
        near[tied], index[tied] = again, places.gather(-1, ranked)
    return near, index


def rounded(found: Candidates, metric: Metric, dims: int) -> Candidates:
    """The same with the error that comes from similarities being rounded, besides its own."""
    fine = 2 * (dims + 4) * torch.finfo(torch.float64).eps
    if metric == "cosine":
        return found._replace(error=found.error + 4 * fine)
    farthest = (2 * (found.base - found.score[:, -1])).clamp_min(0.0).sqrt()
    return found._replace(error=found.error + fine * (1 + farthest).square())


def first_by_rank(rank: Tensor, rows: Tensor, valid: Tensor) -> Tensor:
    """Place, int64 [Q, 1], of the first row of the highest rank among the valid ones.

    Args:
        rank (Tensor): int [N], not negative, of each row.
        rows (Tensor): int64 [Q, C].
        valid (Tensor): bool [Q, C]; where none is, the place is 0.

    Examples:
        >>> rows, valid = torch.tensor([[2, 0, 1]]), torch.tensor([[True, True, False]])
        >>> first_by_rank(torch.tensor([5, 9, 5]), rows, valid)
        tensor([[0]])
    """
    ranks = rank.index_select(0, rows.flatten()).view(rows.shape)
    return torch.where(valid, ranks, -1).argmax(-1, keepdim=True)


def choose(
    found: Candidates, rank: Tensor, threshold: float, metric: Metric, k: int
) -> tuple[Tensor, Tensor]:
    """Of the k most similar rows the one of the highest rank, of equals the most similar.

    Most of them need not be put in order for that.

    Args:
        found (Candidates): for each query.
        rank (Tensor): int [N], not negative, of each row.
        threshold (float): least similarity of a row that counts.
        metric (str): of the similarity.
        k (int): number of neighbours.

    Returns:
        Row, int64 [Q], and bool [Q] whether it is beyond doubt. Where rounding may hide the answer,
        or no row counts, it is not.

    Examples:
        >>> score = torch.tensor([[-0.1, -0.2, -0.3]], dtype=torch.float64)
        >>> error, base = torch.full((2, 1), 1e-9, dtype=torch.float64)
        >>> found = Candidates(score, torch.tensor([[4, 0, 2]]), error, base)
        >>> choose(found, torch.tensor([7, 0, 9, 0, 1]), 0.0, "euclidean", k=2)
        (tensor([0]), tensor([True]))
    """
    score, slack = found.score[:, :k], 2 * found.error
    rows = found.row[:, :k]
    far = square_distance(threshold, metric) if threshold > 0 or metric == "cosine" else math.inf
    above = score - (found.base - far / 2)[:, None]  # what the threshold asks for
    ranks = torch.where(above >= 0, rank.index_select(0, rows.flatten()).view(rows.shape), -1)
    best = ranks.amax(-1, keepdim=True)
    place = (ranks == best).byte().argmax(-1, keepdim=True)  # the first: scores fall
    row, top = rows.gather(-1, place)[:, 0], score.gather(-1, place)
    as_near = (ranks == best) & (score >= top - slack[:, None])
    sure = (as_near.sum(-1) == 1) & (best[:, 0] >= 0) & (above.abs().amin(-1) > slack)
    if found.score.shape[1] > k:
        sure &= score[:, -1] - found.score[:, k] > slack  # these k and no others
    elif k < len(rank):
        sure &= False
    return row, sure
