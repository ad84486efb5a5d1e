"""OGBench's npz files as a flat table of steps."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_rad.data.arrays import flag_rows, number_rows, steps_table

__all__ = ["load_ogbench"]


def load_ogbench(path: str | Path, infos: Sequence[str] = ()) -> TensorDict:
    """Loads one npz file in OGBench's layout, and checks what came.

    The layout is one array of N rows each: ``observations``, ``actions``, ``terminals`` (True in
    the last row of a trajectory), ``qpos``, ``qvel``. A trajectory has one row more than
    transitions: the last one holds its final state, and an action that was never taken; it becomes
    a next observation. The goal-conditioned sets have no rewards: they are 0 here, until
    :func:`~torchrl_rad.envs.relabel_goal` or a goal of the query labels them.

    Args:
        path (path): the file; validation trajectories lie in one of their own (``...-val.npz``).
        infos (sequence of str, optional): further arrays to keep, such as ``"qpos"`` and
            ``"qvel"``, the simulator's state of the row. Defaults to none.

    Returns:
        TensorDict [T], T = N - number of trajectories, with the entries of
        :func:`~torchrl_rad.data.load_hdf5`. Trajectories are truncated, never terminated.

    Raises:
        FileNotFoundError: there is no such file.
        KeyError: the file lacks an array.
        TypeError: an array holds no numbers; Python objects are never read.
        ValueError: the file is damaged or no npz, arrays differ in length, the last trajectory has
            no end, one has a single row, or the content fails
            :func:`~torchrl_rad.data.check_content`.

    References:
        Park et al., "OGBench: Benchmarking Offline Goal-Conditioned RL", 2025.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "tiny-v0.npz"
        >>> states = np.float32([[1], [2], [3], [7], [8]])
        >>> np.savez(path, observations=states, actions=states / 10,
        ...          terminals=[False, False, True, False, True])
        >>> steps = load_ogbench(path)
        >>> steps["episode"].tolist(), steps["next", "observation"].squeeze(-1).tolist()
        ([0, 0, 1], [2.0, 3.0, 8.0])
    """
    name = str(path)
    arrays = _read(path, ["observations", "actions", "terminals", *infos])
    observation = number_rows(arrays["observations"], f"{name}: 'observations'")
    count = len(observation)
    action = number_rows(arrays["actions"], f"{name}: 'actions'", count)
    last = flag_rows(arrays["terminals"], f"{name}: 'terminals'", count)
    if not last[-1]:
        raise ValueError(
            f"{name}: 'terminals' is False in the last row, so that the last trajectory has no "
            "end. The file was cut: fetch or write it anew."
        )
    if last[0] or (last[1:] & last[:-1]).any():
        row = 0 if last[0] else int(np.flatnonzero(last[1:] & last[:-1])[0]) + 1
        raise ValueError(
            f"{name}: the trajectory that ends in row {row} has 1 row, which is no transition. "
            "Expected the file as published; ogbench's own loaders mark the last two rows."
        )
    rows = np.flatnonzero(~last)
    columns: dict[Any, NDArray] = {
        "observation": observation[rows],
        "action": action[rows],
        ("next", "observation"): observation[rows + 1],
        ("next", "reward"): np.zeros((len(rows), 1), np.float32),
    }
    for info in infos:
        columns["info", info] = number_rows(arrays[info], f"{name}: {info!r}", count)[rows]
    return steps_table(columns, last[rows + 1], np.zeros(len(rows), bool), name)


def _read(path: str | Path, needed: list[str]) -> dict[str, NDArray]:
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}; pass the path of an OGBench npz file.")
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f"{path} is no whole npz file; fetch it anew, and see that it is not a web page or a "
            "pointer to the file."
        )
    key = ""
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [each for each in needed if each not in archive.files]
            if missing:
                raise KeyError(
                    f"{path} lacks {missing}; it has {sorted(archive.files)}. Expected OGBench's "
                    "layout: observations, actions and terminals."
                )
            arrays = {}
            for key in needed:
                arrays[key] = archive[key]
            return arrays
    except (OSError, EOFError, RuntimeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        if "allow_pickle" in str(error):
            raise TypeError(
                f"{path}: {key!r} holds Python objects, which are not read, since they can run "
                "code; store it as an array of numbers and save the file again."
            ) from error
        raise ValueError(f"{path}: {key!r} is damaged ({error}); fetch the file anew.") from error
