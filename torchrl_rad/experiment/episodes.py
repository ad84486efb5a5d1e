"""Whole episodes of a policy, in units that come out the same whoever drives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl._utils import seed_generator
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_rad.data.sources import find_dataset, load_dataset
from torchrl_rad.envs.task import Task
from torchrl_rad.evaluation import evaluate

__all__ = [
    "HeldRows",
    "Unit",
    "collect_episodes",
    "join_units",
    "load_starts",
    "split_units",
]


def collect_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    max_steps: int,
    seed: int,
    name: str = "policy",
    dtype: torch.dtype | None = None,
    progress: bool = True,
) -> TensorDictBase:
    """The first episode of each row of an environment; same seed, same episodes.

    Args:
        env (EnvBase): [n] rows, as of :meth:`~torchrl_rad.envs.Task.make_env`.
        policy (TensorDictModuleBase): what acts.
        max_steps (int): limit of an episode.
        seed (int): of the start states and of the policy's noise.
        name (str, optional): shown beside the progress bar.
        dtype (torch.dtype, optional): of autocast, as of
            :func:`~torchrl_rad.precision.planning_dtype`. Defaults to float32.
        progress (bool, optional): show a bar. Defaults to ``True``.

    Returns:
        See :func:`~torchrl_rad.evaluation.evaluate`.
    """
    device = next(policy.parameters()).device

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        with torch.autocast(device.type, dtype, dtype is not None):
            return policy(tensordict.to(device)).to("cpu")  # where the simulator is

    env.set_seed(seed)
    torch.manual_seed(seed)
    bar = tqdm(total=max_steps, desc=f"evaluating {name}", unit="step", disable=not progress)
    with bar:
        return evaluate(env, act, max_steps, progress=bar.update)


def load_starts(settings: Mapping[str, Any] | None) -> Any:
    """Where episodes begin, for :meth:`~torchrl_rad.envs.Task.make_env`; None: the task's own.

    Args:
        settings (mapping, optional): ``cells``, a list of (row, column); or ``states``, names of a
            data set as of :func:`~torchrl_rad.data.find_dataset`, whose infos hold ``qpos`` and
            ``qvel``.

    Raises:
        FileNotFoundError: the data set is not here.
        ValueError: neither is given.
    """
    if settings is None:
        return None
    if settings.get("cells"):
        return [tuple(cell) for cell in settings["cells"]]
    if not settings.get("states"):
        raise ValueError(f"evaluation.starts is {dict(settings)}; expected cells or states.")
    names = find_dataset(settings["states"])
    return load_dataset(names, infos=("qpos", "qvel"), progress=False)["info"]


@dataclass(frozen=True)
class Unit:
    """Episodes that are driven side by side: the least that is done, or done again, as a whole.

    A row's noise depends on the rows beside it, so a unit has its own seed and its rows stay
    together: what comes of it depends neither on other units nor on who drives it.

    Attributes:
        number: of the unit.
        first: number of its first row among all.
        rows: how many.
        seed: of its start states and noise.
    """

    number: int
    first: int
    rows: int
    seed: int


def split_units(episodes: int, rows: int | None, seed: int) -> list[Unit]:
    """Units of ``rows`` episodes, the last one of what is left.

    The start state of each episode is the same however they are split; its noise is not.

    Args:
        episodes (int): number of all.
        rows (int, optional): of a unit. Defaults to all of them in one.
        seed (int): of the first unit; the others' follow from it, as TorchRL seeds rows.

    Raises:
        ValueError: a number is below 1.

    Examples:
        >>> [(unit.first, unit.rows) for unit in split_units(5, rows=2, seed=7)]
        [(0, 2), (2, 2), (4, 1)]
        >>> split_units(5, rows=None, seed=7)
        [Unit(number=0, first=0, rows=5, seed=7)]
    """
    rows = episodes if rows is None else rows
    if min(episodes, rows) < 1:
        raise ValueError(f"there are {episodes} episodes in units of {rows}; both are at least 1.")
    units = []
    for number, first in enumerate(range(0, episodes, rows)):
        count = min(rows, episodes - first)
        units.append(Unit(number, first, count, seed))
        for _ in range(count):
            seed = seed_generator(seed)
    return units


def join_units(parts: Sequence[TensorDictBase]) -> TensorDictBase:
    """Episodes [n, T] of all units from those of each, [n_i, T_i]; T is the longest.

    A unit ends when all of its rows have: its last step, ``done`` True, is repeated.

    Examples:
        >>> from tensordict import TensorDict
        >>> parts = [TensorDict({"done": torch.ones(1, steps)}, [1, steps]) for steps in (2, 3)]
        >>> join_units(parts).shape
        torch.Size([2, 3])
    """
    if len(parts) == 1:
        return parts[0]
    longest = max(part.shape[1] for part in parts)
    padded = []
    for part in parts:
        missing = longest - part.shape[1]
        tail = part[:, -1:].expand(part.shape[0], missing)
        padded.append(torch.cat([part, tail], 1) if missing else part)
    return torch.cat(padded)


class HeldRows:
    """Drives units of episodes in this process.

    The environment is kept for the next unit: a row takes up to half a second to make.

    Args:
        task (Task): what it is of.
        starts (optional): as of :func:`load_starts`.
    """

    def __init__(self, task: Task, starts: Any = None):
        self.task, self.starts = task, starts
        self._key: tuple[int, int] | None = None
        self._env: EnvBase | None = None

    def __call__(self, unit: Unit) -> EnvBase:
        """Rows as those from ``unit.first`` on of an environment of all; not seeded."""
        first = unit.first % self.task.variants(self.starts)
        if self._env is None or self._key != (unit.rows, first):
            self.close()
            self._env = self.task.make_env(unit.rows, starts=self.starts, first=first)
            self._key = unit.rows, first
        return self._env

    def drive(
        self,
        units: Sequence[Unit],
        policy: TensorDictModuleBase,
        max_steps: int,
        name: str = "policy",
        dtype: torch.dtype | None = None,
        progress: bool = True,
    ) -> TensorDictBase:
        """The episodes [n, T] of all units, in their order.

        Args:
            units (sequence of Unit): of :func:`split_units`.
            policy, max_steps, name, dtype, progress: as of :func:`collect_episodes`.
        """
        return join_units(
            [
                collect_episodes(self(unit), policy, max_steps, unit.seed, name, dtype, progress)
                for unit in units
            ]
        )

    def close(self) -> None:
        """Closes it; the number of threads, which TorchRL then raises, stays as it was."""
        if self._env is None:
            return
        threads = torch.get_num_threads()
        self._env.close()
        torch.set_num_threads(threads)
        self._env = None
