"""The rows of several tables under one numbering, read where they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NoReturn

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

__all__ = ["ShardColumn", "ShardColumns", "ShardStorage"]


class ShardStorage(Storage):
    """A storage that is read only; its rows are those of some tables, one after the other.

    Args:
        limit (int): most rows that it can have.
    """

    device = torch.device("cpu")

    def __init__(self, limit: int = 2**62):
        super().__init__(limit)
        self.tables: list[TensorDictBase] = []
        self.shifts: list[int] = []  # added to the episode ids of each table
        self.ends = torch.zeros(0, dtype=torch.int64)  # row behind the last one of each table

    def put(self, tables: list[tuple[TensorDictBase, int]]) -> None:
        """Replaces all tables, each with what is added to its episode ids."""
        self.ends = torch.tensor([len(table) for table, _ in tables], dtype=torch.int64).cumsum(0)
        self.tables = [table for table, _ in tables]
        self.shifts = [shift for _, shift in tables]
        self._bump_mutation_revision()

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    def places(self, index: Tensor) -> Iterator[tuple[int, Tensor, Tensor]]:
        """For each table that some of the rows [M] are in: its number, which of them, where."""
        if len(index) and not (0 <= int(index.min()) and int(index.max()) < len(self)):
            raise IndexError(f"rows {int(index.min())} to {int(index.max())} of {len(self)}.")
        number = torch.searchsorted(self.ends, index, right=True)
        order = number.argsort(stable=True)
        numbers, counts = number[order].unique_consecutive(return_counts=True)
        which = order.split(counts.tolist())
        for table, part in zip(numbers.tolist(), which, strict=False):
            first = int(self.ends[table]) - len(self.tables[table])
            yield table, part, index[part] - first

    def get(self, index: Any) -> TensorDictBase:
        """Rows as a table of their own; ``index`` is a number, several, or a slice."""
        if isinstance(index, slice):
            index = torch.arange(*index.indices(len(self)))
        index = torch.as_tensor(np.asarray(index))
        if index.dtype == torch.bool:
            index = index.nonzero()[:, 0]
        flat = index.reshape(-1).long()
        flat = torch.where(flat < 0, flat + len(self), flat)
        parts, order = [], []
        for number, which, place in self.places(flat):
            rows = self.tables[number][place]
            parts.append(rows.set("episode", rows["episode"] + self.shifts[number]))
            order.append(which)
        if not parts:
            raise IndexError("no row is asked for, of a database beyond memory: name some.")
        rows = torch.cat(parts)[torch.cat(order).argsort()]
        return rows.reshape(index.shape)

    def column(self, key: NestedKey) -> ShardColumn:
        """One entry of all rows."""
        return ShardColumn(self, key)

    def _read_only(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise NotImplementedError(
            "the rows of a sharded database do not change: add episodes with extend(), or fill "
            "another one."
        )

    set = load_state_dict = _empty = _read_only

    def state_dict(self) -> dict[str, Any]:
        return {}  # the rows stay in their files


class ShardColumn:
    """One entry of all rows: a tensor [N, ...] of which only parts are read.

    Args:
        storage (ShardStorage): of the rows.
        key (NestedKey): of the entry.
    """

    def __init__(self, storage: ShardStorage, key: NestedKey):
        self.storage, self.key, self.device = storage, key, storage.device

    def __len__(self) -> int:
        return len(self.storage)

    def __getitem__(self, index: Tensor) -> Tensor:
        """Those of some rows, int64 of any shape."""
        values = self.index_select(0, index.reshape(-1))
        return values.reshape(*index.shape, *values.shape[1:])

    def index_select(self, dim: int, index: Tensor) -> Tensor:
        """Those of some rows, int64 [M]; as of a tensor, of which ``dim`` is 0."""
        return self.windows(index, 1)[:, 0]

    def windows(self, index: Tensor, length: int) -> Tensor:
        """Those of rows [M] and the next ones, [M, length, ...]; anything beyond an episode."""
        first = self.storage.tables[0].get(self.key)
        out = first.new_empty(len(index), length, *first.shape[1:])
        step = torch.arange(length)
        for number, which, place in self.storage.places(index):
            column = self.storage.tables[number].get(self.key)
            near = (place[:, None] + step).clamp_max(len(column) - 1)
            values = column.index_select(0, near.flatten()).view(*near.shape, *column.shape[1:])
            shift = self.storage.shifts[number] if self.key == "episode" else 0
            out[which] = values + shift if shift else values
        return out


class ShardColumns:
    """All entries, by their keys."""

    def __init__(self, storage: ShardStorage):
        self.storage = storage

    def __getitem__(self, key: NestedKey) -> ShardColumn:
        return self.storage.column(key)
