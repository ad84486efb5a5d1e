"""The D4RL Maze2D protocol in gymnasium-robotics' PointMaze."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_rad.data.episodes import with_reward
from torchrl_rad.envs.adapter import ObservationAdapter
from torchrl_rad.envs.task import Task, batched
from torchrl_rad.retrieval.goals import GoalReward

__all__ = ["MAZES", "FixedGoalMaze", "MazeTask", "make_maze_env", "maze_task", "relabel_goal"]

GOAL_RADIUS = 0.5  # D4RL's; gymnasium-robotics' own is 0.45
RESET_NOISE = 0.1  # D4RL's start noise in cells; gymnasium-robotics' own is 0.25


@dataclass(frozen=True)
class MazeTask(Task):
    """What the D4RL Maze2D protocol fixes for one maze.

    ``starts`` of :meth:`make_env` are cells (row, column), which rows take in turn.

    Attributes:
        name: name of the task.
        env_id: gymnasium id of the maze.
        goal_cell: (row, column) of the fixed goal.
        max_steps: length of an episode.
        reference_scores: returns of D4RL's random policy and controller (0 and 100 of the
            normalised score; D4RL ``d4rl/infos.py``, maze2d-*-v1).
        expert_steps: first and last step at which an expert episode of the paper first hits the
            goal (RAD, appendix "Implementation Details").
    """

    name: str
    env_id: str
    goal_cell: tuple[int, int]
    max_steps: int
    reference_scores: tuple[float, float]
    expert_steps: tuple[int, int]

    reference = "D4RL's maze2d v1 (d4rl/infos.py)"

    def make_row(self, number: int, starts: Sequence[tuple[int, int]] | None = None) -> gym.Env:
        return FixedGoalMaze(self, None, None if starts is None else starts[number % len(starts)])

    def variants(self, starts: Sequence[tuple[int, int]] | None = None) -> int:
        return 1 if starts is None else len(starts)

    def starts(self) -> Tensor:
        env = FixedGoalMaze(self)
        env.close()
        return cell_centres(self.env_id, env.maze, env.reset_cells.tolist())[0]

    def cells(self, cells: Sequence[tuple[int, int]]) -> tuple[Tensor, float]:
        env = FixedGoalMaze(self)
        env.close()
        return cell_centres(self.env_id, env.maze, cells)


MAZES = {
    "umaze": MazeTask("umaze", "PointMaze_UMaze-v3", (1, 1), 300, (23.85, 161.86), (200, 300)),
    "medium": MazeTask("medium", "PointMaze_Medium-v3", (6, 6), 600, (13.13, 277.39), (400, 600)),
    "large": MazeTask("large", "PointMaze_Large-v3", (7, 9), 800, (6.7, 273.99), (400, 800)),
}


def maze_task(name: str) -> MazeTask:
    """The protocol of one maze by name.

    Raises:
        KeyError: the maze is not known.

    Examples:
        >>> maze_task("medium").goal_cell
        (6, 6)
    """
    if name not in MAZES:
        raise KeyError(f"unknown maze {name!r}; known mazes are {sorted(MAZES)}.")
    return MAZES[name]


class FixedGoalMaze(gym.Wrapper):
    """PointMaze with a fixed goal cell, uniform start cells and D4RL's reward.

    The observation is the flat state (x, y, vx, vy); the reward is 1 for every step that ends
    within 0.5 of the centre of the goal cell; an episode ends at the time limit only.

    Args:
        task (MazeTask): the protocol.
        goal_cell (tuple of int, optional): another goal cell (row, column).
        reset_cell (tuple of int, optional): a fixed start cell instead of a uniform one.
        show_goal (bool, optional): the observation is a dict of ``observation``, the state, and
            ``goal``, x and y of the goal. Defaults to ``False``.

    Raises:
        ValueError: a cell is no (row, column), a wall, or outside the map.

    Examples:
        >>> env = FixedGoalMaze(maze_task("umaze"))
        >>> observation, _ = env.reset(seed=0)
        >>> observation.shape, env.goal.tolist()
        ((4,), [-1.0, 1.0])
    """

    def __init__(
        self,
        task: MazeTask,
        goal_cell: tuple[int, int] | None = None,
        reset_cell: tuple[int, int] | None = None,
        show_goal: bool = False,
    ):
        gym.register_envs(gymnasium_robotics)
        super().__init__(gym.make(task.env_id, max_episode_steps=task.max_steps))
        self.adapter = ObservationAdapter()
        robot: Any = self.unwrapped
        robot.position_noise_range = RESET_NOISE
        self.maze = robot.maze
        cell = task.goal_cell if goal_cell is None else goal_cell
        (self.goal_cell,) = maze_cells(task.env_id, self.maze.maze_map, goal_cell=cell)
        self.free_cells = free_cells(self.maze.maze_map)
        self.reset_cells = self.free_cells
        if reset_cell is not None:
            given = maze_cells(task.env_id, self.maze.maze_map, reset_cell=reset_cell)
            self.reset_cells = np.stack(given)
        self.goal = self.maze.cell_rowcol_to_xy(self.goal_cell)
        self.show_goal = show_goal
        state = self.adapter.space(self.env.observation_space)
        goal = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        both = gym.spaces.Dict({"observation": state, "goal": goal})
        self.observation_space = both if show_goal else state

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        if seed is not None:
            self.unwrapped.reset(seed=seed)  # seeds the generator that draws the start cell
        cell = self.reset_cells[self.unwrapped.np_random.integers(len(self.reset_cells))]
        cells = {"goal_cell": self.goal_cell, "reset_cell": cell}
        observation, _ = self.env.reset(options=cells)
        return self._seen(self.adapter(observation)), {}

    def step(self, action):
        observation, _, terminated, truncated, _ = self.env.step(action)
        state = self.adapter(observation)
        reward = float(np.linalg.norm(state[:2] - self.goal) <= GOAL_RADIUS)
        return self._seen(state), reward, terminated, truncated, {}

    def _seen(self, state: np.ndarray) -> Any:
        if not self.show_goal:
            return state
        return {"observation": state, "goal": self.goal.astype(np.float32)}


def maze_cells(env_id: str, maze_map: list[list[Any]], **cells: Any) -> list[np.ndarray]:
    """Named cells of a map as arrays [2].

    Raises:
        ValueError: one is no (row, column), a wall, or outside the map.
    """
    free, found = free_cells(maze_map), []
    for name, value in cells.items():
        cell = np.asarray(value)
        if cell.shape != (2,) or cell.dtype.kind not in "iu":
            raise ValueError(f"{name} is {value}; expected (row, column), two whole numbers.")
        if not (free == cell).all(-1).any():
            raise ValueError(
                f"cell {tuple(cell.tolist())} of {env_id} is a wall or outside the map."
            )
        found.append(cell)
    return found


def cell_centres(env_id: str, maze: Any, cells: Sequence[Any]) -> tuple[Tensor, float]:
    """Centres [n, 2] of cells of gymnasium-robotics' maze, and half of a cell's side."""
    found = [maze_cells(env_id, maze.maze_map, cell=cell)[0] for cell in cells]
    centres = np.stack([maze.cell_rowcol_to_xy(cell) for cell in found])
    return torch.from_numpy(centres).float(), maze.maze_size_scaling / 2


def maze_cell(text: str) -> tuple[int, int]:
    """A cell as it is named on a command line.

    Raises:
        ValueError: the text is not ``row,column``.

    Examples:
        >>> maze_cell("3,1")
        (3, 1)
    """
    row, column = text.split(",")
    return int(row), int(column)


def free_cells(maze_map: list[list[Any]]) -> np.ndarray:
    """(row, column) of every free cell of a maze map, in reading order: int [n, 2]."""
    return np.asarray(
        [(r, c) for r, row in enumerate(maze_map) for c, v in enumerate(row) if v != 1]
    )


def relabel_goal(
    episodes: TensorDictBase, goal: np.ndarray | Tensor, goal_reward: GoalReward | None = None
) -> TensorDictBase:
    """Gives recorded steps the reward of a goal: 1 where the next state is within 0.5 of it.

    D4RL labels its mazes so, Maze2D and AntMaze, against the goal of the evaluation. States of
    AntMaze need x and y in front: Minari's sets have them in ``achieved_goal``, so that the adapter
    is ``ObservationAdapter(("achieved_goal", "observation"))``.

    Args:
        episodes (TensorDictBase): flat steps with ``("next", "observation")``, whose first two
            entries are x, y.
        goal: x, y of the goal.
        goal_reward (GoalReward, optional): another radius, or other entries of the state. Defaults
            to within 0.5 in the first entries, as many as the goal has.

    Returns:
        A shallow copy with ``("next", "reward")`` [T, 1] float32 replaced.

    Raises:
        ValueError: the goal has another width than the entries of the state that it is compared to.

    Examples:
        >>> from tensordict import TensorDict
        >>> states = torch.tensor([[0.0, 0.4], [0.0, 0.6]])
        >>> steps = TensorDict({"next": {"observation": states}}, [2])
        >>> relabel_goal(steps, [0.0, 0.0])["next", "reward"].squeeze(-1).tolist()
        [1.0, 0.0]
        >>> wide = GoalReward(radius=0.7)
        >>> relabel_goal(steps, [0.0, 0.0], wide)["next", "reward"].squeeze(-1).tolist()
        [1.0, 1.0]
    """
    goal = torch.as_tensor(np.asarray(goal), dtype=torch.float32)
    goal_reward = GoalReward(GOAL_RADIUS) if goal_reward is None else goal_reward
    return with_reward(episodes, goal_reward(episodes["next", "observation"], goal).float())


def make_maze_env(
    task: MazeTask,
    rows: int,
    seed: int = 0,
    goal_cell: tuple[int, int] | Sequence[tuple[int, int]] | None = None,
    show_goal: bool = False,
    reset_cell: tuple[int, int] | Sequence[tuple[int, int]] | None = None,
) -> TransformedEnv:
    """A TorchRL environment with ``rows`` independent mazes.

    Row by row, the start states depend on the seed alone.

    Args:
        task (MazeTask): the protocol.
        rows (int): number of mazes.
        seed (int, optional): seed of the start states. Defaults to ``0``.
        goal_cell (tuple of int, optional): another goal cell, or a list of one a row.
        show_goal (bool, optional): write x and y of each row's goal into ``goal`` [rows, 2].
            Defaults to ``False``.
        reset_cell (tuple of int, optional): a fixed start cell, or a list of one a row. Defaults to
            any cell.

    Raises:
        ValueError: ``rows`` is below 1, there are more or fewer cells than rows, or one that cannot
            be stood on.

    Examples:
        >>> env = make_maze_env(maze_task("umaze"), 2)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """
    if rows < 1:
        raise ValueError(f"rows is {rows}; an environment has at least one row.")

    goals, starts = _one_a_row("goal", goal_cell, rows), _one_a_row("start", reset_cell, rows)

    mazes = [
        partial(FixedGoalMaze, task, *cells, show_goal) for cells in zip(goals, starts, strict=True)
    ]
    return batched(mazes, seed)


def _one_a_row(name: str, cell: Any, rows: int) -> list[Any]:
    several = cell if isinstance(cell, list) else [cell] * rows
    if len(several) != rows:
        raise ValueError(
            f"there are {len(several)} {name} cells for {rows} rows; expected one a row."
        )
    return several
