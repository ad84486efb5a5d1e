"""The embedded default data: PointMaze driven by a noisy waypoint controller."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import warnings
import zipfile
import zlib
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from torchrl_rad._files import (
    CheckpointError,
    staged_folder,
    verify_manifest,
    write_atomic,
    write_json,
)
from torchrl_rad.envs.maze import GOAL_RADIUS, FixedGoalMaze, MazeTask, maze_task

__all__ = ["cache_dir", "collect_pointmaze", "next_cells", "pointmaze_dataset"]

# D4RL's collection (scripts/generation/generate_maze2d_datasets.py): PD gains and action noise.
POSITION_GAIN = 10.0
VELOCITY_GAIN = -1.0
ACTION_NOISE = 0.5
WAYPOINT_RADIUS = 0.1  # a waypoint is solved within this distance
PART = 50  # episodes in a part of an interrupted collection
FORMAT = 2  # raise it when the content of the cache changes


def cache_dir() -> Path:
    """Folder of the collected data: ``$TORCHRL_RAD_CACHE``, or ``~/.cache/torchrl_rad``."""
    return Path(os.environ.get("TORCHRL_RAD_CACHE", Path.home() / ".cache" / "torchrl_rad"))


def next_cells(free: np.ndarray) -> np.ndarray:
    """For each pair of free cells the next cell on a shortest path, by breadth-first search.

    Args:
        free: int [n, 2], (row, column) of the free cells.

    Returns:
        int [n, n]: entry (i, j) is the cell to go to in cell i on the way to cell j; j itself on
        the diagonal, -1 where no path leads there.

    Examples:
        >>> next_cells(np.array([[1, 1], [1, 2], [1, 3]])).tolist()
        [[0, 1, 1], [0, 1, 2], [1, 1, 2]]
    """
    number = {tuple(cell): i for i, cell in enumerate(free.tolist())}
    table = np.full((len(free), len(free)), -1)
    for goal, cell in enumerate(free.tolist()):
        table[goal, goal] = goal
        queue = deque([tuple(cell)])
        while queue:
            row, column = queue.popleft()
            here = number[row, column]
            for near in (
                (row + 1, column),
                (row - 1, column),
                (row, column + 1),
                (row, column - 1),
            ):
                if near in number and table[number[near], goal] < 0:
                    table[number[near], goal] = here
                    queue.append(near)
    return table


def collect_pointmaze(
    task: MazeTask,
    steps: int,
    seed: int = 0,
    progress: bool = True,
    parts: str | Path | None = None,
) -> TensorDict:
    """Records whole episodes of the waypoint controller (D4RL's Maze2D collection; RAD, appendix).

    Fewer steps give the first episodes of more steps, and an interrupted collection goes on to the
    same data.

    Args:
        task (MazeTask): the maze; an episode has ``task.max_steps`` steps.
        steps (int): number of steps, rounded up to whole episodes.
        seed (int, optional): seed of starts, goals and noise. Defaults to ``0``.
        progress (bool, optional): show a progress bar. Defaults to ``True``.
        parts (path, optional): folder to keep finished parts in, which a further call with the same
            arguments picks up.

    Returns:
        Flat TensorDict [T]: ``observation`` [T, 4], ``action`` [T, 2], ``episode`` [T] int64 and
        under ``"next"`` the ``observation``, ``reward`` [T, 1] (for the task's goal),
        ``terminated``, ``truncated``, ``done``.

    Raises:
        ValueError: ``steps`` is below 1.

    Examples:
        >>> data = collect_pointmaze(maze_task("umaze"), 300, progress=False)
        >>> data.shape, data["next", "done"].sum().item()
        (torch.Size([300]), 1)
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}; at least one step is collected.")
    env = FixedGoalMaze(task)
    episodes = -(-steps // task.max_steps)
    states = np.empty((episodes, task.max_steps + 1, 4), np.float32)
    actions = np.empty((episodes, task.max_steps, 2), np.float32)
    table = next_cells(env.free_cells)
    bar = tqdm(
        total=episodes, desc=f"collecting {task.env_id}", unit="episode", disable=not progress
    )
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    sources = (rng, env.unwrapped.np_random)
    with bar:
        for begin in range(0, episodes, PART):
            part = slice(begin, min(begin + PART, episodes))
            saved = None if parts is None else Path(parts) / f"{part.start}-{part.stop}.npz"
            if saved is not None and _load_part(saved, states[part], actions[part], sources):
                bar.update(part.stop - part.start)
                continue
            for episode in range(part.start, part.stop):
                _record(env, table, rng, states[episode], actions[episode])
                bar.update()
            if saved is not None:
                _save_part(saved, states[part], actions[part], sources)
    env.close()
    return _flat(states, actions, env.goal)


Sources = tuple[np.random.Generator, ...]


def _load_part(path: Path, states: np.ndarray, actions: np.ndarray, sources: Sources) -> bool:
    """Fills the arrays and sets the random sources as they were after the part.

    Returns:
        False if the file is missing or damaged.
    """
    try:
        with np.load(path) as part:
            states[:], actions[:] = part["states"], part["actions"]
            after = json.loads(str(part["sources"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return False
    for source, state in zip(sources, after, strict=True):
        source.bit_generator.state = state
    return True


def _save_part(path: Path, states: np.ndarray, actions: np.ndarray, sources: Sources) -> None:
    after = json.dumps([source.bit_generator.state for source in sources])
    file = io.BytesIO()
    np.savez(file, states=states, actions=actions, sources=np.array(after))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, file.getvalue())


def _record(
    env: FixedGoalMaze,
    table: np.ndarray,
    rng: np.random.Generator,
    states: np.ndarray,
    actions: np.ndarray,
) -> None:
    """Drives one episode into ``states`` [L + 1, 4] and ``actions`` [L, 2]."""
    centres = np.asarray([env.maze.cell_rowcol_to_xy(cell) for cell in env.free_cells])
    number = {tuple(cell): i for i, cell in enumerate(env.free_cells.tolist())}
    noise = rng.normal(0.0, ACTION_NOISE, actions.shape)
    states[0], _ = env.reset()
    robot: Any = env.unwrapped
    point = robot.point_env  # the maze's physics without its goal bookkeeping
    state = states[0].astype(np.float64)
    goal = rng.integers(len(centres))
    here = number[tuple(env.maze.cell_xy_to_rowcol(state[:2]))]
    waypoint = table[here, goal]
    for t in range(len(actions)):
        if np.hypot(*(centres[waypoint] - state[:2])) < WAYPOINT_RADIUS:
            while waypoint == goal:
                goal = rng.integers(len(centres))
            waypoint = table[waypoint, goal]
        drive = POSITION_GAIN * (centres[waypoint] - state[:2]) + VELOCITY_GAIN * state[2:]
        actions[t] = np.clip(drive + noise[t], -1.0, 1.0)
        state, *_ = point.step(actions[t])
        states[t + 1] = state


def _flat(states: np.ndarray, actions: np.ndarray, goal: np.ndarray) -> TensorDict:
    episodes, steps, _ = actions.shape
    rows = episodes * steps
    truncated = torch.zeros(episodes, steps, 1, dtype=torch.bool)
    truncated[:, -1] = True
    reward = (np.linalg.norm(states[:, 1:, :2] - goal, axis=-1) <= GOAL_RADIUS).astype(np.float32)
    following = {
        "observation": torch.from_numpy(states[:, 1:].reshape(rows, 4)),
        "reward": torch.from_numpy(reward.reshape(rows, 1)),
        "terminated": torch.zeros(rows, 1, dtype=torch.bool),
        "truncated": truncated.reshape(rows, 1),
        "done": truncated.reshape(rows, 1).clone(),
    }
    return TensorDict(
        {
            "observation": torch.from_numpy(states[:, :-1].reshape(rows, 4)),
            "action": torch.from_numpy(actions.reshape(rows, 2)),
            "episode": torch.arange(episodes).repeat_interleave(steps),
            "next": TensorDict(following, [rows]),
        },
        [rows],
    )


def pointmaze_dataset(
    maze: str, steps: int, seed: int = 0, root: str | Path | None = None, progress: bool = True
) -> TensorDictBase:
    """The collected data of one maze, from the cache or collected now and cached.

    The folder's name holds the settings; it appears only when the data is complete. A damaged one
    is replaced, with a warning; an interrupted collection goes on where it was.

    Args:
        maze (str): ``"umaze"``, ``"medium"`` or ``"large"``.
        steps (int): number of steps.
        seed (int, optional): seed of the collection. Defaults to ``0``.
        root (path, optional): cache folder. Defaults to :func:`cache_dir`.
        progress (bool, optional): show a progress bar. Defaults to ``True``.

    Returns:
        The flat TensorDict of :func:`collect_pointmaze`, memory-mapped.

    Raises:
        KeyError: the maze is not known.
        ValueError: ``steps`` is below 1.
        OSError: the cache cannot be written.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as root:
        ...     data = pointmaze_dataset("umaze", 300, root=root, progress=False)
        >>> data["action"].shape
        torch.Size([300, 2])
    """
    task = maze_task(maze)
    settings = {
        "maze": maze, "steps": steps, "seed": seed, "max_steps": task.max_steps, "format": FORMAT,
        "gains": [POSITION_GAIN, VELOCITY_GAIN], "noise": ACTION_NOISE,
    }  # fmt: skip
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    path = Path(root or cache_dir()) / f"pointmaze-{maze}-{steps}-seed{seed}-{digest}"
    if not _is_whole(path):
        parts = path.with_name(f".{path.name}.parts")
        data = collect_pointmaze(task, steps, seed, progress, parts)
        try:
            with staged_folder(path, replace=True) as stage:
                data.memmap(stage / "steps")
                write_json(stage / "settings.json", settings)
        except OSError:
            if not _is_whole(path):  # else another process was faster: its data is the same
                raise
        shutil.rmtree(parts, ignore_errors=True)
    return TensorDict.load_memmap(path / "steps")


def _is_whole(path: Path) -> bool:
    if not path.exists():
        return False
    try:
        verify_manifest(path)
    except CheckpointError as error:
        warnings.warn(f"{error} The data is collected anew.", stacklevel=3)
        return False
    return True
