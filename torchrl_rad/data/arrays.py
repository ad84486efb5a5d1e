"""Flat arrays of a recorded file, checked and made a table of steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_rad.data.minari import check_content, check_infos

__all__ = ["flag_rows", "number_rows", "steps_table"]


def number_rows(values: Any, name: str, count: int | None = None) -> NDArray:
    """One row of numbers a step, from whatever a file holds.

    Args:
        values: an array [N, ...] or [N].
        name (str): file and entry, for messages.
        count (int, optional): rows expected. Defaults to any number from 1.

    Returns:
        float32 [N, width].

    Raises:
        TypeError: the entry holds no numbers (text, Python objects).
        ValueError: it is a single number, or has another number of rows.

    Examples:
        >>> number_rows([1, 2], "a.hdf5: 'rewards'").tolist()
        [[1.0], [2.0]]
    """
    values = np.asarray(values)
    if values.dtype.kind not in "fiub":
        raise TypeError(
            f"{name} has dtype {values.dtype}, expected numbers; store it as float32 and save the "
            "file again."
        )
    if values.ndim == 0 or len(values) == 0:
        raise ValueError(
            f"{name} has shape {list(values.shape)}, expected one row a step and at least one."
        )
    if count is not None and len(values) != count:
        raise ValueError(
            f"{name} has {len(values)} rows where the observations have {count}; every entry needs "
            "one row a step. The file is damaged or was cut: fetch or write it anew."
        )
    return values.astype(np.float32, copy=False).reshape(len(values), -1)


def flag_rows(values: Any, name: str, count: int) -> NDArray:
    """One yes or no a step: bool [N] from bool, or from numbers that are 0 and 1.

    Raises:
        TypeError: as of :func:`number_rows`.
        ValueError: another number of rows or columns came, or a number that is neither 0 nor 1.

    Examples:
        >>> flag_rows([[0.0], [1.0]], "a.hdf5: 'terminals'", 2).tolist()
        [False, True]
    """
    rows = number_rows(values, name, count)
    if rows.shape[1] != 1:
        raise ValueError(f"{name} has {rows.shape[1]} columns, expected 1 flag a step.")
    strange = rows[~np.isin(rows, (0, 1))]
    if len(strange):
        raise ValueError(
            f"{name} holds {strange[0]} in {len(strange)} row(s); a flag is 0 or 1. Mend the file."
        )
    return rows[:, 0] == 1


def steps_table(
    columns: Mapping[Any, NDArray], end: NDArray, terminated: NDArray, name: str
) -> TensorDict:
    """Rows of whole episodes as a flat table of steps, checked.

    Args:
        columns (mapping): by key of the table, float32 [T, .]: ``observation``, ``action``,
            ``("next", "observation")``, ``("next", "reward")``, any ``("info", ...)``.
        end (array): bool [T], the last row of each episode.
        terminated (array): bool [T], which of these rows ended for good; the others were cut off.
        name (str): the file, for messages.

    Returns:
        TensorDict [T], as :func:`~torchrl_rad.data.load_minari` gives it; episodes are 0, 1, ...

    Raises:
        ValueError: fails :func:`~torchrl_rad.data.check_content`, or an ``info`` is not finite.

    Examples:
        >>> states = np.float32([[1], [2], [3]])
        >>> columns = {"observation": states[:2], "action": states[:2],
        ...            ("next", "observation"): states[1:], ("next", "reward"): states[:2]}
        >>> steps = steps_table(columns, np.array([False, True]), np.zeros(2, bool), "mine")
        >>> steps["next", "truncated"].squeeze(-1).tolist()
        [False, True]
    """
    steps = TensorDict({}, [len(end)])
    for key, values in columns.items():
        steps[key] = torch.from_numpy(values)
    last = torch.from_numpy(end)
    steps["episode"] = last.cumsum(0) - last.long()
    steps["next", "terminated"] = torch.from_numpy(terminated)[:, None]
    steps["next", "truncated"] = torch.from_numpy(end & ~terminated)[:, None]
    steps["next", "done"] = last[:, None].clone()
    check_content(steps, int(end.sum()), len(end), name)
    check_infos(steps, name)
    return steps
