"""The D4RL Maze2D protocol."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_rad import GoalReward
from torchrl_rad.envs import FixedGoalMaze, make_maze_env, maze_task, relabel_goal
from torchrl_rad.envs.maze import RESET_NOISE

NAMES = ["umaze", "medium", "large"]


@pytest.fixture(scope="module")
def mazes():
    return {name: FixedGoalMaze(maze_task(name)) for name in NAMES}


def teleport(env, position, velocity=(0.0, 0.0)):
    env.unwrapped.point_env.set_state(np.array(position), np.array(velocity))


# tasks


@pytest.mark.parametrize(
    ("name", "cell", "steps", "low", "high", "expert"),
    [
        ("umaze", (1, 1), 300, 23.85, 161.86, (200, 300)),
        ("medium", (6, 6), 600, 13.13, 277.39, (400, 600)),
        ("large", (7, 9), 800, 6.7, 273.99, (400, 800)),
    ],
)
def test_protocol(name, cell, steps, low, high, expert):
    task = maze_task(name)
    assert task.name == name and task.env_id.lower() == f"pointmaze_{name}-v3"
    assert (task.goal_cell, task.max_steps, task.expert_steps) == (cell, steps, expert)
    assert task.reference_scores == (low, high)
    assert task.normalised_score(low) == 0 and task.normalised_score(high) == 100


def test_normalised_score_by_hand():
    # (230 - 23.85) / (161.86 - 23.85) = 206.15 / 138.01
    assert maze_task("umaze").normalised_score(230.0) == pytest.approx(149.3732, abs=1e-4)
    assert maze_task("large").normalised_score(0.0) == pytest.approx(-2.5066, abs=1e-4)
    scores = maze_task("medium").normalised_score(np.array([13.13, 145.26]))
    np.testing.assert_allclose(scores, [0, 50], atol=1e-9)


def test_unknown_maze():
    with pytest.raises(KeyError, match=r"unknown maze 'tiny'; known mazes are .*umaze"):
        maze_task("tiny")


# the environment


@pytest.mark.parametrize("name", NAMES)
def test_goal_is_fixed(mazes, name):
    env = mazes[name]
    row, column = maze_task(name).goal_cell
    rows, columns = env.maze.map_length, env.maze.map_width
    # the map's centre is the origin, rows go down
    expected = [column + 0.5 - columns / 2, rows / 2 - row - 0.5]
    assert env.goal.tolist() == expected
    for _ in range(5):
        env.reset()
        assert env.goal.tolist() == expected
        # gymnasium-robotics draws a goal around the cell of its own: it plays no role
        assert np.abs(env.unwrapped.goal - env.goal).max() <= 0.25 * env.maze.maze_size_scaling


def test_reward_is_one_within_half_a_cell(mazes):
    env = mazes["umaze"]
    env.reset(seed=0)
    rewards = []
    for distance in (0.0, 0.45, 0.49, 0.51, 0.7, 1.5):
        teleport(env, env.goal + [distance, 0.0])
        state, reward, *_ = env.step(np.zeros(2, np.float32))
        assert np.hypot(*(state[:2] - env.goal)) == pytest.approx(distance, abs=0.01)
        rewards.append(reward)
    assert rewards == [1, 1, 1, 0, 0, 0]


def test_reward_has_no_corner(mazes):
    env = mazes["umaze"]
    env.reset(seed=0)
    teleport(env, env.goal + [0.4, -0.4])  # 0.57 away
    assert env.step(np.zeros(2, np.float32))[1] == 0
    teleport(env, env.goal + [0.33, -0.33])  # 0.47
    assert env.step(np.zeros(2, np.float32))[1] == 1


@pytest.mark.parametrize("name", NAMES)
def test_ends_at_the_time_limit_only(mazes, name):
    env, task = mazes[name], maze_task(name)
    env.reset(seed=1)
    teleport(env, env.goal)
    for t in range(task.max_steps):
        _, reward, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
        assert reward == 1 and not terminated
        assert truncated == (t == task.max_steps - 1)


@pytest.mark.parametrize("name", NAMES)
def test_start_cells_are_uniform(mazes, name):
    env, cells = mazes[name], mazes[name].free_cells
    draws = 40 * len(cells)
    number = {tuple(cell): i for i, cell in enumerate(cells.tolist())}
    counts = np.zeros(len(cells))
    env.reset(seed=0)
    for _ in range(draws):
        state, _ = env.reset()
        cell = env.maze.cell_xy_to_rowcol(state[:2].astype(np.float64))
        centre = env.maze.cell_rowcol_to_xy(cell)
        assert np.abs(state[:2] - centre).max() <= 0.1 * env.maze.maze_size_scaling + 1e-6
        counts[number[tuple(cell)]] += 1
    degrees = len(cells) - 1
    # the mean of a chi-square and five of its standard deviations
    assert ((counts - 40) ** 2 / 40).sum() < degrees + 5 * (2 * degrees) ** 0.5


def test_free_cells_by_hand(mazes):
    cells = [(1, 1), (1, 2), (1, 3), (2, 3), (3, 1), (3, 2), (3, 3)]
    assert [tuple(cell) for cell in mazes["umaze"].free_cells.tolist()] == cells
    assert [len(mazes[name].free_cells) for name in NAMES] == [7, 26, 46]


def test_seeded_resets(mazes):
    env = mazes["medium"]

    def starts(seed):
        return np.stack([env.reset(seed=seed)[0], env.reset()[0], env.reset()[0]])

    first = starts(7)
    assert np.array_equal(first, starts(7)) and not np.array_equal(first, starts(8))
    assert not np.array_equal(first[0], first[1])


def test_another_goal_and_start_cell():
    env = FixedGoalMaze(maze_task("medium"), goal_cell=(1, 1), reset_cell=(6, 5))
    assert env.goal.tolist() == [-2.5, 2.5]
    for _ in range(5):
        state, _ = env.reset()
        assert env.maze.cell_xy_to_rowcol(state[:2].astype(np.float64)).tolist() == [6, 5]
    teleport(env, (-2.5, 2.5))
    assert env.step(np.zeros(2, np.float32))[1] == 1
    teleport(env, (2.5, -2.5))  # the protocol's goal
    assert env.step(np.zeros(2, np.float32))[1] == 0


@pytest.mark.parametrize("cell", [(0, 0), (2, 2), (9, 9), (-1, 1)])
def test_cell_that_cannot_be_stood_on(cell):
    match = rf"cell \({cell[0]}, {cell[1]}\) of PointMaze_UMaze-v3 is a wall or outside the map"
    with pytest.raises(ValueError, match=match):
        FixedGoalMaze(maze_task("umaze"), goal_cell=cell)
    with pytest.raises(ValueError, match=match):
        FixedGoalMaze(maze_task("umaze"), reset_cell=cell)


@pytest.mark.parametrize("cell", [(1,), (1, 1, 1), 1])
def test_cell_that_is_none(cell):
    with pytest.raises(ValueError, match=r"goal_cell is .*expected \(row, column\)"):
        FixedGoalMaze(maze_task("umaze"), goal_cell=cell)


# relabelling


def test_relabel_by_hand():
    state = torch.tensor([[0.0, 0.0], [0.3, 0.4], [0.3, 0.41], [2.0, 2.0]])
    steps = TensorDict(
        {
            "observation": torch.zeros(4, 2),
            "next": {"observation": state, "reward": torch.full((4, 1), 9.0)},
        },
        [4],
    )
    near = relabel_goal(steps, np.array([0.0, 0.0]))
    assert near["next", "reward"].tolist() == [[1.0], [1.0], [0.0], [0.0]]
    assert near["next", "reward"].dtype == torch.float32
    far = relabel_goal(steps, torch.tensor([2.0, 2.2]))
    assert far["next", "reward"].flatten().tolist() == [0, 0, 0, 1]
    assert (steps["next", "reward"] == 9).all()
    assert near["observation"] is steps["observation"]


def test_relabel_with_another_radius_and_other_entries():
    state = torch.tensor([[9.0, 0.0, 0.0], [9.0, 0.6, 0.8], [0.0, 9.0, 9.0]])
    steps = TensorDict({"observation": state, "next": {"observation": state}}, [3])
    reward = GoalReward(radius=1.0, dims=[1, 2])
    assert relabel_goal(steps, [0.0, 0.0], reward)["next", "reward"].flatten().tolist() == [1, 1, 0]
    with pytest.raises(ValueError, match="a goal has 3 entries"):
        relabel_goal(steps, [0.0, 0.0, 0.0], reward)


def test_relabel_of_a_batch_of_episodes():
    steps = TensorDict({"next": {"observation": torch.zeros(2, 3, 4)}}, [2, 3])
    assert relabel_goal(steps, [0.0, 0.0])["next", "reward"].shape == (2, 3, 1)


def test_relabelled_rewards_are_those_of_the_environment():
    env = FixedGoalMaze(maze_task("umaze"), goal_cell=(1, 2))
    env.reset(seed=0)
    teleport(env, env.goal)
    rng, states, rewards = np.random.default_rng(0), [], []
    for t in range(200):
        action = np.array([1.0, 0.0]) * (1 if t // 40 % 2 else -1) + rng.normal(0, 0.3, 2)
        state, reward, *_ = env.step(np.clip(action, -1, 1).astype(np.float32))
        states.append(state)
        rewards.append(reward)
    assert 0 < sum(rewards) < 200
    steps = TensorDict({"next": {"observation": torch.tensor(np.stack(states))}}, [200])
    assert relabel_goal(steps, env.goal)["next", "reward"].flatten().tolist() == rewards


# as a TorchRL environment


def test_specs():
    env = make_maze_env(maze_task("umaze"), 2)
    check_env_specs(env)
    assert env.batch_size == (2,)
    td = env.reset()
    assert td["observation"].shape == (2, 4) and td["observation"].dtype == torch.float32
    assert td["is_init"].all()
    env.close()


def test_rows_depend_on_the_seed_alone():
    def starts(rows, seed):
        env = make_maze_env(maze_task("medium"), rows, seed)
        first, second = env.reset()["observation"], env.reset()["observation"]
        env.close()
        return torch.stack([first, second], 1)  # [rows, 2, 4]

    four = starts(4, 5)
    assert torch.equal(four, starts(4, 5))
    assert torch.equal(four[:2], starts(2, 5))
    assert not torch.equal(four, starts(4, 6))
    assert len(four.reshape(-1, 4).unique(dim=0)) == 8


def test_rollout_has_one_full_episode_a_row():
    task = maze_task("umaze")
    env = make_maze_env(task, 2, seed=1, goal_cell=(3, 1))
    torch.manual_seed(0)
    td = env.rollout(task.max_steps + 5, break_when_any_done=False, break_when_all_done=True)
    env.close()
    assert td.batch_size == (2, 300)
    assert td["next", "done"].sum().item() == 2 and td["next", "truncated"][:, -1].all()
    assert not td["next", "terminated"].any()
    assert torch.equal(td["observation"][:, 1:], td["next", "observation"][:, :-1])
    assert td["next", "reward"].shape == (2, 300, 1) and td["next", "reward"].dtype == torch.float32
    goal = torch.tensor([-1.0, -1.0])
    near = (td["next", "observation"][..., :2] - goal).norm(dim=-1, keepdim=True) <= 0.5
    assert torch.equal(td["next", "reward"], near.float())


def test_a_goal_for_each_row_is_shown():
    task = maze_task("medium")
    cells = [(1, 1), (6, 1), (3, 4)]
    env = make_maze_env(task, 3, seed=1, goal_cell=cells, show_goal=True)
    td = env.rollout(5)
    env.close()
    goals = torch.tensor([FixedGoalMaze(task, cell).goal.tolist() for cell in cells])
    assert td["goal"].shape == (3, 5, 2) and td["goal"].dtype == torch.float32
    assert torch.equal(td["goal"], goals[:, None].expand(3, 5, 2))
    assert torch.equal(td["next", "goal"], td["goal"])
    alone = make_maze_env(task, 3, seed=1, goal_cell=(1, 1))
    state = alone.reset()["observation"]
    alone.close()
    assert torch.equal(td["observation"][:, 0], state)


def test_a_start_for_each_row():
    task = maze_task("medium")
    cells = [(1, 1), (6, 6), (3, 4)]
    env = make_maze_env(task, 3, reset_cell=cells)
    places = env.reset()["observation"][:, :2]
    env.close()
    maze = FixedGoalMaze(task).maze
    centres = torch.tensor([maze.cell_rowcol_to_xy(torch.tensor(cell)).tolist() for cell in cells])
    assert (places - centres).abs().max() <= RESET_NOISE
    with pytest.raises(ValueError, match="there are 1 start cells for 3 rows; expected one a row"):
        make_maze_env(task, 3, reset_cell=[(1, 1)])


def test_as_many_goals_as_rows():
    with pytest.raises(ValueError, match="there are 2 goal cells for 3 rows; expected one a row"):
        make_maze_env(maze_task("umaze"), 3, goal_cell=[(1, 1), (1, 2)])
    with pytest.raises(ValueError, match="is a wall or outside the map"):
        make_maze_env(maze_task("umaze"), 2, goal_cell=[(1, 1), (9, 9)])


if __name__ == "__main__":
    pytest.main([__file__])
