"""Tasks by the ``env`` part of a config."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from torchrl_rad.envs.antmaze import AntMazeTask
from torchrl_rad.envs.kitchen import KitchenTask
from torchrl_rad.envs.locomotion import LocomotionTask
from torchrl_rad.envs.maze import maze_task
from torchrl_rad.envs.ogbench import OGBenchTask
from torchrl_rad.envs.task import Task

__all__ = ["make_task"]

FAMILIES: dict[str, Callable[..., Task]] = {
    "antmaze": AntMazeTask,
    "kitchen": KitchenTask,
    "locomotion": LocomotionTask,
    "ogbench": OGBenchTask,
    "pointmaze": lambda name, maze: maze_task(maze),
}


def make_task(settings: Mapping[str, Any]) -> Task:
    """The task that a config describes.

    Args:
        settings (mapping): ``name``; ``family``, one of ``"antmaze"``, ``"kitchen"``,
            ``"locomotion"``, ``"ogbench"`` and ``"pointmaze"``; and what that family's task takes.
            For ``"pointmaze"``: ``maze``.

    Raises:
        KeyError: the family or the maze is not known.
        ValueError: the family's task takes other arguments.

    Examples:
        >>> make_task({"name": "hopper-medium", "family": "locomotion", "env_id": "Hopper-v5"})
        LocomotionTask(name='hopper-medium', env_id='Hopper-v5', max_steps=1000)
    """
    rest = dict(settings)
    family = rest.pop("family", None)
    if family not in FAMILIES:
        raise KeyError(f"unknown family of tasks {family!r}; known families are {list(FAMILIES)}.")
    makes = FAMILIES[family]
    takes = list(inspect.signature(makes).parameters)
    if not rest.keys() <= set(takes):
        wrong = [f"env.{key}" for key in rest if key not in takes]
        raise ValueError(f"tasks of the family {family!r} take {takes} in env; leave out {wrong}.")
    lists = {key: tuple(value) for key, value in rest.items() if isinstance(value, list)}
    return makes(**{**rest, **lists})
