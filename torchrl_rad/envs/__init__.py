"""Tasks, the observation adapter and the maze protocol."""

from torchrl_rad.envs.adapter import ObservationAdapter
from torchrl_rad.envs.maze import FixedGoalMaze, MazeTask, make_maze_env, maze_task, relabel_goal

__all__ = [
    "FixedGoalMaze",
    "MazeTask",
    "ObservationAdapter",
    "make_maze_env",
    "maze_task",
    "relabel_goal",
]
