"""Every family of tasks: acted in, rewarded, scored."""

import builtins
import importlib.util

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_rad.envs import (
    AntMazeTask,
    KitchenTask,
    LocomotionTask,
    OGBenchTask,
    StartStates,
    make_task,
)
from torchrl_rad.evaluation import episode_results, evaluate

ANT = {"name": "ant", "family": "antmaze", "env_id": "AntMaze_Medium-v4", "goal_cell": [6, 6]}
KITCHEN = {"name": "kitchen", "family": "kitchen", "subtasks": ["microwave", "kettle"]}
HOPPER = {"name": "hopper", "family": "locomotion", "env_id": "Hopper-v5"}
OGBENCH = {"name": "og", "family": "ogbench", "env_id": "antmaze-medium-stitch-v0"}
POINT = {"name": "point", "family": "pointmaze", "maze": "umaze"}
SIZES = {"ant": (29, 8), "kitchen": (59, 9), "hopper": (11, 3), "og": (29, 8), "point": (4, 2)}
needs_ogbench = pytest.mark.skipif(
    importlib.util.find_spec("ogbench") is None, reason="needs ogbench"
)
families = pytest.mark.parametrize(
    "settings",
    [ANT, HOPPER, KITCHEN, pytest.param(OGBENCH, marks=needs_ogbench), POINT],
    ids=lambda settings: settings["family"],
)


def still(env):
    """A policy that does nothing."""
    return lambda td: td.set("action", torch.zeros_like(env.full_action_spec["action"].zero()))


@families
def test_rows_are_those_of_torchrl(settings):
    env = make_task(settings).make_env(2, seed=1)
    check_env_specs(env)
    steps = evaluate(env, still(env), max_steps=4)
    states, actions = SIZES[settings["name"]]
    assert steps["observation"].shape == (2, 4, states) and steps["action"].shape[-1] == actions
    assert steps["observation"].dtype == steps["next", "reward"].dtype == torch.float32
    env.close()


@families
def test_starts_depend_on_the_seed_alone(settings):
    task = make_task(settings)
    first, again, other = (task.make_env(2, seed=seed) for seed in (3, 3, 4))
    states = [env.reset()["observation"] for env in (first, again, other)]
    assert torch.equal(states[0], states[1]) and not torch.equal(states[0], states[2])
    assert not torch.equal(states[0][0], states[0][1])


@families
def test_widths(settings):
    assert make_task(settings).widths() == SIZES[settings["name"]]


@families
def test_no_rows(settings):
    with pytest.raises(ValueError, match="rows is 0; an environment has at least one row"):
        make_task(settings).make_env(0)


@pytest.mark.parametrize(
    ("settings", "low", "high"),
    [(ANT, 0.0, 1.0), (KITCHEN, 0.0, 2.0), (HOPPER, -20.272305, 3234.3), (OGBENCH, 0.0, 1.0)],
)
def test_scores(settings, low, high):
    task = make_task(settings)
    scores = task.normalised_score(np.array([low, (low + high) / 2, high]))
    assert np.allclose(scores, [0, 50, 100])
    assert f"{low} and {high} of" in task.score_source


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({**HOPPER, "family": "boat"}, KeyError, "unknown family of tasks 'boat'"),
        ({"name": "x", "maze": "umaze"}, KeyError, "unknown family of tasks None"),
        ({**HOPPER, "env_id": "Ant-v5"}, KeyError, "no reference returns for 'Ant-v5'"),
        ({**POINT, "maze": "moon"}, KeyError, "unknown maze 'moon'"),
        ({**HOPPER, "goal": 1}, ValueError, r"family 'locomotion' take .*leave out \['env.goal'\]"),
        ({**POINT, "max_steps": 9}, ValueError, r"take \['name', 'maze'\].*\['env.max_steps'\]"),
    ],
)
def test_tasks_that_are_none(settings, error, message):
    with pytest.raises(error, match=message):
        make_task(settings)


# running robots


def test_an_episode_ends_where_the_hopper_falls():
    task = LocomotionTask("hopper", "Hopper-v5")
    env = task.make_env(2)
    results = episode_results(evaluate(env, still(env), max_steps=task.max_steps))
    assert (results["length"] < 200).all() and (results["return"] > 0).all()


def test_starts_from_simulator_states():
    generator = torch.Generator().manual_seed(0)
    qpos = torch.rand(50, 6, generator=generator) / 100 + torch.tensor([0, 1.25, 0, 0, 0, 0])
    starts = TensorDict({"qpos": qpos, "qvel": torch.zeros(50, 6)}, [50])
    env = LocomotionTask("hopper", "Hopper-v5").make_env(40, seed=0, starts=starts)
    states = env.reset()["observation"]
    env.close()
    gap = (states[:, None, :5] - qpos[None, :, 1:]).abs().amax(-1)
    assert (gap.amin(1) < 1e-6).all() and (states[:, 5:] == 0).all()
    assert len(gap.argmin(1).unique()) > 20


@pytest.mark.parametrize("widths", [(5, 6), (6, 5)])
def test_simulator_states_of_another_robot(widths):
    starts = TensorDict({"qpos": torch.zeros(3, widths[0]), "qvel": torch.zeros(3, widths[1])}, [3])
    with pytest.raises(ValueError, match="expected at least one, of widths"):
        LocomotionTask("hopper", "Hopper-v5").make_row(0, starts)
    with pytest.raises(ValueError, match="start states are 0 with"):
        LocomotionTask("hopper", "Hopper-v5").make_row(0, starts[:0])


def test_a_start_is_what_the_simulator_was_set_to():
    task = LocomotionTask("walker", "Walker2d-v5")
    plain = task.make_row(0)
    plain.reset(seed=0)
    for _ in range(5):
        observation, *_ = plain.step(plain.action_space.sample())
    data = plain.unwrapped.data
    starts = TensorDict(
        {"qpos": torch.tensor(data.qpos)[None], "qvel": torch.tensor(data.qvel)[None]}, [1]
    )
    row = task.make_row(0, starts)
    assert isinstance(row, StartStates)
    assert np.allclose(row.reset(seed=9)[0], observation)


# the ant


def test_the_ant_starts_where_it_is_told():
    task = make_task(ANT)
    centre = task.make_row(0).maze.cell_rowcol_to_xy
    rows = task.make_env(3, starts=[(6, 6), (3, 4)])
    places = rows.reset()["observation"][:, :2].numpy()
    cells = np.stack([centre(np.array(cell)) for cell in [(6, 6), (3, 4), (6, 6)]])
    assert np.abs(places - cells).max() <= 0.1 + 0.1  # and the reset noise of the ant itself
    with pytest.raises(ValueError, match="is a wall or outside the map"):
        task.make_row(0, [(0, 0)])


@pytest.mark.parametrize(("version", "width"), [("v4", 29), ("v5", 107)])
def test_the_ant_is_as_wide_as_in_its_version(version, width):
    task = AntMazeTask("ant", f"AntMaze_Medium-{version}", (6, 6))
    assert task.widths() == (width, 8)
    assert task.make_env(1, seed=0).rollout(2)["observation"].shape == (1, 2, width)


def test_the_ant_is_paid_and_stops_at_the_goal():
    task = AntMazeTask("ant", "AntMaze_Medium-v4", (6, 6))
    env = task.make_row(0)
    env.reset(seed=0)
    robot = env.unwrapped
    qpos, qvel = robot.ant_env.data.qpos.copy(), robot.ant_env.data.qvel.copy()
    qpos[:2] = robot.goal
    robot.ant_env.set_state(qpos, qvel)
    state, reward, terminated, _, _ = env.step(np.zeros(8, np.float32))
    assert state.shape == (29,) and reward == 1.0 and terminated
    assert np.linalg.norm(state[:2] - robot.goal) < 0.45


def test_recorded_steps_are_paid_at_the_fixed_goal():
    task = make_task(ANT)
    goal = task.make_row(0).goal
    following = torch.zeros(3, 29)
    following[1, :2] = torch.tensor(goal) + torch.tensor([0.49, 0.0])
    following[2, :2] = torch.tensor(goal) + torch.tensor([0.51, 0.0])
    steps = TensorDict({"next": {"observation": following, "reward": torch.ones(3, 1)}}, [3])
    labelled = task.label(steps)
    assert labelled["next", "reward"].squeeze(-1).tolist() == [0.0, 1.0, 0.0]
    assert task.over(labelled).squeeze(-1).tolist() == [False, True, False]


# the kitchen


def test_a_thing_done_counts_once():
    env = KitchenTask("kitchen", ("microwave", "kettle")).make_row(0)
    state, _ = env.reset(seed=0)
    robot = env.unwrapped
    joint = robot.model.joint("microwave").qposadr[0] if hasattr(robot, "model") else None
    robot = robot.robot_env if joint is None else robot
    address = robot.model.joint("microwave").qposadr[0]
    rewards = []
    for _ in range(3):
        robot.data.qpos[address] = -0.75
        following, reward, terminated, *_ = env.step(np.zeros(9, np.float32))
        rewards.append(reward)
    assert rewards == [1.0, 0.0, 0.0] and not terminated
    assert state.shape == (59,) and not np.shares_memory(state, following)
    with pytest.raises(ValueError, match="the kitchen has one start"):
        KitchenTask("kitchen", ("kettle",)).make_row(0, [1])


# OGBench


@needs_ogbench
def test_rows_take_the_five_goals_in_turn():
    env = OGBenchTask("og", "antmaze-medium-stitch-v0").make_env(6)
    td = env.reset()
    env.close()
    assert td["goal"].shape == (6, 2)
    near = (td["goal"][0] - td["goal"]).norm(dim=-1)
    assert near[5] < 2.9 and (near[1:5] > 5).all()  # noise of one in each direction


def test_ogbench_is_an_extra(monkeypatch):
    real = builtins.__import__

    def absent(name, *args, **kwargs):
        if name == "ogbench":
            raise ImportError("No module named 'ogbench'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ImportError, match=r'pip install "torchrl_rad\[ogbench\]"'):
        OGBenchTask("og", "antmaze-medium-stitch-v0").make_row(0)
    with pytest.raises(ValueError, match="OGBench's tasks have their own starts"):
        OGBenchTask("og", "antmaze-medium-stitch-v0").make_row(0, [1])
