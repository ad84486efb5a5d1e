"""OGBench's ant mazes: five goals, of which each row has one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from torchrl_rad.envs.adapter import ObservationAdapter
from torchrl_rad.envs.task import Task

__all__ = ["OGBenchTask"]

GOALS = 5


@dataclass(frozen=True)
class OGBenchTask(Task):
    """An AntMaze of OGBench (Park et al., 2025): its five evaluation goals, taken by rows in turn.

    The observation is the state [29] and ``goal`` [2], x and y of where to go. An episode is over
    when the goal is reached; the score is the share of episodes that reach it.

    Attributes:
        name: of the task.
        env_id: OGBench's id, such as ``"antmaze-medium-stitch-v0"``.
        max_steps: length of an episode.

    Raises:
        ImportError: ``ogbench`` is not installed, once an environment is made.
    """

    name: str
    env_id: str
    max_steps: int = 1000

    reference_scores = (0.0, 1.0)
    reference = "OGBench: the share of episodes that reach the goal"
    figures = ("success", "arrival")

    def make_row(self, number: int, starts: Any = None) -> gym.Env:
        if starts is not None:
            raise ValueError("OGBench's tasks have their own starts; leave evaluation.starts out.")
        try:
            import ogbench  # noqa: F401  registers its environments
        except ImportError as error:
            raise ImportError(
                f"{self.env_id} needs the package ogbench ({error}); install it with "
                'pip install "torchrl_rad[ogbench]".'
            ) from error
        env = gym.make(_id(self.env_id), max_episode_steps=self.max_steps)
        return _WithGoal(env, 1 + number % GOALS)

    def variants(self, starts: Any = None) -> int:
        return GOALS


def _id(name: str) -> str:
    """``antmaze-medium-stitch-v0`` is a data set of the environment ``antmaze-medium-v0``."""
    parts = name.split("-")
    return "-".join([*parts[:-2], parts[-1]])


class _WithGoal(gym.Wrapper):
    def __init__(self, env: gym.Env, number: int):
        super().__init__(env)
        self.number, self.goal, self.draws = (
            number,
            np.zeros(2, np.float32),
            np.random.default_rng(),
        )
        state = ObservationAdapter().space(env.observation_space)
        goal = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = gym.spaces.Dict({"observation": state, "goal": goal})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        if seed is not None:
            self.draws = np.random.default_rng(seed)
        before = np.random.get_state()
        np.random.seed(int(self.draws.integers(2**32)))  # of starts and goals, not seeded otherwise
        observation, info = self.env.reset(seed=seed, options={"task_id": self.number})
        np.random.set_state(before)
        self.goal = np.asarray(info["goal"][:2], np.float32)
        return self._seen(observation), {}

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return self._seen(observation), float(reward), terminated, truncated, {}

    def _seen(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        return {"observation": np.asarray(observation, np.float32), "goal": self.goal}
