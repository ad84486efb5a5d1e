"""What every task has: an environment of many rows, rewards for recorded steps, a score."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import DoubleToFloat, GymWrapper, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose, InitTracker

from torchrl_rad.envs.adapter import ObservationAdapter

__all__ = ["StartStates", "Task", "batched"]


class Task(ABC):
    """One family member: how it is acted in, how recorded steps are rewarded, how it is scored.

    Attributes:
        name: of the task.
        max_steps: length of an episode.
        reference_scores: returns that are 0 and 100 of the normalised score.
        reference: who says so.
        figures: what the table shows beside the score, as of
            :func:`~torchrl_rad.evaluation.episode_results`.
        adapter: from a recorded or live observation to the state.
    """

    name: str
    max_steps: int
    reference_scores: tuple[float, float]
    reference: str
    figures: Sequence[str] = ("success", "arrival", "share")
    adapter: ObservationAdapter = ObservationAdapter()

    @abstractmethod
    def make_row(self, number: int, starts: Any = None) -> gym.Env:
        """The environment of one row, whose observation is the state."""

    def widths(self) -> tuple[int, int]:
        """Of the states and actions of the environment."""
        env: Any = self.make_row(0)
        space = env.observation_space
        state: Any = space["observation"] if isinstance(space, gym.spaces.Dict) else space
        widths = state.shape[-1], env.action_space.shape[-1]
        env.close()
        return widths

    def starts(self) -> Tensor | None:
        """Where episodes begin, [n, 2 or more], if that is known beforehand."""
        return None

    def cells(self, cells: Sequence[tuple[int, int]]) -> tuple[Tensor, float]:
        """Centres [n, 2] of cells (row, column) of a maze, and half of a cell's side.

        Raises:
            ValueError: the task has no cells, or one is a wall.
        """
        raise ValueError(f"{self.name} has no cells: it is no maze.")

    def label(self, steps: TensorDictBase) -> TensorDictBase:
        """Gives recorded steps [T] the rewards of this task; as they are unless it says else."""
        return steps

    def over(self, steps: TensorDictBase) -> Tensor:
        """Which of the labelled steps [T] end the task, bool [T, 1], whether or not the recording
        goes on.
        """
        return steps["next", "terminated"]

    def normalised_score(self, episode_return: float | np.ndarray) -> Any:
        """Return of an episode on the scale of ``reference_scores``: 0 to 100."""
        low, high = self.reference_scores
        return 100.0 * (episode_return - low) / (high - low)

    @property
    def score_source(self) -> str:
        """The line under a table: how the scores are normalised, and by whose returns."""
        low, high = self.reference_scores
        returns = f"reference returns {low} and {high} of {self.reference}"
        return f"score: 100 x (return - min) / (max - min), {returns}"

    def variants(self, starts: Any = None) -> int:
        """Kinds of rows, which they take in turn: row n is made as row n + variants."""
        return 1

    def make_env(
        self, rows: int, seed: int = 0, starts: Any = None, first: int = 0
    ) -> TransformedEnv:
        """A TorchRL environment with ``rows`` independent rows.

        Row by row, the start states depend on the seed alone.

        Args:
            rows (int): number of rows.
            seed (int, optional): of the start states. Defaults to ``0``.
            starts (optional): where episodes begin, as each task says. Defaults to its own starts.
            first (int, optional): number of the first row, where these are some of more. Defaults
                to ``0``.

        Raises:
            ValueError: ``rows`` is below 1.
        """
        if rows < 1:
            raise ValueError(f"rows is {rows}; an environment has at least one row.")
        numbers = range(first, first + rows)
        return batched([partial(self.make_row, number, starts) for number in numbers], seed)


def batched(makers: Sequence[Callable[[], gym.Env]], seed: int) -> TransformedEnv:
    """A TorchRL environment of gymnasium's, one a row."""

    def row(make: Callable[[], gym.Env]) -> TransformedEnv:
        # the cast sits inside each row: outside a batched env it breaks partial steps
        return TransformedEnv(GymWrapper(make()), DoubleToFloat())

    env = SerialEnv(len(makers), [partial(row, make) for make in makers])
    env = TransformedEnv(env, Compose(InitTracker()))
    env.set_seed(seed)
    return env


class StartStates(gym.Wrapper):
    """A MuJoCo environment whose episodes begin in one of some simulator states.

    Args:
        env (gym.Env): with ``set_state`` and ``_get_obs``, as gymnasium's.
        starts (TensorDictBase): ``qpos`` [n, nq] and ``qvel`` [n, nv], of which each reset draws.

    Raises:
        ValueError: there are none, or they have other widths than the simulator's.

    Examples:
        >>> from tensordict import TensorDict
        >>> env = gym.make("Hopper-v5")
        >>> starts = TensorDict({"qpos": torch.full((1, 6), 1.3), "qvel": torch.zeros(1, 6)}, [1])
        >>> observation, _ = StartStates(env, starts).reset(seed=0)
        >>> observation[:2].round(3).tolist()
        [1.3, 1.3]
    """

    def __init__(self, env: gym.Env, starts: TensorDictBase):
        super().__init__(env)
        robot: Any = self.unwrapped
        widths = (robot.model.nq, robot.model.nv)
        came = tuple(starts[name].shape[-1] for name in ("qpos", "qvel"))
        if len(starts) == 0 or came != widths:
            raise ValueError(
                f"start states are {len(starts)} with qpos and qvel of widths {came}; expected at "
                f"least one, of widths {widths}."
            )
        self.qpos, self.qvel = (
            starts[name].to("cpu", torch.float64).numpy() for name in ("qpos", "qvel")
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        _, info = self.env.reset(seed=seed, options=options)
        robot: Any = self.unwrapped
        start = int(robot.np_random.integers(len(self.qpos)))
        robot.set_state(self.qpos[start], self.qvel[start])
        return robot._get_obs(), info
