"""Files that are either whole or absent, and folders that list the sha256 of each of theirs."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = [
    "CheckpointError",
    "read_json",
    "sha256",
    "staged_folder",
    "verify_manifest",
    "write_atomic",
    "write_json",
    "write_manifest",
]

MANIFEST = "manifest.json"
STAGE = ".tmp-"  # what is being written carries this prefix; after a kill it is never read


class CheckpointError(RuntimeError):
    """A saved file is damaged, foreign or cannot be written; the message names it and says why.

    Examples:
        >>> raise CheckpointError("model.json is missing")
        Traceback (most recent call last):
        torchrl_rad._files.CheckpointError: model.json is missing
    """


def write_atomic(path: str | Path, data: bytes | str) -> None:
    """Writes a file that survives a kill or power loss as it was or as it is now, never half.

    Args:
        path (path): in an existing folder; replaced if it exists.
        data (bytes or str): str is written as UTF-8.

    Raises:
        OSError: it cannot be written; what was there before is untouched.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
        >>> write_atomic(path, "one")
        >>> path.read_text()
        'one'
    """
    path = Path(path)
    temporary = path.with_name(f"{STAGE}{path.name}-{uuid.uuid4().hex}")
    try:
        with open(temporary, "xb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())  # else the name could reach the disk before the content does
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync(path.parent)


def sync(path: Path) -> None:
    """Waits until a file, or the names in a folder, are on the disk."""
    if os.name != "posix":  # other systems do not open folders
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network drives have no fsync
            raise
    finally:
        os.close(handle)


def sha256(path: str | Path) -> str:
    """The sha256 of a file's content, in hex.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "empty"
        >>> path.touch()
        >>> sha256(path)[:8]
        'e3b0c442'
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: str | Path, value: Any) -> None:
    """Writes a value as JSON, atomically.

    Raises:
        OSError: see :func:`write_atomic`.
        TypeError: JSON has no form for the value.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "config.json"
        >>> write_json(path, {"horizon": 129})
        >>> read_json(path)
        {'horizon': 129}
    """
    write_atomic(path, json.dumps(value, indent=1) + "\n")


def read_json(path: str | Path) -> Any:
    """Reads what :func:`write_json` wrote.

    Raises:
        CheckpointError: the file is not JSON.
        FileNotFoundError: there is none.
    """
    try:
        return json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} is damaged: it is not JSON ({error}).") from error


def _digest(files: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


def write_manifest(folder: str | Path) -> None:
    """Puts a folder's files on the disk for good and lists them, with sha256, in ``manifest.json``.

    Files in folders below count too. Call it last: what changes afterwards counts as damaged.

    Raises:
        OSError: see :func:`write_atomic`.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_json(folder / "config.json", {})
        >>> write_manifest(folder)
        >>> list(verify_manifest(folder))
        ['config.json']
    """
    folder = Path(folder)
    files = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name == MANIFEST or path.name.startswith(STAGE):
            continue
        if path.is_dir() or path.is_file():
            sync(path)
        if path.is_file():
            files[name] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
    # its own digest tells a damaged manifest from a damaged file
    write_json(folder / MANIFEST, {"files": files, "digest": _digest(files)})


def verify_manifest(folder: str | Path, names: Collection[str] | None = None) -> dict[str, Any]:
    """Checks a folder's files against its ``manifest.json``; unlisted files are left aside.

    Args:
        folder (path): written with :func:`write_manifest`.
        names (collection of str, optional): files to check. Defaults to all that are listed.

    Returns:
        dict: for each listed file its ``"bytes"`` and ``"sha256"``.

    Raises:
        CheckpointError: names the first file that is missing, cut short or damaged, or not listed.

    Examples:
        >>> import tempfile
        >>> verify_manifest(tempfile.mkdtemp())  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        torchrl_rad._files.CheckpointError: ... manifest.json is missing.
    """
    folder = Path(folder)
    if not (folder / MANIFEST).is_file():
        raise CheckpointError(f"{folder} is incomplete: {MANIFEST} is missing.")
    manifest = read_json(folder / MANIFEST)
    files = manifest.get("files") if isinstance(manifest, dict) else None
    if not isinstance(files, dict) or manifest.get("digest") != _digest(files):
        raise CheckpointError(f"{folder / MANIFEST} is damaged or foreign: its own sha256 differs.")
    for name in files if names is None else names:
        if name not in files:
            raise CheckpointError(f"{folder / name} is not listed in {MANIFEST}.")
        _verify_file(folder / name, files[name]["bytes"], files[name]["sha256"])
    return files


def _verify_file(path: Path, size: int, digest: str) -> None:
    if not path.is_file():
        raise CheckpointError(f"{path} is missing, though {MANIFEST} lists it.")
    found = path.stat().st_size
    if found != size:
        how = "cut short" if found < size else "damaged"
        raise CheckpointError(f"{path} is {how}: it has {found} bytes, {MANIFEST} says {size}.")
    if sha256(path) != digest:
        raise CheckpointError(f"{path} is damaged: its sha256 is not the one in {MANIFEST}.")


@contextmanager
def staged_folder(target: str | Path, replace: bool = False) -> Iterator[Path]:
    """A folder to write in; it appears as ``target``, with its manifest, once all is on the disk.

    Args:
        target (path): at no instant the name is a half-written folder.
        replace (bool, optional): an older folder of this name is moved aside when the new one is
            whole, then removed; a kill between leaves it beside, under a hidden name. Defaults to
            ``False``: it must not exist.

    Raises:
        OSError: it cannot be written, or ``target`` exists; what was written is removed and what
            was there is as it was.

    Examples:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "policy"
        >>> with staged_folder(target) as stage:
        ...     write_json(stage / "config.json", {})
        >>> list(verify_manifest(target))
        ['config.json']
    """
    target = Path(target).absolute()
    if target.exists() and not (replace and target.is_dir()):
        raise FileExistsError(errno.EEXIST, "a file or folder of this name exists", str(target))
    old = target.parent / f"{STAGE}{target.name}-{uuid.uuid4().hex}"
    stage = target.parent / f"{STAGE}{target.name}-{uuid.uuid4().hex}"
    try:
        stage.mkdir(parents=True)
        yield stage
        write_manifest(stage)
        if target.exists():
            os.replace(target, old)
        os.replace(stage, target)
    except BaseException:
        if old.exists():
            os.replace(old, target)
        shutil.rmtree(stage, ignore_errors=True)
        raise
    sync(target.parent)
    if old.exists():
        shutil.rmtree(old, ignore_errors=True)
