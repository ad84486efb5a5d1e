"""What an expert database is beyond this process: a folder, a path in a pickle, a digest."""

from __future__ import annotations

import atexit
import errno
import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer, TensorStorage

from torchrl_rad._files import staged_folder, write_json
from torchrl_rad.data.asking import AskedReplayBuffer
from torchrl_rad.data.experts import Expert
from torchrl_rad.data.saved import FORMAT, build, read_config, replaceable, require_space
from torchrl_rad.retrieval.sampler import storage_revision

__all__ = ["SavedReplayBuffer"]


class SavedReplayBuffer(AskedReplayBuffer):
    """The part of :class:`~torchrl_rad.data.ExpertDatabase` that saves, copies and sends it."""

    gamma: float
    expert: Callable[[TensorDictBase], bool] | None
    evict: str | None

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.path: Path | None = None  # where this content is saved
        self._saved: tuple | None = None

    def digest(self) -> str:
        """sha256 of the rows, discount, expert rule and search settings.

        Where the rows are kept does not matter: a saved database has the digest of its source,
        memory-mapped or not.
        """
        settings = {name: self._config()[name] for name in ("gamma", "expert", "sampler")}
        hashed = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
        with self._replay_lock:
            rows = self._storage[:] if len(self) else TensorDict()
            for key in sorted(rows.keys(True, True), key=str):
                value = rows.get(key)
                if key == "index" or not isinstance(value, Tensor):
                    continue
                value = value.detach().cpu().contiguous()
                hashed.update(f"{key} {value.dtype} {list(value.shape)}".encode())
                hashed.update(value.reshape(-1).view(torch.uint8).numpy().data)
        return hashed.hexdigest()

    # saving, copying, sending

    def _config(self) -> dict[str, Any]:
        rule: Any = None
        if isinstance(self.expert, Expert):
            rule = self.expert.config
        elif self.expert is not None:
            rule = getattr(self.expert, "__qualname__", type(self.expert).__qualname__)
        return {
            "format": FORMAT,
            "gamma": self.gamma,
            "expert": rule,
            "capacity": self._storage.max_size,
            "evict": self.evict,
            "sampler": json.loads(json.dumps(self._sampler.config)),
            "memmap": isinstance(self._storage, LazyMemmapStorage),
        }

    def dumps(self, path: str | Path) -> None:
        """Saves rows and settings in a folder, which appears only when it is complete.

        A database that lies there is replaced, once the new one is whole.

        Args:
            path (path): a new or empty folder, or one of a saved database.

        Raises:
            RuntimeError: the database is empty.
            FileExistsError: something else lies there.
            OSError: it cannot be written, for one thing because the disk is full; what lay there
                before is untouched.
        """
        path = Path(path).absolute()
        self._require_rows("saving it")
        if path.exists() and not replaceable(path):
            raise FileExistsError(
                errno.EEXIST,
                "dumps writes a folder of its own; this one has other content",
                str(path),
            )
        with self._replay_lock:
            rows = self._storage[:]
            path.parent.mkdir(parents=True, exist_ok=True)
            require_space(path.parent, rows.bytes())
            with staged_folder(path, replace=True) as stage:
                rows.memmap(stage / "rows", copy_existing=True)
                write_json(stage / "database.json", self._config())
            self.path, self._saved = path, storage_revision(self._storage)

    @classmethod
    def loads(  # type: ignore[override]
        cls,
        path: str | Path,
        memmap: bool = False,
        expert: Callable[[TensorDictBase], bool] | None = None,
        **kwargs: Any,
    ) -> Self:
        """Opens a saved database.

        Args:
            path (path): the folder.
            memmap (bool, optional): read the rows from the file as they are asked for; such a
                database cannot grow. Their sizes are checked, not their sha256. Defaults to
                ``False``: a storage of the kind and capacity that was saved.
            expert (callable, optional): the rule for further episodes. Defaults to the one saved;
                a plain function cannot be saved, and has to be passed again before extending.
            **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

        Raises:
            FileNotFoundError: the folder does not hold a database.
            CheckpointError: a file is missing, damaged or cut short.
        """
        path = Path(path).absolute()
        config = read_config(path, memmap)
        rows = TensorDict.load_memmap(path / "rows")
        kind = LazyMemmapStorage if config["memmap"] else LazyTensorStorage
        storage = TensorStorage(rows) if memmap else kind(config["capacity"])
        database = build(cls, config, storage, expert, kwargs)
        if not memmap:
            TensorDictReplayBuffer.extend(database, rows)
        database.path, database._saved = path, storage_revision(database._storage)
        return database

    def __reduce__(self) -> tuple:
        kwargs = self._sent_options()
        if len(self) == 0:
            return _empty, (type(self), self._config(), kwargs)
        current = self._saved == storage_revision(self._storage)
        if self.path is None or not current or not (self.path / "database.json").exists():
            folder = tempfile.mkdtemp(prefix="torchrl_rad-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            self.dumps(Path(folder) / "database")
        return _open, (type(self), str(self.path), kwargs)


def _open(cls: type[SavedReplayBuffer], path: str, kwargs: dict[str, Any]) -> SavedReplayBuffer:
    return cls.loads(path, memmap=True, **kwargs)


def _empty(
    cls: type[SavedReplayBuffer], config: dict[str, Any], kwargs: dict[str, Any]
) -> SavedReplayBuffer:
    kind = LazyMemmapStorage if config["memmap"] else LazyTensorStorage
    return build(cls, config, kind(config["capacity"]), None, kwargs)
