"""The kitchen: several things to do in any order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import gymnasium_robotics
from tensordict import TensorDictBase

from torchrl_rad.data.kitchen import relabel_tasks
from torchrl_rad.envs.task import Task

__all__ = ["KitchenTask"]


@dataclass(frozen=True)
class KitchenTask(Task):
    """gymnasium-robotics' FrankaKitchen by D4RL's protocol: each thing done counts once.

    The state is the robot's and the objects' positions and speeds [59]. An episode is over when all
    is done. The score is the share of the things that were done.

    Attributes:
        name: of the task.
        subtasks: what is to be done.
        max_steps: length of an episode.

    Examples:
        >>> task = KitchenTask("kitchen-mixed", ("microwave", "kettle", "bottom burner"))
        >>> task.reference_scores
        (0.0, 3.0)
    """

    name: str
    subtasks: tuple[str, ...]
    max_steps: int = 280

    figures = ("return", "length")
    reference = "D4RL's kitchen (d4rl/infos.py): the number of things done"

    @property
    def reference_scores(self) -> tuple[float, float]:  # type: ignore[override]
        return 0.0, float(len(self.subtasks))

    def label(self, steps: TensorDictBase) -> TensorDictBase:
        return relabel_tasks(steps, self.subtasks)

    def make_row(self, number: int, starts: Any = None) -> gym.Env:
        if starts is not None:
            raise ValueError("the kitchen has one start; leave evaluation.starts out.")
        gym.register_envs(gymnasium_robotics)
        env = gym.make(
            "FrankaKitchen-v1",
            tasks_to_complete=list(self.subtasks),
            remove_task_when_completed=True,
            terminate_on_tasks_completed=True,
            max_episode_steps=self.max_steps,
            disable_env_checker=True,  # it warns of observations that share memory; ours are copied
        )
        return _Flat(env, self)


class _Flat(gym.Wrapper):
    def __init__(self, env: gym.Env, task: KitchenTask):
        super().__init__(env)
        self.adapter = task.adapter
        self.observation_space = self.adapter.space(env.observation_space)

    def reset(self, **options):
        observation, _ = self.env.reset(**options)
        return self.adapter(observation).copy(), {}

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return self.adapter(observation).copy(), float(reward), terminated, truncated, {}
