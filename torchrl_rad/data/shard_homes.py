"""Where shards are searched: in this process, in others, or in Ray actors."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from torchrl_rad.data.shards import Shard, open_shard
from torchrl_rad.retrieval.merged import Found, merged
from torchrl_rad.retrieval.sampler import RetrievalSampler
from torchrl_rad.retrieval.search import TreeIndex

__all__ = ["WORKERS", "Home", "ScaledSampler", "ShardGroup", "make_homes"]

WORKERS = ("process", "ray")
FOUND_ENTRIES = 2**22  # rows found in all shards that are held at a time
SPARE = 16  # rows of a shard looked at beyond twice its share of the neighbours

Scale = tuple[np.ndarray, np.ndarray]  # mean and deviation of a state, float64 [S]


class ScaledSampler(RetrievalSampler):
    """Standardises, on demand, by the mean and deviation of more rows than its own."""

    scale: tuple[Tensor, Tensor]

    def set_scale(self, scale: Scale) -> None:
        self.scale = tuple(map(torch.from_numpy, scale))  # type: ignore[assignment]
        self.invalidate()

    def fit_scale(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        if self.dims is None:
            return self.scale
        return self.scale[0][self.dims], self.scale[1][self.dims]


class ShardGroup:
    """Searches some shards, one after the other; each has a search structure of its own.

    Args:
        config (dict): of the sampler.
    """

    def __init__(self, config: dict[str, Any]):
        self.config = config
        self.parts: list[tuple[int, Any, ScaledSampler]] = []  # first row, storage, sampler

    def open(self, folder: str, shard: Shard, first: int, gamma: float) -> None:
        """Opens a shard, whose first row has a number in the whole database, by its path."""
        self.add(first, open_shard(Path(folder), shard, gamma, self.config["key"]).storage)

    def add(self, first: int, storage: Any) -> None:
        """Takes a storage in place of a shard that is opened by its path."""
        self.parts.append((first, storage, ScaledSampler(**self.config)))

    def set_scale(self, scale: Scale) -> None:
        """Mean and deviation of all rows of the database, for ``normalize``."""
        for _, _, sampler in self.parts:
            sampler.set_scale(scale)

    def nearest(self, query: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """The nearest rows among all shards of the group.

        Args:
            query (array): float64 [Q, S].
            k (int): how many.

        Returns:
            Similarities, float64 [Q, C], falling, and rows of the database, int64 [Q, C], ties by
            the lower one; C is k, or the number of rows if that is less.
        """
        if not self.parts:
            return np.empty((len(query), 0)), np.empty((len(query), 0), dtype=np.int64)
        most = max(1, FOUND_ENTRIES // (k * len(self.parts)))
        found = [self._merged(part, k) for part in torch.from_numpy(query).split(most)]
        near, rows = (torch.cat(column) for column in zip(*found, strict=True))
        return near.numpy(), rows.numpy()

    def _merged(self, query: Tensor, k: int) -> Found:
        depth = min(k, 2 * math.ceil(k / len(self.parts)) + SPARE)
        # a tree is the quicker the less it is asked for; a scan is not, and would be done twice
        if depth == k or not self._are_trees():
            return merged([self._part(number, query, k) for number in range(len(self.parts))], k)
        found = [self._part(number, query, depth) for number in range(len(self.parts))]
        near, _ = merged(found, k)
        least = near[:, -1] if near.shape[1] == k else torch.full_like(near[:, 0], -torch.inf)
        for number, (own, rows) in enumerate(found):
            # a shard whose last row found is farther than k others can have no more of them
            doubt = own[:, -1] >= least
            if len(self.parts[number][1]) <= depth or not doubt.any():
                continue
            more = self._part(number, query[doubt], k)
            pad = (0, more[0].shape[1] - own.shape[1])
            own = torch.nn.functional.pad(own, pad, value=-torch.inf)
            rows = torch.nn.functional.pad(rows, pad, value=-1)
            own[doubt], rows[doubt] = more
            found[number] = own, rows
        return merged(found, k)

    def _are_trees(self) -> bool:
        return all(
            isinstance(sampler.build(storage), TreeIndex) for _, storage, sampler in self.parts
        )

    def _part(self, number: int, query: Tensor, k: int) -> Found:
        first, storage, sampler = self.parts[number]
        rows, near = sampler.nearest(storage, query, k)
        return near, torch.where(rows >= 0, rows + first, -1)


class Home(Protocol):
    """A place where a :class:`ShardGroup` is."""

    def call(self, name: str, *args: Any) -> Callable[[], Any]:
        """Begins a method of the group; what is returned waits for its result."""

    def close(self) -> None:
        """Gives the place up."""


class LocalHome:
    """This process."""

    def __init__(self, config: dict[str, Any]):
        self.group = ShardGroup(config)

    def call(self, name: str, *args: Any) -> Callable[[], Any]:
        return partial(getattr(self.group, name), *args)

    def close(self) -> None:
        self.group.parts.clear()


class ProcessHome:
    """A process of its own on this machine."""

    def __init__(self, config: dict[str, Any]):
        self.pool = ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), _start, (config, torch.get_num_threads())
        )

    def call(self, name: str, *args: Any) -> Callable[[], Any]:
        return self.pool.submit(_call, name, *args).result

    def close(self) -> None:
        self.pool.shutdown(wait=False, cancel_futures=True)


_group: ShardGroup  # in a process of ProcessHome


def _start(config: dict[str, Any], threads: int) -> None:
    global _group
    torch.set_num_threads(threads)
    _group = ShardGroup(config)


def _call(name: str, *args: Any) -> Any:
    return getattr(_group, name)(*args)


class RayHome:
    """A Ray actor, on any machine of the cluster that sees the folder."""

    def __init__(self, config: dict[str, Any]):
        try:
            import ray
        except ImportError as error:
            raise ImportError(
                'workers="ray" needs Ray: pip install "torchrl_rad[ray]", or use '
                'workers="process" for processes of this machine.'
            ) from error
        self.ray: Any = ray
        self.actor = self.ray.remote(ShardGroup).remote(config)

    def call(self, name: str, *args: Any) -> Callable[[], Any]:
        return partial(self.ray.get, getattr(self.actor, name).remote(*args))

    def close(self) -> None:
        if self.ray.is_initialized():  # its end was the actor's; to ask it would start it anew
            self.ray.kill(self.actor)


def make_homes(workers: str | None, count: int, config: dict[str, Any]) -> list[Home]:
    """``count`` places of a kind of ``WORKERS``; this process if it is None."""
    if workers is None:
        return [LocalHome(config)]
    kind = ProcessHome if workers == "process" else RayHome
    return [kind(config) for _ in range(count)]
