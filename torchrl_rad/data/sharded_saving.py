"""What a sharded database is elsewhere: a copy on disk, a folder in a pickle, a digest."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from torchrl_rad._files import staged_folder
from torchrl_rad.data.asking import AskedReplayBuffer
from torchrl_rad.data.saved import database_stamp, require_space
from torchrl_rad.data.shards import ShardList

__all__ = ["SavedShards"]


class SavedShards(AskedReplayBuffer):
    """The part of :class:`~torchrl_rad.data.ShardedExpertDatabase` that copies and sends it."""

    folder: Path
    _list: ShardList

    def flush(self) -> None:
        """Closes the present shard."""
        raise NotImplementedError

    @property
    def shards(self) -> list[Path]:
        """Folders of the shards, in the order of their rows."""
        return [(self.folder / shard.path).resolve() for shard in self._list.shards]

    def digest(self) -> str:
        """sha256 of settings and shards, how the rows are cut into these included."""
        self.flush()
        config = {name: self._list.config[name] for name in ("gamma", "expert", "sampler")}
        hashed = hashlib.sha256(json.dumps(config, sort_keys=True).encode())
        for path, shard in zip(self.shards, self._list.shards, strict=True):
            hashed.update(f"{database_stamp(path)} {shard.shift}".encode())
        return hashed.hexdigest()

    def dumps(self, path: str | Path) -> None:
        """Copies the whole to another folder, which appears only when it is complete.

        Args:
            path (path): must not exist.

        Raises:
            FileExistsError: it exists.
            OSError: it cannot be written.
        """
        with self._replay_lock:
            self.flush()
            path = Path(path).absolute()
            path.parent.mkdir(parents=True, exist_ok=True)
            files = [file for shard in self.shards for file in shard.rglob("*")]
            require_space(path.parent, sum(file.stat().st_size for file in files))
            with staged_folder(path) as stage:
                named = []
                for number, (own, shard) in enumerate(
                    zip(self.shards, self._list.shards, strict=True)
                ):
                    name = f"shard-{number:06d}"
                    shutil.copytree(own, stage / name)
                    named.append(dataclasses.replace(shard, path=name))
                ShardList(self._list.config, tuple(named)).write(stage)

    def __reduce__(self) -> tuple:
        self.flush()
        kwargs = self._sent_options()
        search = {"k": self._sampler.k, "threshold": self._sampler.threshold}
        return _reopen, (type(self), str(self.folder), kwargs, search)


def _reopen(cls: type, folder: str, kwargs: dict[str, Any], search: dict[str, Any]) -> Any:
    database = cls(folder, **kwargs)
    for name, value in search.items():
        setattr(database.sampler, name, value)
    return database
