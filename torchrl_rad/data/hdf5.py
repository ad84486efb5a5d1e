"""D4RL's HDF5 files as a flat table of steps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_rad.data.arrays import flag_rows, number_rows, steps_table
from torchrl_rad.data.episodes import step_and_remaining

__all__ = ["has_successor", "load_hdf5"]

FLAGS = ("terminals", "timeouts")
GOAL = "infos/goal"
ENDS = (*FLAGS, GOAL)


def load_hdf5(
    path: str | Path,
    ends: Sequence[str] | None = None,
    max_steps: int | None = None,
    infos: Sequence[str] = (),
) -> TensorDict:
    """Loads a file in D4RL's HDF5 layout, cuts it into episodes, and checks what came.

    The layout is one array of N rows each: ``observations``, ``actions``, ``rewards``, and, where
    a family has them, ``terminals``, ``timeouts``, ``next_observations`` and ``infos/...``. Groups
    of other names, such as policy weights in ``metadata``, are left alone.

    What ends an episode is read off the file: the flags that are set somewhere (locomotion, where
    ``terminals`` is a fall and ``timeouts`` the limit; Kitchen, which has ``terminals`` only). Two
    families differ. AntMaze's ``terminals`` mark rows at the goal while the ant walks on: they
    pay more than all others and most are followed by another one; then ``timeouts`` alone end an
    episode.
    Maze2D without flags is one stream, cut where ``infos/goal`` changes.

    No row is dropped, so that the lengths and returns of episodes are the recorded ones. In files
    without ``next_observations`` the next observation is that of the following row; it is recorded
    nowhere for the last row before a reset, which gets its own observation again: nothing follows
    a fall, and returns do not ask, but as a transition the row is wrong. :func:`has_successor`
    says which rows to train dynamics or a critic on. Rows of a stream that is cut but not reset
    (files with ``infos/goal`` of which no flag ends an episode) all have their successor, but for
    the last row of the file.

    Args:
        path (path): the file.
        ends (sequence of str, optional): what ends an episode, any of ``"terminals"``,
            ``"timeouts"``, ``"infos/goal"`` (a change of it); ``()`` for ``max_steps`` alone, as
            for Maze2D files that have ``timeouts``. Defaults to what the file says.
        max_steps (int, optional): episodes are cut after this many rows, too. Locomotion files of
            version 0 need it (1000): they have no ``timeouts``.
        infos (sequence of str, optional): entries of ``infos`` to keep, such as ``"qpos"`` and
            ``"qvel"``, the simulator's state of the row. Defaults to none.

    Returns:
        TensorDict [T], T = N: ``observation`` [T, S] and ``action`` [T, A] float32, ``episode`` [T]
        int64 (0, 1, ...), ``("next", "observation")`` [T, S] and ``("next", "reward")`` [T, 1]
        float32, ``("next", "terminated")``, ``("next", "truncated")`` and ``("next", "done")``
        [T, 1] bool, ``("info", name)`` [T, .] float32. ``terminated`` are the ``terminals`` that
        end an episode. An episode that the file's end cuts off counts as truncated.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: h5py is not installed.
        KeyError: the file lacks an entry.
        TypeError: an entry holds no numbers.
        ValueError: the file is damaged or not HDF5, entries differ in length, nothing ends an
            episode, or the content fails :func:`~torchrl_rad.data.check_content`.

    References:
        Fu et al., "D4RL: Datasets for Deep Data-Driven Reinforcement Learning", 2020.

    Examples:
        >>> import tempfile, h5py
        >>> path = Path(tempfile.mkdtemp()) / "tiny.hdf5"
        >>> with h5py.File(path, "w") as file:
        ...     file["observations"] = np.float32([[1], [2], [7], [8]])
        ...     file["actions"] = np.float32([[0.1], [0.2], [0.3], [0.4]])
        ...     file["rewards"] = np.float32([1, 1, 1, 1])
        ...     file["terminals"] = [False, True, False, False]
        ...     file["timeouts"] = [False, False, False, True]
        >>> steps = load_hdf5(path)
        >>> steps["episode"].tolist(), steps["next", "observation"].squeeze(-1).tolist()
        ([0, 0, 1, 1], [2.0, 2.0, 8.0, 8.0])
        >>> has_successor(steps).tolist()
        [True, False, True, False]
    """
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}; an episode has at least 1 row.")
    name = str(path)
    arrays = _read(path, infos)
    observation = number_rows(arrays["observations"], f"{name}: 'observations'")
    count = len(observation)
    columns: dict[Any, NDArray] = {
        "observation": observation,
        "action": number_rows(arrays["actions"], f"{name}: 'actions'", count),
        ("next", "reward"): number_rows(arrays["rewards"], f"{name}: 'rewards'", count),
    }
    if columns["next", "reward"].shape[1] != 1:
        width = columns["next", "reward"].shape[1]
        raise ValueError(f"{name}: 'rewards' has {width} columns, expected 1 number a step.")
    for info in infos:
        columns["info", info] = number_rows(
            arrays[f"infos/{info}"], f"{name}: 'infos/{info}'", count
        )
    marks = {
        key: flag_rows(arrays[key], f"{name}: {key!r}", count) for key in FLAGS if key in arrays
    }
    if GOAL in arrays:
        goal = number_rows(arrays[GOAL], f"{name}: {GOAL!r}", count)
        marks[GOAL] = np.append((goal[1:] != goal[:-1]).any(-1), False)
    reward = columns["next", "reward"][:, 0]
    ends = _default_ends(marks, reward, max_steps, name) if ends is None else tuple(ends)
    end, reset = _cuts(marks, ends, max_steps, count, name)
    columns["next", "observation"] = _following(arrays, observation, reset, name)
    terminated = marks["terminals"] & end if "terminals" in ends else np.zeros(count, bool)
    return steps_table(columns, end, terminated, name)


def has_successor(steps: TensorDictBase) -> Tensor:
    """Rows whose next observation was recorded, not filled in with the row's own: bool [T].

    Args:
        steps (TensorDictBase): [T], as of :func:`load_hdf5`.

    Examples:
        >>> steps = TensorDict({
        ...     "observation": torch.tensor([[1.0], [2.0]]),
        ...     "next": {"observation": torch.tensor([[2.0], [2.0]]),
        ...              "done": torch.tensor([[False], [True]])}}, [2])
        >>> has_successor(steps).tolist()
        [True, False]
    """
    stays = (steps["next", "observation"] == steps["observation"]).all(-1)
    return ~(stays & steps["next", "done"].squeeze(-1))


def _import_h5py():
    try:
        import h5py
    except ImportError as error:
        raise ImportError(
            f"HDF5 files need the package h5py ({error}); "
            'install it with pip install "torchrl_rad[offline]".'
        ) from error
    return h5py


def _read(path: str | Path, infos: Sequence[str]) -> dict[str, NDArray]:
    """The arrays that matter, as the file holds them."""
    h5py = _import_h5py()
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}; pass the path of a D4RL HDF5 file.")
    needed = ["observations", "actions", "rewards", *(f"infos/{info}" for info in infos)]
    wanted = dict.fromkeys([*needed, "next_observations", *ENDS])
    try:
        with h5py.File(path, "r") as file:
            found = {key: file[key] for key in wanted if isinstance(file.get(key), h5py.Dataset)}
            missing = [key for key in needed if key not in found]
            if missing:
                raise KeyError(
                    f"{path} lacks {missing}; it has {_entries(file, h5py)}. Expected D4RL's "
                    "layout; a Minari data set is loaded by its id with load_minari."
                )
            return {key: dataset[()] for key, dataset in found.items()}
    except (OSError, RuntimeError) as error:  # of the HDF5 library
        what = "is damaged or cut short" if h5py.is_hdf5(path) else "is no whole HDF5 file"
        raise ValueError(
            f"{path} {what} ({error}); fetch it anew, and see that it is not a web page or a "
            "pointer to the file."
        ) from error


def _entries(file: Any, h5py: Any) -> list[str]:
    names = list(file)
    if isinstance(file.get("infos"), h5py.Group):
        names += [f"infos/{name}" for name in file["infos"]]
    return sorted(names)


def _default_ends(
    marks: dict[str, NDArray], reward: NDArray, max_steps: int | None, name: str
) -> tuple[str, ...]:
    """What ends an episode, by what the file holds."""
    used = tuple(key for key in FLAGS if key in marks and marks[key].any())
    if "terminals" in used and _mark_the_goal(marks, reward):
        if "timeouts" in used:
            return ("timeouts",)
        raise ValueError(
            f"{name}: 'terminals' are rows at the goal, not ends, and 'timeouts' are missing or "
            "never set, so that nothing says where episodes end. Fetch version 2 of the set, which "
            "has them, or write them into a copy of the file."
        )
    if used or max_steps is not None:
        return used
    if GOAL in marks and marks[GOAL].any():
        return (GOAL,)
    raise ValueError(
        f"{name}: no row of 'terminals' or 'timeouts' is set and no 'infos/goal' changes, so that "
        "nothing says where episodes end. Pass max_steps, the time limit of the environment."
    )


def _mark_the_goal(marks: dict[str, NDArray], reward: NDArray) -> bool:
    """Whether terminals are labels in a stream: they pay more than other rows and come in a row.

    After a true end a new episode begins, which hardly ever ends at once.
    """
    terminals = marks["terminals"]
    if terminals.all() or not reward[terminals].min() > reward[~terminals].max():
        return False
    inside = terminals & ~marks.get("timeouts", np.zeros_like(terminals))
    again = terminals[1:] & inside[:-1]
    return 2 * int(again.sum()) > int(inside.sum())


def _cuts(
    marks: dict[str, NDArray],
    ends: tuple[str, ...],
    max_steps: int | None,
    count: int,
    name: str,
) -> tuple[NDArray, NDArray]:
    """Last rows of episodes, and the rows that a reset follows: two bool [N]."""
    unknown = [key for key in ends if key not in ENDS]
    if unknown:
        raise ValueError(f"ends names {unknown}; expected some of {ENDS}.")
    missing = [key for key in ends if key not in marks]
    if missing:
        raise KeyError(f"{name} lacks {missing}, named in ends; it has {sorted(marks)}.")
    if not ends and max_steps is None:
        raise ValueError("ends is empty; pass max_steps, the rows of an episode.")
    end = np.zeros(count, bool)
    for key in ends:
        end |= marks[key]
    flagged = [marks[key] for key in ends if key in FLAGS]
    reset = np.logical_or.reduce(flagged) if flagged else np.zeros(count, bool)
    end[-1] = True
    if max_steps is None:
        return end, reset
    lengths = torch.from_numpy(np.diff(np.flatnonzero(end), prepend=-1))
    limit = (step_and_remaining(lengths)[0].numpy() + 1) % max_steps == 0
    if GOAL in marks and not flagged:  # one stream: the cut is ours, not the recorder's
        return end | limit, reset
    return end | limit, reset | limit


def _following(
    arrays: dict[str, NDArray], observation: NDArray, reset: NDArray, name: str
) -> NDArray:
    """Next observations [N, S]: recorded, or of the following row, or the row's own at a reset."""
    if "next_observations" not in arrays:
        following = np.concatenate([observation[1:], observation[-1:]])
        following[reset] = observation[reset]
        return following
    where = f"{name}: 'next_observations'"
    following = number_rows(arrays["next_observations"], where, len(observation))
    if following.shape != observation.shape:
        raise ValueError(
            f"{where} has {following.shape[1]} columns, expected {observation.shape[1]} as in "
            "'observations'. Remove the entry, or write the file anew."
        )
    return following
