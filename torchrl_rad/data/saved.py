"""A saved expert database: what its folder must hold, and how one is built from it."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path
from typing import Any, NoReturn

from tensordict import TensorDictBase

from torchrl_rad._files import MANIFEST, CheckpointError, read_json, verify_manifest
from torchrl_rad.data.experts import expert_from_config
from torchrl_rad.retrieval.sampler import RetrievalSampler

__all__ = ["FORMAT", "build", "database_stamp", "read_config", "replaceable", "require_space"]

FORMAT = 1  # raise it when the content of the folder changes


def build(cls: type, config: dict[str, Any], storage: Any, expert: Any, kwargs: dict) -> Any:
    """An empty database of class ``cls`` with saved settings; ``expert`` overrides the saved rule.

    Raises:
        KeyError: the saved rule's name is not known.
    """
    rule, settings = config["expert"], dict(config["sampler"])
    if isinstance(settings["key"], list):  # JSON has no tuples
        settings["key"] = tuple(settings["key"])
    if expert is None and rule is not None:
        expert = _Unsaved(rule) if isinstance(rule, str) else expert_from_config(rule)
    sampler = RetrievalSampler(**settings)
    return cls(storage, config["gamma"], expert, sampler, config.get("evict"), **kwargs)


class _Unsaved:
    """Stands in for a plain function that said which episodes to keep."""

    def __init__(self, name: str):
        self.__qualname__ = name

    def __call__(self, episode: TensorDictBase) -> NoReturn:
        raise ValueError(
            f"the expert rule {self.__qualname__!r} is a plain function, which is not saved with a "
            "database; pass it again: ExpertDatabase.loads(path, expert=...)."
        )


def read_config(path: Path, sizes_only: bool) -> dict[str, Any]:
    """Verifies a saved database and returns its settings.

    Args:
        path (Path): the folder.
        sizes_only (bool): check the sizes of the rows' files, not their sha256.

    Raises:
        FileNotFoundError: the folder does not hold a database.
        CheckpointError: a file is missing, damaged or cut short, or of another format.
    """
    if not (path / "database.json").exists():
        raise FileNotFoundError(
            f"{path} holds no database: database.json is missing. Pass a folder that "
            "ExpertDatabase.dumps wrote."
        )
    listed = verify_manifest(path, ("database.json",))
    verify_manifest(path, [n for n in listed if not sizes_only or n.endswith(".json")])
    for name, entry in listed.items():
        size = (path / name).stat().st_size if (path / name).is_file() else None
        if size != entry["bytes"]:
            raise CheckpointError(
                f"{path / name} is missing, damaged or cut short: expected {entry['bytes']} bytes, "
                f"got {size}."
            )
    config = read_json(path / "database.json")
    if config["format"] != FORMAT:
        raise CheckpointError(
            f"{path} has format {config['format']}, this version reads {FORMAT}; fill it anew."
        )
    return config


def database_stamp(path: str | Path) -> str:
    """Which content a saved database has, told without reading its rows: sha256 of their sha256s.

    Raises:
        CheckpointError: the folder has no manifest, or a damaged one.
    """
    verify_manifest(path, ())
    return read_json(Path(path) / MANIFEST)["digest"]


def replaceable(path: Path) -> bool:
    """Whether a folder holds nothing but a saved database."""
    return path.is_dir() and ((path / "database.json").exists() or not any(path.iterdir()))


def require_space(folder: Path, size: int) -> None:
    """Checks that ``size`` bytes fit on the disk.

    Raises:
        OSError: they do not.
    """
    # writing through a memory map to a full disk kills the process instead of raising
    free = shutil.disk_usage(folder).free
    if free < size:
        raise OSError(
            errno.ENOSPC, f"the database needs {size} bytes, the disk has {free} left", str(folder)
        )
