"""The sampler of a sharded database: asks where the shards are, and merges what comes back."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.shard_homes import Home, LocalHome, make_homes
from torchrl_rad.data.shards import Shard, moments, scale_of
from torchrl_rad.retrieval.backends import build_index
from torchrl_rad.retrieval.index import SearchIndex
from torchrl_rad.retrieval.merged import merged
from torchrl_rad.retrieval.sampler import RetrievalSampler

__all__ = ["ShardSampler"]


class ShardSampler(RetrievalSampler):
    """Exact neighbours among all shards.

    Args:
        config (dict): of the sampler.
        folder (Path): of the shards.
        gamma (float): of the shards.
        workers (str, optional): see :func:`~torchrl_rad.data.shard_homes.make_homes`.
        count (int): number of them.
    """

    def __init__(
        self, config: dict[str, Any], folder: Path, gamma: float, workers: str | None, count: int
    ):
        super().__init__(**config)
        self.folder, self.gamma, self.workers, self.count = folder, gamma, workers, count
        self.shards: tuple[Shard, ...] = ()
        self.opened: list[ExpertDatabase] = []
        self.tail: ExpertDatabase | None = None
        self.homes: list[Home] | None = None
        self.tail_home: Home | None = None
        self.told = 0  # how many shards the homes have
        self.stale = True  # the scale that the homes have
        self._moments: tuple[np.ndarray, np.ndarray] | None = None  # of all rows

    def hold(
        self,
        shards: tuple[Shard, ...],
        opened: list[ExpertDatabase],
        tail: ExpertDatabase | None,
    ) -> None:
        """Takes the shards, open as they are here, and rows that are not in a shard yet."""
        if tail is not self.tail:
            self.tail_home = None
        self.shards, self.opened, self.tail = shards, opened, tail
        self.stale, self._scale, self._moments = True, None, None

    def nearest(
        self, storage: Any, query: Tensor, k: int | None = None, among: SearchIndex | None = None
    ) -> tuple[Tensor, Tensor]:
        """As :meth:`RetrievalSampler.nearest`."""
        if among is not None:
            return super().nearest(storage, query, k, among)
        k = min(self.k if k is None else k, len(storage))
        if k == 0:
            rows = torch.full((len(query), 0), -1)
            return rows, torch.empty(len(query), 0, dtype=torch.float64)
        width = self._states_width(storage)
        self._check_query(query, width)
        self._check_dims(width)
        asked = query.detach().to("cpu", torch.float64).numpy()
        try:
            waits = [home.call("nearest", asked, k) for home in self._told_homes()]
            found = [tuple(map(torch.tensor, wait())) for wait in waits]
        except BrokenExecutor as error:
            self.close()
            raise RuntimeError(
                "a process that searches shards ended: it was killed, or memory ran out. The next "
                "query starts new ones; fewer of them need less memory."
            ) from error
        except BaseException:
            self.close()  # some homes may know of shards that others do not
            raise
        near, rows = merged(found, k)  # type: ignore[arg-type]
        return rows, near

    def best(self, storage: Any, query: Tensor, rank: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raise NotImplementedError("a sharded database ranks no rows beforehand.")

    def build(self, storage: Any) -> Any:
        """The storage: it stays the same object, whatever is added."""
        return storage

    def compared(self, storage: Any) -> int:
        """As :meth:`RetrievalSampler.compared`."""
        return self._states_width(storage) if self.dims is None else len(self.dims)

    def subset(self, storage: Any, rows: Tensor) -> SearchIndex:
        """As :meth:`RetrievalSampler.subset`; it is here, in memory, whatever the workers."""
        self._fit(storage)
        states = storage.column(self.key).index_select(0, rows)
        return build_index(self._prepare(states), self.metric, "auto", self.k)

    def _ready(self, storage: Any, query: Tensor) -> tuple[Any, Tensor, Tensor | None]:
        self._fit(storage)
        return None, *self._asked(query, "cpu")

    def _states_width(self, storage: Any) -> int:
        return storage.tables[0].get(self.key).shape[-1]

    def _fit(self, storage: Any) -> None:
        """Takes width and scale of the rows as they are now, for a search that is made here."""
        self._width = self._states_width(storage)
        self._check_dims(self._width)
        if self.normalize and self._scale is None:
            mean, deviation = map(torch.from_numpy, self._scale_of_all())
            dims = slice(None) if self.dims is None else self.dims
            self._scale = mean[dims], deviation[dims]

    def invalidate(self) -> None:
        """Drops all search structures and ends the workers; the next query starts new ones."""
        super().invalidate()
        self.close()

    def close(self) -> None:
        """Ends the workers."""
        for home in getattr(self, "homes", None) or []:
            home.close()
        self.homes, self.told, self.stale = None, 0, True

    # where the shards are

    def _told_homes(self) -> list[Home]:
        """The homes, each with its shards, and one for the tail."""
        if self.homes is None:
            self.homes = make_homes(self.workers, self.count, self.config)
        waits = [self._tell(number) for number in range(self.told, len(self.shards))]
        for wait in waits:
            wait()
        homes = list(self.homes)
        if self.tail is not None:
            homes.append(self._home_of_tail(self.tail))
        if self.stale and self.normalize:
            scale = self._scale_of_all()
            for wait in [home.call("set_scale", scale) for home in homes]:
                wait()
        self.told, self.stale = len(self.shards), False
        return homes

    def _tell(self, number: int) -> Callable[[], Any]:
        assert self.homes is not None
        shard, home = self.shards[number], self.homes[number % len(self.homes)]
        first = sum(before.rows for before in self.shards[:number])
        if isinstance(home, LocalHome):
            return home.call("add", first, self.opened[number].storage)
        return home.call("open", str(self.folder), shard, first, self.gamma)

    def _home_of_tail(self, tail: ExpertDatabase) -> Home:
        """The rows that are in no shard yet are searched here, whatever the workers."""
        if self.tail_home is None:
            home = LocalHome(self.config)
            first = sum(shard.rows for shard in self.shards)
            home.group.parts.append((first, tail.storage, tail.sampler))  # type: ignore[arg-type]
            self.tail_home = home
        return self.tail_home

    def _scale_of_all(self) -> tuple[np.ndarray, np.ndarray]:
        if self._moments is not None:
            return self._moments
        names = ("mean", "spread", "low", "high")
        parts = []
        for shard in self.shards:
            own = (torch.tensor(getattr(shard, name), dtype=torch.float64) for name in names)
            parts.append((shard.rows, tuple(own)))
        if self.tail is not None:
            states = self.tail.storage[:].get(self.key)
            parts.append((len(states), moments(states)))
        mean, deviation = scale_of(parts)  # type: ignore[arg-type]
        self._moments = mean.numpy(), deviation.numpy()
        return self._moments
