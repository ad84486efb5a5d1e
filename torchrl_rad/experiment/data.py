"""The data of a run: found, rewarded, restricted, checked, cut into windows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_rad.data.episodes import episode_lengths, return_to_go
from torchrl_rad.data.experts import expert_from_config, select_episodes
from torchrl_rad.data.maze2d import maze_dataset
from torchrl_rad.data.regions import without_region
from torchrl_rad.data.report import DataReport, report
from torchrl_rad.data.sources import find_dataset, load_dataset
from torchrl_rad.data.windows import window_buffer
from torchrl_rad.envs.maze import MazeTask
from torchrl_rad.envs.task import Task
from torchrl_rad.envs.tasks import make_task

__all__ = [
    "check_data",
    "describe_windows",
    "make_data",
    "resolve_dataset",
    "restrict",
    "task_dataset",
    "window_sampler",
]


def make_data(cfg: Mapping[str, Any]) -> tuple[Task, TensorDictBase]:
    """The task and its recorded steps [T], with ``return_to_go`` at the discount of L_g."""
    task = make_task(cfg["env"])
    data = task_dataset(task, cfg["replay_buffer"], cfg["logger"]["progress"])
    data = restrict(task, data, cfg["replay_buffer"]).copy()
    value = return_to_go(data["next", "reward"], episode_lengths(data), cfg["loss"]["gamma"])
    data["return_to_go"] = value
    return task, data


def task_dataset(task: Task, source: Mapping[str, Any], progress: bool = True) -> TensorDictBase:
    """Recorded steps [T] with the rewards of a task.

    Args:
        task (Task): whose rewards they get.
        source (mapping): ``dataset``, ``download`` and, of a collection, ``steps`` and ``seed``.
        progress (bool, optional): show a progress bar. Defaults to ``True``.
    """
    if isinstance(task, MazeTask):
        options = {name: source[name] for name in ("steps", "seed", "download")}
        (name,) = source["dataset"] if isinstance(source["dataset"], list) else [source["dataset"]]
        return maze_dataset(task, name, **options, progress=progress)
    keys = task.adapter.keys
    return task.label(load_dataset(source["dataset"], keys, (), source["download"], progress))


def resolve_dataset(cfg: dict[str, Any]) -> None:
    """Puts in place of a config's data sets those that are here, so that the run says which.

    Raises:
        FileNotFoundError: none is here, and none can be fetched.
    """
    if cfg["replay_buffer"]["dataset"] != "collected":
        cfg["replay_buffer"]["dataset"] = find_dataset(cfg["replay_buffer"]["dataset"])


def restrict(task: Task, data: TensorDictBase, source: Mapping[str, Any]) -> TensorDictBase:
    """Recorded steps without a region of the maze, or demonstrations alone, if a config says so.

    Args:
        task (Task): of a maze where ``without`` is set.
        data (TensorDictBase): flat steps [T].
        source (mapping): ``without`` (cells; None for none), ``coverage`` (share of the episodes
            that enter them and stay) and ``keep`` (config of an expert rule; None for all).

    Raises:
        ValueError: nothing is left, or the task has no cells.
    """
    if source["without"] is not None:
        centres, half_width = task.cells(source["without"])
        data = without_region(data, centres, half_width, source["coverage"])
    if source["keep"] is not None:
        lengths = episode_lengths(data)
        rule = expert_from_config(source["keep"])
        keep = select_episodes(rule, data.split(lengths.tolist()))
        if not keep.any():
            raise ValueError(f"no episode is left by replay_buffer.keep={rule}.")
        data = data[torch.repeat_interleave(keep, lengths)]
    return data


def check_data(task: Task, data: TensorDictBase) -> DataReport:
    """A report on the data against the task's starts.

    Raises:
        ValueError: it has faults, which the message names, or is of another environment.
    """
    came, expected = (data["observation"].shape[-1], data["action"].shape[-1]), task.widths()
    if came != expected:
        raise ValueError(
            f"the data has observations and actions of widths {came}, but {task.name} has "
            f"{expected}: it is of another environment, or of another version of it. Name another "
            "replay_buffer.dataset, or the version of the data in env.env_id."
        )
    found = report(data, starts=task.starts())
    if not found.ok:
        raise ValueError(f"the data cannot be trained on:\n{found}")
    return found


def describe_windows(data: TensorDictBase, horizon: int) -> str:
    """How many windows there are to train on, and which share of the episodes is too short.

    Examples:
        >>> from tensordict import TensorDict
        >>> describe_windows(TensorDict({"episode": torch.tensor([0, 0, 0, 1])}, [4]), horizon=2)
        'windows of 2 steps: 2, in 1 of 2 episodes; the other 1 (25.0% of the steps) are shorter'
    """
    lengths = episode_lengths(data)
    long = lengths >= horizon
    count, short = int((lengths[long] - horizon + 1).sum()), int((~long).sum())
    text = f"windows of {horizon} steps: {count}, in {int(long.sum())} of {len(lengths)} episodes"
    if short:
        share = int(lengths[~long].sum()) / len(data)
        text += f"; the other {short} ({share:.1%} of the steps) are shorter"
    return text


def window_sampler(data: TensorDictBase, horizon: int, batch_size: int):
    """A function that draws windows [batch_size, horizon] of recorded steps."""
    kept = data.select(
        "observation", "action", "episode", "return_to_go", "value",
        ("next", "observation"), ("next", "reward"), strict=False,
    )  # fmt: skip
    buffer = window_buffer(kept, horizon, batch_size)
    return lambda: buffer.sample().reshape(-1, horizon)
