"""Running robots of gymnasium's MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from tensordict import TensorDictBase

from torchrl_rad.envs.task import StartStates, Task

__all__ = ["LocomotionTask"]

REFERENCES = {
    "Hopper": (-20.272305, 3234.3),
    "HalfCheetah": (-280.178953, 12135.0),
    "Walker2d": (1.629008, 4592.3),
}


@dataclass(frozen=True)
class LocomotionTask(Task):
    """Hopper, HalfCheetah or Walker2d: the return of 1000 steps, or until it falls.

    ``starts`` of :meth:`make_env` are simulator states, as of
    :class:`~torchrl_rad.envs.task.StartStates`.

    Attributes:
        name: of the task.
        env_id: gymnasium id, such as ``"Hopper-v5"``.
        max_steps: length of an episode.

    Raises:
        KeyError: there are no reference returns for the robot.

    Examples:
        >>> task = LocomotionTask("hopper-medium", "Hopper-v5")
        >>> task.reference_scores, task.make_env(2).rollout(3)["observation"].shape
        ((-20.272305, 3234.3), torch.Size([2, 3, 11]))
    """

    name: str
    env_id: str
    max_steps: int = 1000

    figures = ("length",)
    reference = "D4RL's -v2 data sets (d4rl/infos.py), whose simulation differs from -v5"

    def __post_init__(self):
        self.reference_scores  # noqa: B018  a robot without any is refused here

    @property
    def reference_scores(self) -> tuple[float, float]:  # type: ignore[override]
        robot = self.env_id.split("-")[0]
        if robot not in REFERENCES:
            raise KeyError(f"no reference returns for {self.env_id!r}; known: {sorted(REFERENCES)}")
        return REFERENCES[robot]

    def make_row(self, number: int, starts: TensorDictBase | None = None) -> gym.Env[Any, Any]:
        env = gym.make(self.env_id, max_episode_steps=self.max_steps)
        return env if starts is None else StartStates(env, starts)
