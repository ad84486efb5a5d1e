"""An expert database beyond memory: shards on disk that are searched as one."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NoReturn, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_rad._files import STAGE
from torchrl_rad.data.checks import check_same_columns, flat_steps
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.growth import stored_lengths
from torchrl_rad.data.saved import build
from torchrl_rad.data.shard_homes import WORKERS, ScaledSampler
from torchrl_rad.data.shard_sampler import ShardSampler
from torchrl_rad.data.shard_storage import ShardColumns, ShardStorage
from torchrl_rad.data.sharded_saving import SavedShards
from torchrl_rad.data.shards import (
    LIST,
    ShardList,
    check_fits,
    describe,
    list_state,
    open_shard,
    read_list,
)
from torchrl_rad.retrieval.sampler import RetrievalSampler, storage_revision

__all__ = ["ShardedExpertDatabase", "load_database"]


class ShardedExpertDatabase(SavedShards):
    """Demonstrations on disk, in shards of whole episodes, searched as one database.

    It answers what :class:`~torchrl_rad.data.ExpertDatabase` answers, exactly, with as many rows as
    the disk holds: each shard is a saved ExpertDatabase, opened memory-mapped, with a search
    structure of its own; the nearest rows of all are merged from those of each. Rows are numbered
    through all shards, in the order in which they were added, and only ever added.

    :meth:`extend` gathers episodes in memory, where this object finds them at once, and closes a
    shard whenever it is full; :meth:`flush` closes one early. One process at a time may add.
    Others that have the folder open see a shard as soon as it is closed. What is in no shard yet is
    lost with the process.

    In memory are, a row, the entries compared (8 bytes each) and some 16 bytes for the tree where
    at most three are compared, else 4 bytes and, with ``normalize=True``, 12 for each entry.

    ``deepcopy`` gives the same database; pickling passes the folder, under which another process
    searches by itself.

    Args:
        folder (path): made by :meth:`create`.
        expert (callable, optional): the rule for further episodes. Defaults to the one saved.
        workers (str, optional): who searches: ``"process"``, so many processes of this machine;
            ``"ray"``, so many Ray actors (an extra), which must see the folder under its path.
            Defaults to this process.
        count (int, optional): number of workers; shards are dealt out to them. Defaults to ``2``.
        **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        FileNotFoundError: the folder holds no sharded database.
        CheckpointError: a shard is missing, damaged, or has another discount or width.
        ImportError: Ray is asked for and is not installed.

    Examples:
        >>> import tempfile
        >>> from tensordict import TensorDict
        >>> database = ShardedExpertDatabase.create(
        ...     tempfile.mkdtemp(), gamma=0.5, rows_per_shard=2,
        ...     sampler=RetrievalSampler("euclidean", k=2, threshold=0.5))
        >>> end = {"reward": torch.tensor([[0.0], [1.0]]), "done": torch.tensor([[False], [True]])}
        >>> for state in (0.0, 1.0, 5.0):
        ...     states = torch.full((2, 1), state)
        ...     _ = database.extend(TensorDict({"observation": states, "next": end}, [2]))
        >>> len(database), len(database.shards), database.retrieve(torch.tensor([0.9]))["index"]
        (6, 3, tensor([2, 3]))
    """

    def __init__(
        self,
        folder: str | Path,
        expert: Callable[[TensorDictBase], bool] | None = None,
        workers: Literal["process", "ray"] | None = None,
        count: int = 2,
        **kwargs: Any,
    ):
        if workers is not None and workers not in WORKERS:
            raise ValueError(f"workers is {workers!r}; expected one of {WORKERS}, or None.")
        if count < 1:
            raise ValueError(f"count is {count}; at least one worker is needed.")
        self.folder = Path(folder).absolute()
        self._state = list_state(self.folder) if (self.folder / LIST).is_file() else None
        self._list = read_list(self.folder)
        empty = build(ExpertDatabase, self._list.config, LazyTensorStorage(1), expert, {})
        self.gamma, self.expert = empty.gamma, empty.expert
        self.rows_per_shard = int(self._list.config["capacity"])
        self.version = 0  # rows are only added
        self._opened: list[ExpertDatabase] = []
        self._tail: ExpertDatabase | None = None  # what is in no shard yet
        config = empty.sampler.config
        super().__init__(
            storage=ShardStorage(),
            sampler=ShardSampler(config, self.folder, self.gamma, workers, count),
            collate_fn=_as_it_is,
            **kwargs,
        )
        with self._replay_lock:
            self._take(self._list)

    @classmethod
    def create(
        cls,
        folder: str | Path,
        gamma: float = 0.99,
        expert: Callable[[TensorDictBase], bool] | None = None,
        sampler: RetrievalSampler | None = None,
        rows_per_shard: int = 1_000_000,
        **kwargs: Any,
    ) -> Self:
        """Makes an empty one.

        Args:
            folder (path): new or empty.
            gamma, expert, sampler: as of :class:`~torchrl_rad.data.ExpertDatabase`.
            rows_per_shard (int, optional): at most so many rows a shard; so many are held in memory
                while it is filled. Defaults to ``1_000_000``.
            **kwargs: of the constructor.

        Raises:
            FileExistsError: the folder has content.
            ValueError: an argument has a value that it cannot have.
        """
        if rows_per_shard < 1:
            raise ValueError(f"rows_per_shard is {rows_per_shard}; expected 1 or more.")
        folder = Path(folder).absolute()
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError(
                errno.EEXIST,
                "create makes a folder of its own; this one has content. Open it with loads",
                str(folder),
            )
        shard = ExpertDatabase(LazyTensorStorage(rows_per_shard), gamma, expert, sampler)
        folder.mkdir(parents=True, exist_ok=True)
        ShardList(shard._config()).write(folder)
        return cls(folder, expert, **kwargs)

    @classmethod
    def loads(cls, path: str | Path, **kwargs: Any) -> Self:  # type: ignore[override]
        """Opens one: the constructor under the name that it has elsewhere."""
        return cls(path, **kwargs)

    # filling

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Adds those of the episodes that the expert rule keeps.

        Call it once for a few hundred episodes at a time: the rule sees, and memory holds, those of
        one call. Ids below those in use are shifted past them. Episodes that are there already are
        not noticed.

        Args:
            tensordicts (TensorDictBase): as of :meth:`ExpertDatabase.extend`.
            update_priority (bool, optional): ignored.

        Returns:
            The rows written, int64 [M].

        Raises:
            TypeError, KeyError, ValueError: as of :meth:`ExpertDatabase.extend`; also an episode
                longer than a shard. Nothing is added then.
            OSError: a shard cannot be written; those closed before stay.
            RuntimeError: another process has added to the folder.
        """
        with self._replay_lock, self._write_lock:
            self._check_single()
            rows = self._checked(flat_steps(tensordicts))
            before = len(self._storage)
            for piece, full in self._pieces(rows):
                self._add(piece)
                if full:
                    self.flush()
            self._share()
            return torch.arange(before, before + len(rows))

    def _checked(self, steps: TensorDictBase) -> TensorDictBase:
        """The rows to be added, with all columns."""
        sampler = RetrievalSampler(key=self._sampler.key)
        checked = ExpertDatabase(LazyTensorStorage(len(steps)), self.gamma, self.expert, sampler)
        checked.extend(steps)
        rows = checked.storage[:].exclude("index")
        _release(checked)
        longest = int(stored_lengths(rows).max())
        if longest > self.rows_per_shard:
            raise ValueError(
                f"an episode has {longest} steps, a shard room for {self.rows_per_shard}; create "
                "the database with a larger rows_per_shard."
            )
        if len(self._storage):
            check_same_columns(rows, self._storage.tables[0])
        free = self._list.free_id()
        if self._tail is not None:
            free = max(free, int(self._tail.storage[:]["episode"].max()) + 1)
        lowest = int(rows["episode"].min())
        return rows.set("episode", rows["episode"] + max(0, free - lowest) * (free > 0))

    def _pieces(self, rows: TensorDictBase) -> Iterator[tuple[TensorDictBase, bool]]:
        """Whole episodes that fit into the present shard, and whether it is full then."""
        ends = stored_lengths(rows).cumsum(0)
        room = self.rows_per_shard - (0 if self._tail is None else len(self._tail))
        begin = 0
        while begin < len(rows):
            fits = ends[ends <= begin + room]
            end = max(begin, int(fits[-1])) if len(fits) else begin
            yield rows[begin:end], end < len(rows) or end - begin == room
            begin, room = end, self.rows_per_shard

    def _add(self, rows: TensorDictBase) -> None:
        if len(rows) == 0:
            return
        if self._tail is None:
            self._tail = build(
                ExpertDatabase, self._list.config, LazyTensorStorage(self.rows_per_shard), None, {}
            )
            self._tail._sampler = ScaledSampler(**self._sampler.config)
        before = storage_revision(self._tail.storage)
        TensorDictReplayBuffer.extend(self._tail, rows)
        self._tail.sampler.extended(self._tail.storage, before)

    def flush(self) -> None:
        """Closes the present shard, so that other processes see its rows and a kill leaves them.

        Raises:
            OSError: it cannot be written, for one thing because the disk is full.
            RuntimeError: another process has added to the folder.
        """
        with self._replay_lock, self._write_lock:
            if self._tail is None:
                return
            self._check_single()
            for stage in self.folder.glob(f"{STAGE}*"):  # of a process that was killed
                shutil.rmtree(stage, ignore_errors=True)
            name = f"shard-{len(self._list.shards):06d}"
            self._tail.dumps(self.folder / name)  # in place of one that is in no list
            self._append(describe(name, self._tail, self._sampler.key, shift=0))

    def attach(self, path: str | Path) -> None:
        """Adds a saved :class:`ExpertDatabase` as a shard; its folder stays where it is.

        So several processes can fill a part each. Episode ids in use are shifted.

        Args:
            path (path): written by :meth:`ExpertDatabase.dumps`; not to be changed any more.

        Raises:
            FileNotFoundError: there is no database.
            CheckpointError: it is damaged, or has another discount or states of another width.
            KeyError, ValueError: it has other columns.
        """
        with self._replay_lock, self._write_lock:
            self.flush()
            self._check_single()
            path = Path(path).absolute()
            database = ExpertDatabase.loads(path, memmap=True)
            rows, key = database.storage[:], self._sampler.key
            if len(self._storage):
                check_fits(path, database, self.gamma, key, self.width)
                check_same_columns(rows, self._storage.tables[0])
            else:
                width = rows.get(key).shape[-1] if rows.get(key, None) is not None else 0
                check_fits(path, database, self.gamma, key, width)
            free, lowest = self._list.free_id(), int(rows["episode"].min())
            shift = free - lowest if self._list.shards and lowest < free else 0
            self._append(describe(os.path.relpath(path, self.folder), database, key, shift))

    def _append(self, shard: Any) -> None:
        longer = ShardList(self._list.config, (*self._list.shards, shard))
        longer.write(self.folder)
        self._state = list_state(self.folder)
        if self._tail is not None:
            _release(self._tail)
            self._tail = None
        self._take(longer)

    def _check_single(self) -> None:
        if list_state(self.folder) == self._state:
            return
        if self._tail is not None:
            raise RuntimeError(
                f"another process has added to {self.folder} while this one has rows in no shard "
                "yet. Let one process add at a time; others fill a database of their own, which "
                "attach(path) adds."
            )
        self.refresh()

    def add(self, data: TensorDictBase) -> NoReturn:
        """Refuses single steps, as :meth:`ExpertDatabase.add` does."""
        raise NotImplementedError(
            "a ShardedExpertDatabase takes whole episodes, not steps one by one: "
            "gather the steps of an episode and pass them to extend()."
        )

    # what is there

    def refresh(self) -> bool:
        """Takes up shards that another process has closed since; every query does so.

        Returns:
            Whether there were any.

        Raises:
            CheckpointError: one is missing, damaged, or not like the others.
            RuntimeError: another database lies in the folder now, or both processes add.
        """
        with self._replay_lock:
            state = list_state(self.folder)
            if state == self._state:
                return False
            if self._tail is not None:
                self._check_single()
            found, own = read_list(self.folder), self._list
            if found.config != own.config or found.shards[: len(own.shards)] != own.shards:
                raise RuntimeError(
                    f"{self.folder} holds another database than when it was opened; open it anew."
                )
            self._take(found)
            self._state = state
            return len(found.shards) > len(own.shards)

    def _take(self, found: ShardList) -> None:
        """Opens the shards of a list that are not open yet, all of them or none."""
        key = self._sampler.key
        new = found.shards[len(self._opened) :]
        self._opened += [open_shard(self.folder, shard, self.gamma, key) for shard in new]
        for database, shard in zip(self._opened, found.shards, strict=True):
            if shard.width != found.shards[0].width:
                check_fits(database.path, database, self.gamma, key, found.shards[0].width)
        self._list = found
        self._share()

    def _share(self) -> None:
        """Storage and sampler get to know what is there."""
        tables = [
            (database.storage[:].exclude("index"), shard.shift)
            for database, shard in zip(self._opened, self._list.shards, strict=True)
        ]
        if self._tail is not None:
            tables.append((self._tail.storage[:].exclude("index"), 0))
        self._storage.put(tables)
        self._sampler.hold(self._list.shards, self._opened, self._tail)

    def __len__(self) -> int:
        if self._state is not None:
            self.refresh()
        return len(self._storage)

    @property
    def width(self) -> int:
        """Number of entries of a state.

        Raises:
            RuntimeError: the database is empty.
        """
        self._require_rows("asking for the width of its states")
        return self._storage.tables[0].get(self._sampler.key).shape[-1]

    @property
    def columns(self) -> ShardColumns:
        """The columns by their keys, for reading some rows: ``columns["step"][index]``."""
        return ShardColumns(self._storage)

    @property
    def tables(self) -> list[TensorDictBase]:
        """All rows, in tables of whole episodes; their ids are those in the shards."""
        return self._storage.tables

    def relabel(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses: shards do not change; so do ``forget`` and ``keep``."""
        raise NotImplementedError(
            "the rows of a sharded database do not change: fill another one with the episodes and "
            "rewards that it should have."
        )

    forget = keep = relabel

    def close(self) -> None:
        """Writes what is in no shard yet and ends the workers; the next query starts new ones."""
        self.flush()
        self._sampler.close()


def _as_it_is(rows: TensorDictBase) -> TensorDictBase:
    return rows


def _release(database: ExpertDatabase) -> None:
    """Lets its memory go with its last name."""
    # buffer and storage refer to each other, so that it would stay until garbage is collected:
    # gigabytes, in a stream
    database.storage._attached_entities.clear()


def load_database(path: str | Path, memmap: bool = False) -> ExpertDatabase | ShardedExpertDatabase:
    """Opens a saved database of either kind.

    Args:
        path (path): its folder.
        memmap (bool, optional): as of :meth:`ExpertDatabase.loads`; a sharded one always is.
            Defaults to ``False``.

    Raises:
        FileNotFoundError: the folder holds none.
        CheckpointError: a file is missing, damaged or cut short.
    """
    sharded = (Path(path) / LIST).is_file()
    return ShardedExpertDatabase(path) if sharded else ExpertDatabase.loads(path, memmap)
