"""The data of a maze from the library's own collection and from Minari."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_rad import maze_task
from torchrl_rad.data.maze2d import maze_dataset

minari = pytest.importorskip("minari")
TASK = maze_task("umaze")  # 300 steps, the goal at (-1, 1)
NAME = "D4RL/pointmaze/umaze-v2"
DESCRIPTION = dict.fromkeys(
    ["algorithm_name", "author", "author_email", "code_permalink", "description"], "-"
)


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("TORCHRL_RAD_CACHE", str(tmp_path / "cache"))
    (tmp_path / "minari").mkdir()
    return tmp_path


def box(width, dtype=np.float64):
    return gymnasium.spaces.Box(-np.inf, np.inf, (width,), dtype)


def stream(lengths, seed, width=4, actions=2, centre=(0.0, 0.0)):
    """Episodes cut out of one stream at each goal, as D4RL/pointmaze/*-v2 were recorded."""
    rng = np.random.default_rng(seed)
    states = rng.uniform(-1.5, 1.5, (sum(lengths) + 1, width))
    states[:, :2] += centre
    episodes, first = [], 0
    for length in lengths:
        state = states[first : first + length + 1]
        last = np.arange(length) == length - 1
        goal = np.tile(rng.normal(size=2), (length + 1, 1))
        parts = {"observation": state, "achieved_goal": state[:, :2], "desired_goal": goal}
        episodes.append(
            minari.data_collector.EpisodeBuffer(
                observations=parts,
                actions=rng.uniform(-1, 1, (length, actions)).astype(np.float32),
                rewards=list(last.astype(float)),  # of the goals of the recording
                terminations=[False] * length,
                truncations=last.tolist(),
            )
        )
        first += length
    return episodes, states


def write(episodes, name=NAME, width=4, actions=2):
    space = {"achieved_goal": box(2), "desired_goal": box(2), "observation": box(width)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            name,
            episodes,
            observation_space=gymnasium.spaces.Dict(space),
            action_space=gymnasium.spaces.Box(-1, 1, (actions,), np.float32),
            **DESCRIPTION,
        )


def load(name=NAME, task=TASK, **options):
    return maze_dataset(task, name, download=False, progress=False, **options)


def test_minari_set_is_joined_cut_and_relabelled():
    first, states = stream([250, 100, 300], seed=0)
    second, others = stream([40], seed=1)
    write(first + second)
    data = load()
    # one stream of 650 steps and one of 40, cut at 300
    assert torch.bincount(data["episode"]).tolist() == [300, 300, 50, 40]
    ends = data["next", "done"].squeeze(-1).nonzero().squeeze(-1).tolist()
    assert ends == [299, 599, 649, 689]
    assert not data["next", "terminated"].any()
    states, others = np.float32(states), np.float32(others)
    np.testing.assert_array_equal(data["observation"], np.concatenate([states[:-1], others[:-1]]))
    following = np.concatenate([states[1:], others[1:]])
    np.testing.assert_array_equal(data["next", "observation"], following)
    actions = np.concatenate([episode.actions for episode in first + second])
    np.testing.assert_array_equal(data["action"], actions)
    # 1 where the step ends within 0.5 of (-1, 1)
    reward = np.hypot(following[:, 0] + 1, following[:, 1] - 1) <= 0.5
    assert 20 < reward.sum() < 100
    np.testing.assert_array_equal(data["next", "reward"].squeeze(-1), reward)


@pytest.mark.parametrize(
    "maze, steps, goal", [("medium", 600, (2.5, -2.5)), ("large", 800, (3.5, -3.0))]
)
def test_limit_and_goal_of_the_other_mazes(maze, steps, goal):
    episodes, _ = stream([500, 500], seed=0, centre=goal)
    write(episodes, f"D4RL/pointmaze/{maze}-v2")
    data = load(f"D4RL/pointmaze/{maze}-v2", maze_task(maze))
    assert torch.bincount(data["episode"]).tolist() == [steps, 1000 - steps]
    following = data["next", "observation"].numpy()
    paid = np.hypot(*(following[:, :2] - np.float32(goal)).T) <= 0.5
    assert 20 < paid.sum() < 300
    np.testing.assert_array_equal(data["next", "reward"].squeeze(-1), paid)


@pytest.mark.parametrize("width, actions", [(6, 2), (4, 3), (27, 8)])
def test_other_environment(width, actions):
    episodes, _ = stream([5], seed=0, width=width, actions=actions)
    write(episodes, "D4RL/antmaze/umaze-v1", width, actions)
    with pytest.raises(ValueError) as caught:
        load("D4RL/antmaze/umaze-v1")
    assert (
        f"'D4RL/antmaze/umaze-v1' has states and actions of widths ({width}, {actions}); "
        "PointMaze_UMaze-v3 has (4, 2). Name a data set of this maze"
    ) in str(caught.value)


def test_not_here():
    write(stream([5], seed=0)[0])
    with pytest.raises(FileNotFoundError) as caught:
        load("D4RL/pointmaze/large-v2")
    assert "Minari data set 'D4RL/pointmaze/large-v2' is not here" in str(caught.value)
    assert f"local data sets: [{NAME!r}]" in str(caught.value)
    assert "downloading is off" in str(caught.value)


def test_not_here_and_no_network(monkeypatch):
    original = minari.load_dataset

    def offline(name, download=False):
        if download:
            raise ConnectionError("no route to host")
        return original(name)

    monkeypatch.setattr(minari, "load_dataset", offline)
    with pytest.raises(FileNotFoundError) as caught:
        maze_dataset(TASK, NAME, progress=False)
    assert "downloading it failed (ConnectionError: no route to host)" in str(caught.value)
    assert "MINARI_DATASETS_PATH" in str(caught.value)


def test_collected(root):
    data = maze_dataset(TASK, steps=600, seed=3, progress=False)
    assert data.shape == torch.Size([600])
    position = data["next", "observation"][:, :2]
    paid = (position - torch.tensor([-1.0, 1.0])).norm(dim=-1) <= 0.5
    assert torch.equal(data["next", "reward"].squeeze(-1), paid.float())
    again = maze_dataset(TASK, steps=600, seed=3, progress=False)
    assert (again == data).all()
    assert not torch.equal(
        maze_dataset(TASK, steps=600, seed=4, progress=False)["observation"], data["observation"]
    )
    # both kept, under names that hold the settings
    names = [path.name for path in (root / "cache").iterdir()]
    assert len(names) == 2 and all(name.startswith("pointmaze-umaze-600-seed") for name in names)


def test_both_sources_have_one_form():
    write(stream([5, 5], seed=0)[0])
    collected, public = maze_dataset(TASK, steps=300, progress=False), load()
    for key in set(collected.keys(True, True)) | set(public.keys(True, True)):
        assert collected[key].dtype == public[key].dtype, key
        assert collected[key].shape[1:] == public[key].shape[1:], key


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
