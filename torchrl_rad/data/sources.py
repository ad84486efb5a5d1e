"""Recorded data by name: one loader for all layouts, and several sources as one table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_rad.data.hdf5 import load_hdf5
from torchrl_rad.data.minari import load_minari
from torchrl_rad.data.ogbench import load_ogbench
from torchrl_rad.envs.adapter import ObservationAdapter

__all__ = ["concatenate_steps", "find_dataset", "load_dataset"]

FILES = (".hdf5", ".h5", ".npz")


def load_dataset(
    source: str | Path | Sequence[str | Path],
    keys: Sequence[str] = ("observation",),
    infos: Sequence[str] = (),
    download: bool = False,
    progress: bool = True,
) -> TensorDictBase:
    """Loads recorded data, whatever its layout, as a flat table of steps.

    A path that ends in ``.hdf5`` or ``.h5`` is a file of D4RL (:func:`~torchrl_rad.data.load_hdf5`,
    which has further options), one that ends in ``.npz`` a file of OGBench
    (:func:`~torchrl_rad.data.load_ogbench`), anything else the id of a Minari data set
    (:func:`~torchrl_rad.data.load_minari`).

    Args:
        source (str, path or sequence of them): several are joined, as medium and expert are to
            medium-expert.
        keys (sequence of str, optional): entries of dict observations, which Minari's sets have;
            ``("achieved_goal", "observation")`` gives AntMaze's 29 with x and y in front. Files
            hold one array and are taken as they are. Defaults to ``("observation",)``.
        infos (sequence of str, optional): entries of the infos to keep, such as ``"qpos"``.
        download (bool, optional): fetch a Minari set that is not here. Defaults to ``False``.
        progress (bool, optional): show progress bars. Defaults to ``True``.

    Returns:
        TensorDict [T] with the entries of :func:`~torchrl_rad.data.load_minari`.

    Raises:
        ImportError, FileNotFoundError, KeyError, TypeError: as of the loaders.
        ValueError: as of the loaders; there is no source; sources differ in entries or widths.

    Examples:
        >>> import tempfile, numpy as np
        >>> path = Path(tempfile.mkdtemp()) / "tiny-v0.npz"
        >>> states = np.float32([[1], [2], [3]])
        >>> np.savez(path, observations=states, actions=states / 10, terminals=[0, 0, 1])
        >>> load_dataset([path, path])["episode"].tolist()
        [0, 0, 1, 1]
    """
    if not isinstance(source, (str, os.PathLike)):
        parts = [load_dataset(each, keys, infos, download, progress) for each in source]
        return concatenate_steps(parts, [str(each) for each in source])
    ending = Path(source).suffix.lower()
    if ending in FILES[:2]:
        return load_hdf5(source, infos=infos)
    if ending in FILES:
        return load_ogbench(source, infos)
    adapter = ObservationAdapter(keys)
    return load_minari(str(source), adapter, download, progress, infos)


def find_dataset(names: str | Sequence[str]) -> list[str]:
    """The first of some data sets that is on this machine, else the first that can be fetched.

    Args:
        names (str or sequence of str): Minari ids, and files, looked for where their path says and
            in ``$TORCHRL_RAD_DATA`` (``data``); ``"a+b"`` is both of them together.

    Returns:
        What to pass to :func:`load_dataset`.

    Raises:
        FileNotFoundError: none is here, and none is a Minari id.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "tiny-v0.npz"
        >>> path.touch()
        >>> find_dataset(["nowhere.hdf5", str(path)]) == [str(path)]
        True
        >>> find_dataset(["nowhere.hdf5", "mujoco/hopper/medium-v0+mujoco/hopper/expert-v0"])
        ['mujoco/hopper/medium-v0', 'mujoco/hopper/expert-v0']
    """
    names = [names] if isinstance(names, str) else list(names)
    for name in names:
        found = [_here(part) for part in name.split("+")]
        if all(found):
            return [part for part in found if part]
    for name in names:
        if not name.endswith(FILES):
            return name.split("+")
    raise FileNotFoundError(
        f"none of the data sets {names} is here; looked for where these paths say and in "
        f"{_folder()}. Put the file there, or name its folder by TORCHRL_RAD_DATA."
    )


def _folder() -> Path:
    return Path(os.environ.get("TORCHRL_RAD_DATA", "data")).absolute()


def _here(name: str) -> str | None:
    """The path or id of a data set on this machine."""
    if name.endswith(FILES):
        paths = [path for path in (Path(name), _folder() / name) if path.exists()]
        return str(paths[0].absolute()) if paths else None
    try:
        import minari
    except ImportError:
        return None
    return name if name in minari.list_local_datasets() else None


def concatenate_steps(
    tables: Sequence[TensorDictBase], names: Sequence[str] | None = None
) -> TensorDictBase:
    """Joins tables of steps; ids of episodes are moved up so that each stays unique.

    Args:
        tables (sequence of TensorDictBase): each flat [T_i] with ``episode`` [T_i] int64, all with
            the same entries.
        names (sequence of str, optional): what to call them in messages. Defaults to their number.

    Returns:
        TensorDict [T_0 + T_1 + ...].

    Raises:
        ValueError: there is no table, or one is empty or differs from the first in entries,
            widths or dtypes.

    Examples:
        >>> from tensordict import TensorDict
        >>> one = TensorDict({"episode": torch.tensor([5, 6, 6])}, [3])
        >>> concatenate_steps([one, one])["episode"].tolist()
        [5, 6, 6, 7, 8, 8]
    """
    if len(tables) == 0:
        raise ValueError("there is nothing to join; name at least one source.")
    names = [f"table {i}" for i in range(len(tables))] if names is None else names
    expected = _columns(tables[0])
    for name, table in zip(names, tables, strict=True):
        if len(table) == 0:
            raise ValueError(f"{name} has no steps; leave it out.")
        found = _columns(table)
        differing = [key for key in expected | found if expected.get(key) != found.get(key)]
        if differing:
            key = differing[0]
            raise ValueError(
                f"{name} cannot be joined to {names[0]}: {key!r} is {found.get(key, 'missing')} "
                f"there and {expected.get(key, 'missing')} here. Join data of one environment, "
                "loaded with the same keys and infos."
            )
    parts, free = [], 0
    for table in tables:
        part = table.copy()
        part["episode"] = part["episode"] + max(0, free - int(part["episode"].min()))
        free = int(part["episode"].max()) + 1
        parts.append(part)
    return torch.cat(parts)


def _columns(table: TensorDictBase) -> dict:
    """Width and dtype of every entry."""
    return {
        key: f"{table[key].dtype} {['T', *table[key].shape[1:]]}".replace("'", "")
        for key in table.keys(True, True)
    }
