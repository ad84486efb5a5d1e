"""Tasks done in FrankaKitchen: in place now, done so far, newly done at a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.data.episodes import episode_lengths, with_reward

__all__ = ["KITCHEN_TASKS", "newly_done", "relabel_tasks", "tasks_done", "tasks_in_place"]

THRESHOLD = 0.3  # distance of the joints to their goal below which a task is in place
ROBOT = 9  # joints of the robot, before those of the objects
OBJECTS = {60: ROBOT, 59: 2 * ROBOT}  # first joint of an object, by width of the observation:
# D4RL has 9 + 21 positions and 30 goals, gymnasium-robotics 9 positions, 9 velocities, 21 + 20

# first position of a task's joints among those of the objects, and their goal
TASKS: dict[str, tuple[int, tuple[float, ...]]] = {
    "bottom burner": (2, (-0.88, -0.01)),
    "top burner": (6, (-0.92, -0.01)),
    "light switch": (8, (-0.69, -0.05)),
    "slide cabinet": (10, (0.37,)),
    "hinge cabinet": (11, (0.0, 1.45)),
    "microwave": (13, (-0.75,)),
    "kettle": (14, (-0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06)),
}
KITCHEN_TASKS = {
    "complete": ("microwave", "kettle", "light switch", "slide cabinet"),
    "partial": ("microwave", "kettle", "light switch", "slide cabinet"),
    "mixed": ("microwave", "kettle", "bottom burner", "light switch"),
}


def tasks_in_place(observation: Any, tasks: Sequence[str] | None = None) -> Tensor:
    """Which tasks are in place: their joints are within 0.3 of the goal.

    Args:
        observation: a dict with ``achieved_goal`` and ``desired_goal``, each task -> [..., d], as
            Minari records it; or a flat array [..., 59] (gymnasium-robotics) or [..., 60] (D4RL).
        tasks (sequence of str, optional): names of tasks. Defaults to those of the dict; a flat
            array does not say them.

    Returns:
        bool [..., number of tasks], in the order of ``tasks``.

    Raises:
        KeyError: the dict lacks the goals, or a task is not known.
        ValueError: a flat array has another width, or came without ``tasks``; the two goals of a
            task differ in width.

    References:
        Fu et al., "D4RL: Datasets for Deep Data-Driven Reinforcement Learning", 2020; Gupta et
        al., "Relay Policy Learning", 2019.

    Examples:
        >>> goals = {"microwave": np.full((2, 1), -0.75)}
        >>> found = {"microwave": np.array([[0.0], [-0.5]])}
        >>> tasks_in_place({"achieved_goal": found, "desired_goal": goals}).tolist()
        [[False], [True]]
        >>> tasks_in_place(torch.zeros(60), ["microwave", "slide cabinet"]).tolist()
        [False, False]
    """
    if isinstance(observation, Mapping):
        return _in_place_of_goals(observation, tasks)
    state = torch.as_tensor(observation)
    width = state.shape[-1] if state.dim() else 0
    if width not in OBJECTS:
        raise ValueError(
            f"the observation has {width} entries, expected 59 (gymnasium-robotics) or 60 (D4RL); "
            "pass the dict with achieved_goal and desired_goal instead."
        )
    if tasks is None:
        raise ValueError(
            "a flat observation does not say its tasks; name them, e.g. KITCHEN_TASKS['partial']."
        )
    unknown = [task for task in tasks if task not in TASKS]
    if unknown:
        raise KeyError(f"unknown tasks {unknown}; known tasks are {sorted(TASKS)}.")
    near = []
    for task in tasks:
        first, goal = TASKS[task]
        joints = state[..., OBJECTS[width] + first :][..., : len(goal)]
        near.append((joints - joints.new_tensor(goal)).norm(dim=-1) < THRESHOLD)
    return torch.stack(near, -1)


def _in_place_of_goals(observation: Mapping[str, Any], tasks: Sequence[str] | None) -> Tensor:
    entries = ("achieved_goal", "desired_goal")
    absent = [key for key in entries if not isinstance(observation.get(key), Mapping)]
    if absent:
        raise KeyError(
            f"the observation has no dict of tasks in {absent}; it has {sorted(observation)}. "
            "Pass the episode of a FrankaKitchen set."
        )
    achieved, desired = (observation[key] for key in entries)
    tasks = list(desired) if tasks is None else tasks
    unknown = [task for task in tasks if task not in achieved or task not in desired]
    if unknown:
        raise KeyError(f"the observation has no tasks {unknown}; it has {sorted(achieved)}.")
    near = []
    for task in tasks:
        found, goal = (np.asarray(goals[task], np.float64) for goals in (achieved, desired))
        if found.shape != goal.shape:
            raise ValueError(
                f"task {task!r}: achieved_goal is {list(found.shape)}, desired_goal "
                f"{list(goal.shape)}; expected the same. Record the episode anew."
            )
        near.append(torch.from_numpy(np.linalg.norm(found - goal, axis=-1) < THRESHOLD))
    return torch.stack(near, -1)


def tasks_done(in_place: Tensor, lengths: Tensor) -> Tensor:
    """Number of tasks that were in place at this step or an earlier one of the episode.

    A task that comes undone still counts, once.

    Args:
        in_place (Tensor): bool [T, n].
        lengths (Tensor): int64 [E], lengths of the episodes.

    Returns:
        int64 [T], never falling within an episode.

    Examples:
        >>> now = torch.tensor([[True, False], [False, False], [False, True], [False, True]])
        >>> tasks_done(now, torch.tensor([3, 1])).tolist()
        [1, 1, 2, 1]
    """
    times = in_place.long().cumsum(0)  # [T, n], over all episodes
    first = torch.repeat_interleave(lengths.cumsum(0) - lengths, lengths)
    earlier = times[first] - in_place[first].long()
    return (times > earlier).sum(-1)


def newly_done(observations: Mapping[str, Any]) -> Tensor:
    """FrankaKitchen's reward for one recorded episode: the tasks newly done at each step.

    The ``reward`` of :func:`~torchrl_rad.data.load_minari` for Kitchen sets. Each task counts
    once, at the first step that ends with it in place, so that the return of an episode is the
    number of tasks done. The recorded rewards are of another kind: the number of tasks in place,
    at every step.

    Args:
        observations (mapping): ``achieved_goal`` and ``desired_goal``, each task -> [L + 1, d].

    Returns:
        float32 [L].

    Raises:
        KeyError, ValueError: as of :func:`tasks_in_place`.

    Examples:
        >>> door = np.array([[0.0], [-0.3], [-0.7], [-0.1], [-0.7]])  # opened, shut, opened
        >>> newly_done({"achieved_goal": {"microwave": door},
        ...             "desired_goal": {"microwave": np.full((5, 1), -0.75)}}).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    following = tasks_in_place(observations)[1:]
    done = tasks_done(following, torch.tensor([len(following)]))
    return torch.diff(done, prepend=done.new_zeros(1)).float()


def relabel_tasks(episodes: TensorDictBase, tasks: Sequence[str]) -> TensorDictBase:
    """Gives recorded steps the reward of FrankaKitchen, as :func:`newly_done`, from flat states.

    In files without next observations (D4RL's) a task that only the very last transition of an
    episode completes is not seen.

    Args:
        episodes (TensorDictBase): flat steps [T] of whole episodes with ``("next",
            "observation")`` [T, 59] or [T, 60].
        tasks (sequence of str): the designated tasks, such as ``KITCHEN_TASKS["partial"]``.

    Returns:
        A shallow copy with ``("next", "reward")`` [T, 1] float32 replaced.

    Raises:
        KeyError: a task is not known.
        ValueError: the observations have another width.

    Examples:
        >>> following = torch.zeros(3, 60)
        >>> following[1, 22] = -0.75  # the microwave's door is open, then falls shut
        >>> from tensordict import TensorDict
        >>> steps = TensorDict({"episode": torch.zeros(3, dtype=torch.int64),
        ...                     "next": {"observation": following}}, [3])
        >>> relabel_tasks(steps, ["microwave"])["next", "reward"].squeeze(-1).tolist()
        [0.0, 1.0, 0.0]
    """
    lengths = episode_lengths(episodes)
    done = tasks_done(tasks_in_place(episodes["next", "observation"], tasks), lengths)
    earlier = done.roll(1)
    earlier[lengths.cumsum(0) - lengths] = 0
    return with_reward(episodes, (done - earlier).float())
