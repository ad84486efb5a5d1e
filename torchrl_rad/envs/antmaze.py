"""The ant in a maze, on its way to one fixed goal."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import gymnasium_robotics
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.envs.adapter import ObservationAdapter
from torchrl_rad.envs.maze import cell_centres, maze_cells, relabel_goal
from torchrl_rad.envs.task import Task

__all__ = ["AntMazeTask", "FixedGoalAntMaze"]

NOISE = 0.025  # of start and goal in cells of 4: D4RL's 0.1; gymnasium-robotics' own is 0.25


@dataclass(frozen=True)
class AntMazeTask(Task):
    """gymnasium-robotics' AntMaze by D4RL's protocol: one goal cell, over when it is reached.

    The state is x, y and the 27 entries of the ant's body (105 in -v5). The score is the share of
    episodes that reach the goal. Recorded steps are rewarded where the next state lies within 0.5
    of the centre of the goal cell, though the recording goes on there. ``starts`` of
    :meth:`make_env` are cells (row, column), which rows take in turn.

    Attributes:
        name: of the task.
        env_id: gymnasium id, such as ``"AntMaze_Medium-v4"``, of the data's version.
        goal_cell, reset_cell: (row, column).
        max_steps: length of an episode.

    Examples:
        >>> task = AntMazeTask("antmaze-medium-play", "AntMaze_Medium-v4", (6, 6))
        >>> task.make_env(1).reset()["observation"].shape
        torch.Size([1, 29])
    """

    name: str
    env_id: str
    goal_cell: tuple[int, int]
    reset_cell: tuple[int, int] = (1, 1)
    max_steps: int = 1000

    reference_scores = (0.0, 1.0)
    reference = "D4RL's antmaze (d4rl/infos.py): the share of episodes that reach the goal"
    figures = ("success", "arrival")
    adapter = ObservationAdapter(("achieved_goal", "observation"))

    def make_row(self, number: int, starts: Sequence[tuple[int, int]] | None = None) -> gym.Env:
        cells = [self.reset_cell] if starts is None else list(starts)
        return FixedGoalAntMaze(self, cells[number % len(cells)])

    def variants(self, starts: Sequence[tuple[int, int]] | None = None) -> int:
        return 1 if starts is None else len(starts)

    def cells(self, cells: Sequence[tuple[int, int]]) -> tuple[Tensor, float]:
        env = FixedGoalAntMaze(self)
        env.close()
        return cell_centres(self.env_id, env.maze, cells)

    def label(self, steps: TensorDictBase) -> TensorDictBase:
        return relabel_goal(steps, self.cells([self.goal_cell])[0][0])

    def over(self, steps: TensorDictBase) -> Tensor:
        return steps["next", "reward"] > 0


class FixedGoalAntMaze(gym.Wrapper):
    """AntMaze with a fixed goal cell and start cell, whose observation is the state.

    Args:
        task (AntMazeTask): the protocol.
        reset_cell (tuple of int, optional): another start cell.

    Raises:
        ValueError: a cell is no (row, column), a wall, or outside the map.
    """

    def __init__(self, task: AntMazeTask, reset_cell: tuple[int, int] | None = None):
        gym.register_envs(gymnasium_robotics)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # v4 is what D4RL's data is of
            env = gym.make(task.env_id, continuing_task=False, max_episode_steps=task.max_steps)
        super().__init__(env)
        self.adapter = task.adapter
        robot: Any = self.unwrapped
        robot.position_noise_range = NOISE
        self.maze = robot.maze
        start = task.reset_cell if reset_cell is None else reset_cell
        self.goal_cell, self.reset_cell = maze_cells(
            task.env_id, self.maze.maze_map, goal_cell=task.goal_cell, reset_cell=start
        )
        self.goal = self.maze.cell_rowcol_to_xy(self.goal_cell)
        self.observation_space = self.adapter.space(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        cells = {"goal_cell": self.goal_cell, "reset_cell": self.reset_cell}
        observation, _ = self.env.reset(seed=seed, options=cells)
        return self.adapter(observation), {}

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return self.adapter(observation), float(reward), terminated, truncated, {}
