"""The list of shards of a sharded database, and how one of them is opened."""

from __future__ import annotations

import dataclasses
import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_rad._files import CheckpointError, read_json, write_json
from torchrl_rad.data.database import ExpertDatabase

__all__ = [
    "LIST",
    "Shard",
    "ShardList",
    "describe",
    "list_state",
    "moments",
    "open_shard",
    "read_list",
    "scale_of",
]

LIST = "shards.json"
FORMAT = 1  # raise it when the content of the list changes
CHUNK = 2**20  # numbers that are held in float64 at a time


@dataclass(frozen=True)
class Shard:
    """One entry of the list.

    Attributes:
        path: of its folder, seen from that of the list.
        rows: how many it has.
        last: highest episode id, as the whole database has it.
        shift: what is added to the ids in its file for that.
        width: entries of a state.
        mean, spread, low, high: of each entry of its states: mean, sum of the squared distances
            from it, least, largest.
    """

    path: str
    rows: int
    last: int
    shift: int
    width: int
    mean: list[float]
    spread: list[float]
    low: list[float]
    high: list[float]


@dataclass(frozen=True)
class ShardList:
    """What the list says.

    Attributes:
        config: settings of a database that holds one shard.
        shards: in the order of their rows.
    """

    config: dict[str, Any]
    shards: tuple[Shard, ...] = ()

    def write(self, folder: Path) -> None:
        """Replaces the list of a folder in one step."""
        shards = [dataclasses.asdict(shard) for shard in self.shards]
        write_json(folder / LIST, {"format": FORMAT, "config": self.config, "shards": shards})

    def free_id(self) -> int:
        """The lowest episode id above all that are in use."""
        return max((shard.last + 1 for shard in self.shards), default=0)


def read_list(folder: Path) -> ShardList:
    """Reads the list of a folder.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it is damaged or of another format.
    """
    if not (folder / LIST).is_file():
        raise FileNotFoundError(
            f"{folder} holds no sharded database: {LIST} is missing (seen from "
            f"{socket.gethostname()}). Pass a folder that ShardedExpertDatabase.create made; a "
            "process on another machine needs it under the same path, on a shared drive."
        )
    content = read_json(folder / LIST)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(
            f"{folder / LIST} is no list of shards in the format {FORMAT}, which this version "
            "reads; fill the database anew."
        )
    try:
        shards = [Shard(**entry) for entry in content["shards"]]
        return ShardList(content["config"], tuple(shards))
    except (KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / LIST} is damaged: {error!r}.") from error


def list_state(folder: Path) -> tuple[int, int, int]:
    """What changes when the list is replaced; cheap to ask for."""
    found = os.stat(folder / LIST)
    return found.st_ino, found.st_mtime_ns, found.st_size


def open_shard(folder: Path, shard: Shard, gamma: float, key: Any) -> ExpertDatabase:
    """Opens a shard memory-mapped.

    Raises:
        CheckpointError: it is missing, damaged, or not the one that the list tells of.
    """
    path = folder / shard.path
    if not (path / "database.json").exists():
        raise CheckpointError(
            f"{path} is missing, though {LIST} lists it (seen from {socket.gethostname()}). Restore"
            " it; workers on other machines need the folder under the same path, on a shared drive."
        )
    database = ExpertDatabase.loads(path, memmap=True)
    check_fits(path, database, gamma, key, shard.width)
    if len(database) != shard.rows:
        raise CheckpointError(
            f"{path} has {len(database)} rows, {LIST} says {shard.rows}; it was replaced by another"
            " database. Restore it."
        )
    return database


def check_fits(
    path: Path | None, database: ExpertDatabase, gamma: float, key: Any, width: int
) -> None:
    """Checks that a database can be a shard.

    Raises:
        CheckpointError: it has another discount, no such states, or states of another width.
    """
    if database.gamma != gamma:
        raise CheckpointError(
            f"{path} has gamma {database.gamma}, the other shards have {gamma}: their returns do "
            "not compare. Fill it anew with the same gamma."
        )
    states = database.storage[:].get(key, None)
    if not isinstance(states, Tensor) or states.shape[-1] != width:
        got = None if states is None else states.shape[-1]
        raise CheckpointError(
            f"the states {key!r} of {path} have {got} entries, those of the other shards {width}; "
            "they cannot be searched together."
        )


def describe(path: str, database: ExpertDatabase, key: Any, shift: int) -> Shard:
    """The entry for a saved database."""
    rows = database.storage[:]
    ids, states = rows["episode"], rows.get(key)
    mean, spread, low, high = (column.tolist() for column in moments(states))
    return Shard(
        path, len(ids), int(ids.max()) + shift, shift, states.shape[-1], mean, spread, low, high
    )


def moments(states: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean, sum of squared distances from it, least and largest: float64 [S], of states [N, S].

    Examples:
        >>> [column.tolist() for column in moments(torch.tensor([[1.0], [3.0]]))]
        [[2.0], [2.0], [1.0], [3.0]]
    """
    parts = states.split(max(1, CHUNK // states.shape[-1]))
    mean = sum(part.double().sum(0) for part in parts) / len(states)
    assert isinstance(mean, Tensor)
    spread = sum((part.double() - mean).square().sum(0) for part in parts)
    assert isinstance(spread, Tensor)
    low = torch.stack([part.amin(0) for part in parts]).amin(0)
    high = torch.stack([part.amax(0) for part in parts]).amax(0)
    return mean, spread, low.double(), high.double()


def scale_of(
    parts: Sequence[tuple[int, tuple[Tensor, Tensor, Tensor, Tensor]]],
) -> tuple[Tensor, Tensor]:
    """Mean and deviation, float64 [S], of all rows from the :func:`moments` of parts of them.

    A constant entry has deviation 1.

    Args:
        parts (sequence): number of rows and their moments.

    Examples:
        >>> states = torch.tensor([[1.0], [3.0], [8.0]])
        >>> mean, deviation = scale_of([(2, moments(states[:2])), (1, moments(states[2:]))])
        >>> bool(torch.isclose(deviation, states.double().std(0, correction=0)))
        True
    """
    count = torch.tensor([rows for rows, _ in parts], dtype=torch.float64)[:, None]
    columns = zip(*(own for _, own in parts), strict=True)
    mean, spread, low, high = (torch.stack(column) for column in columns)
    whole = (count * mean).sum(0) / count.sum()
    square = (spread + count * (mean - whole).square()).sum(0) / count.sum()
    return whole, torch.where(high.amax(0) > low.amin(0), square.sqrt(), 1.0)
