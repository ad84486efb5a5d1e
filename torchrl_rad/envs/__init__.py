"""Tasks, the observation adapter and the maze protocol."""

from torchrl_rad.envs.adapter import ObservationAdapter
from torchrl_rad.envs.antmaze import AntMazeTask
from torchrl_rad.envs.kitchen import KitchenTask
from torchrl_rad.envs.locomotion import LocomotionTask
from torchrl_rad.envs.maze import FixedGoalMaze, MazeTask, make_maze_env, maze_task, relabel_goal
from torchrl_rad.envs.ogbench import OGBenchTask
from torchrl_rad.envs.task import StartStates, Task
from torchrl_rad.envs.tasks import make_task

__all__ = [
    "AntMazeTask",
    "FixedGoalMaze",
    "KitchenTask",
    "LocomotionTask",
    "MazeTask",
    "OGBenchTask",
    "ObservationAdapter",
    "StartStates",
    "Task",
    "make_maze_env",
    "make_task",
    "maze_task",
    "relabel_goal",
]
