"""Tasks done in FrankaKitchen, from goals and from flat observations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.data import KITCHEN_TASKS, newly_done, relabel_tasks, tasks_done, tasks_in_place
from torchrl_rad.data.kitchen import TASKS

from .kitchen_states import goal_dict, kitchen_states


def test_task_table_is_that_of_the_environment():
    kitchen = pytest.importorskip("gymnasium_robotics.envs.franka_kitchen.kitchen_env")
    assert set(kitchen.OBS_ELEMENT_INDICES) == set(TASKS)
    for task, (first, goal) in TASKS.items():
        assert kitchen.OBS_ELEMENT_INDICES[task][0] == 9 + first
        np.testing.assert_allclose(kitchen.OBS_ELEMENT_GOALS[task], goal)
    assert kitchen.BONUS_THRESH == 0.3


@pytest.mark.parametrize("tasks", [*KITCHEN_TASKS.values(), tuple(TASKS)])
def test_in_place_from_every_form(tasks):
    expected = np.random.default_rng(1).random((40, len(tasks))) < 0.4
    for width in (59, 60):
        states = kitchen_states(expected, tasks, width)
        assert tasks_in_place(states, tasks).tolist() == expected.tolist()
    goals = goal_dict(kitchen_states(expected, tasks), tasks)
    assert tasks_in_place(goals).tolist() == expected.tolist()
    assert tasks_in_place(goals, tasks[:1]).tolist() == expected[:, :1].tolist()
    one = torch.from_numpy(kitchen_states(expected, tasks)[3]).float()
    assert tasks_in_place(one, tasks).tolist() == expected[3].tolist()


@settings(max_examples=50, deadline=None)
@given(lengths=st.lists(st.integers(1, 6), min_size=1, max_size=5), seed=st.integers(0, 99))
def test_rewards_against_a_loop(lengths, seed):
    tasks = KITCHEN_TASKS["mixed"]
    following = np.random.default_rng(seed).random((sum(lengths), 4)) < 0.2
    episode = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    states = torch.from_numpy(kitchen_states(following, tasks, 60)).float()
    steps = TensorDict({"episode": episode, "next": {"observation": states}}, [len(states)])
    done, rewards, row = [], [], 0
    for length in lengths:
        over: set = set()
        for now in following[row : row + length]:
            new = set(np.flatnonzero(now)) - over
            over |= new
            rewards.append(len(new))
            done.append(len(over))
        row += length
    assert tasks_done(torch.from_numpy(following), torch.tensor(lengths)).tolist() == done
    assert relabel_tasks(steps, tasks)["next", "reward"].tolist() == [[r] for r in rewards]
    assert "reward" not in steps["next"].keys()


def test_a_task_in_place_from_the_start_counts_at_the_first_step():
    now = np.array([[True], [True], [False]])
    goals = goal_dict(kitchen_states(now, ["kettle"]), ["kettle"])
    assert newly_done(goals).tolist() == [1, 0]
    undone = goal_dict(kitchen_states(now[[0, 2, 2]], ["kettle"]), ["kettle"])
    assert newly_done(undone).tolist() == [0, 0]


def test_errors():
    with pytest.raises(ValueError, match="has 30 entries, expected 59"):
        tasks_in_place(np.zeros((2, 30)), ["kettle"])
    with pytest.raises(ValueError, match="has 0 entries"):
        tasks_in_place(1.0, ["kettle"])
    with pytest.raises(ValueError, match="does not say its tasks"):
        tasks_in_place(np.zeros((2, 60)))
    with pytest.raises(KeyError, match="unknown tasks .'toaster'."):
        tasks_in_place(np.zeros((2, 60)), ["toaster"])
    with pytest.raises(KeyError, match="no dict of tasks in .'desired_goal'."):
        tasks_in_place({"achieved_goal": {}, "desired_goal": np.zeros(2)})
    goals = goal_dict(np.ones((2, 59)), ["kettle"])
    with pytest.raises(KeyError, match="has no tasks .'microwave'.; it has .'kettle'."):
        tasks_in_place(goals, ["microwave"])
    goals["achieved_goal"]["kettle"] = np.ones((2, 1))
    with pytest.raises(ValueError, match="'kettle': achieved_goal is"):
        tasks_in_place(goals)
