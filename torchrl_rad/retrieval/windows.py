"""The largest value in any window of rows, without looking at each row of it."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["WindowMax"]


class WindowMax:
    """Maxima over rows i..j of a column, and the first row there that comes close to a given value.

    A sparse table: level p holds the maximum of the 2^p rows from each row on. A query reads two
    entries, or one a level, whatever the length of the window.

    Args:
        values (Tensor): [N].
        longest (int, optional): rows of the longest window that will be asked for.
            Defaults to all.

    Examples:
        >>> table = WindowMax(torch.tensor([1.0, 3.0, 2.0, 3.0]))
        >>> table.max(torch.tensor([0, 2]), torch.tensor([2, 2]))
        tensor([3., 2.])
        >>> table.first(torch.tensor([0, 2]), torch.tensor([3, 3]), torch.tensor(3.0), 0.0)
        tensor([1, 3])
    """

    def __init__(self, values: Tensor, longest: int | None = None):
        self.values = values
        self.longest = min(len(values), len(values) if longest is None else longest)
        levels = [values]
        while 2 << (len(levels) - 1) <= self.longest:
            span = 1 << (len(levels) - 1)
            # near the end a window is cut: entries there are never read as full windows
            shifted = torch.cat([levels[-1][span:], levels[-1][-1:].expand(span)])
            levels.append(torch.maximum(levels[-1], shifted))
        self.table = torch.stack(levels)  # [levels, N]

    def max(self, low: Tensor, high: Tensor) -> Tensor:
        """Maximum over rows low..high, both included; ``low <= high``, int64 of any shape."""
        level = torch.log2((high - low + 1).double()).floor().long()
        return torch.maximum(self.table[level, low], self.table[level, high - (1 << level) + 1])

    def first(self, low: Tensor, high: Tensor, best: Tensor, tolerance: float) -> Tensor:
        """First row in low..high whose value is at most ``tolerance`` below ``best``.

        ``high + 1`` if there is none.
        """
        row = low.clone()
        for level in range(len(self.table) - 1, -1, -1):
            span = 1 << level
            fits = row + span <= high + 1
            here = self.table[level][row.clamp_max(len(self.values) - 1)]
            # float64: the difference of two float32 would be rounded
            misses = best.double() - here.double() > tolerance
            row = torch.where(fits & misses, row + span, row)
        return row
