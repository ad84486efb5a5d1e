"""Observations of FrankaKitchen in which chosen tasks are in place."""

import numpy as np

from torchrl_rad.data.kitchen import TASKS


def kitchen_states(in_place, tasks, width=59, seed=0):
    """Observations [L, width] in which the tasks are where ``in_place`` [L, n] says."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(len(in_place), width))
    first_object = {59: 18, 60: 9}[width]
    for column, task in enumerate(tasks):
        first, goal = TASKS[task]
        apart = rng.normal(size=(len(in_place), len(goal)))
        apart /= np.linalg.norm(apart, axis=-1, keepdims=True)
        far = np.where(in_place[:, column], 0.29, 0.31)[:, None]
        states[:, first_object + first :][:, : len(goal)] = np.array(goal) + far * apart
    return states


def goal_dict(states, tasks):
    """The goals as gymnasium-robotics gives them beside its 59 observations."""
    found = {task: states[:, 18 + TASKS[task][0] :][:, : len(TASKS[task][1])] for task in tasks}
    wanted = {task: np.tile(TASKS[task][1], (len(states), 1)) for task in tasks}
    return {"observation": states, "achieved_goal": found, "desired_goal": wanted}
