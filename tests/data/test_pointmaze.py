"""The embedded default data."""

import json

import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import shortest_path

from torchrl_rad.data import pointmaze
from torchrl_rad.data.pointmaze import cache_dir, collect_pointmaze, next_cells, pointmaze_dataset
from torchrl_rad.envs import FixedGoalMaze, maze_task, relabel_goal

NAMES = ["umaze", "medium", "large"]


@pytest.fixture(scope="module")
def data():
    return collect_pointmaze(maze_task("umaze"), 3000, seed=1, progress=False)


# the way through the maze


@pytest.mark.parametrize("name", NAMES)
def test_next_cells_follow_shortest_paths(name):
    free = FixedGoalMaze(maze_task(name)).free_cells
    table = next_cells(free)
    touching = np.abs(free[:, None] - free).sum(-1) == 1
    distance = shortest_path(touching.astype(float), unweighted=True)
    assert np.isfinite(distance).all()  # every maze is connected
    for i in range(len(free)):
        assert table[i, i] == i
        for j in range(len(free)):
            if i != j:
                assert touching[i, table[i, j]]
                assert distance[table[i, j], j] == distance[i, j] - 1


def test_next_cells_around_a_wall():
    # (0,0) (0,1)
    # (1,0)   #    (1,2)
    table = next_cells(np.array([[0, 0], [0, 1], [1, 0], [1, 2]]))
    assert table[1, 2] == 0 and table[2, 1] == 0
    assert table[3].tolist() == [-1, -1, -1, 3] and table[0, 3] == -1


# the recording


def test_layout(data):
    assert data.batch_size == (3000,)
    assert set(data.keys(True, True)) == {
        "observation",
        "action",
        "episode",
        ("next", "observation"),
        ("next", "reward"),
        ("next", "terminated"),
        ("next", "truncated"),
        ("next", "done"),
    }
    assert data["observation"].shape == (3000, 4) and data["observation"].dtype == torch.float32
    assert data["action"].shape == (3000, 2) and data["action"].dtype == torch.float32
    assert data["episode"].shape == (3000,) and data["episode"].dtype == torch.int64
    assert data["next", "reward"].shape == (3000, 1)
    assert data["next", "reward"].dtype == torch.float32


def test_episodes_have_the_length_of_the_protocol(data):
    assert data["episode"].tolist() == [i // 300 for i in range(3000)]
    ends = torch.arange(3000).remainder(300) == 299
    for key in ("done", "truncated"):
        assert torch.equal(data["next", key].flatten(), ends)
    assert not data["next", "terminated"].any()


def test_steps_are_rounded_up_to_whole_episodes():
    data = collect_pointmaze(maze_task("medium"), 601, progress=False)
    assert data.batch_size == (1200,) and data["episode"].unique().tolist() == [0, 1]


def test_next_observations_chain(data):
    same = (data["next", "observation"][:-1] == data["observation"][1:]).all(-1)
    inside = data["episode"][:-1] == data["episode"][1:]
    assert same[inside].all() and not same[~inside].any()


def test_rewards_by_their_definition(data):
    # the centre of UMaze's cell (1, 1) is (-1, 1)
    position = data["next", "observation"][:, :2].double().numpy()
    distance = np.hypot(position[:, 0] + 1.0, position[:, 1] - 1.0)
    clear = np.abs(distance - 0.5) > 1e-6
    reward = data["next", "reward"][:, 0].numpy()
    assert np.array_equal(reward[clear], (distance <= 0.5)[clear].astype(np.float32))
    assert 0 < reward.sum() < 3000
    again = relabel_goal(data, np.array([-1.0, 1.0]))
    assert torch.equal(again["next", "reward"], data["next", "reward"])


def test_the_environment_gives_the_same_steps(data):
    # each recorded action, done again from the recorded state, leads to the recorded next state
    env = FixedGoalMaze(maze_task("umaze"))
    env.reset(seed=0)
    for row in range(0, 3000, 61):
        state = data["observation"][row].double().numpy()
        env.unwrapped.point_env.set_state(state[:2], state[2:])
        following, reward, *_ = env.step(data["action"][row].numpy())
        np.testing.assert_allclose(following, data["next", "observation"][row], atol=1e-5)
        assert reward == data["next", "reward"][row].item()


def test_actions_are_bounded_and_noisy(data):
    action = data["action"]
    assert action.min() == -1 and action.max() == 1
    assert (action.abs() < 1).float().mean() > 0.2
    assert (action[1:] == action[:-1]).all(-1).float().mean() < 0.3


def test_goals_are_met_all_over_the_maze(data):
    env = FixedGoalMaze(maze_task("umaze"))
    cells = [env.maze.cell_xy_to_rowcol(p) for p in data["observation"][:, :2].double().numpy()]
    visited = np.unique(np.stack(cells), axis=0)
    assert visited.tolist() == env.free_cells.tolist()


def test_seeded_and_in_order(data):
    task = maze_task("umaze")
    again = collect_pointmaze(task, 600, seed=1, progress=False)
    assert (again == data[:600]).all()
    other = collect_pointmaze(task, 300, seed=2, progress=False)
    assert not torch.equal(other["observation"], data["observation"][:300])
    assert not torch.equal(data["observation"][0], data["observation"][300])


@pytest.mark.parametrize("steps", [0, -5])
def test_steps_below_one(steps):
    with pytest.raises(ValueError, match=f"steps is {steps}; at least one step"):
        collect_pointmaze(maze_task("umaze"), steps, progress=False)


def test_progress_bar(capsys):
    collect_pointmaze(maze_task("umaze"), 600)
    assert "collecting PointMaze_UMaze-v3: 100%" in capsys.readouterr().err
    collect_pointmaze(maze_task("umaze"), 600, progress=False)
    assert capsys.readouterr().err == ""


# the cache


def refuse(*args, **kwargs):
    raise AssertionError("collected although it is cached")


def test_cached_under_its_settings(tmp_path, monkeypatch):
    first = pointmaze_dataset("umaze", 500, seed=4, root=tmp_path, progress=False)
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("pointmaze-umaze-500-seed4-")
    settings = json.loads((folder / "settings.json").read_text())
    assert settings["steps"] == 500 and settings["seed"] == 4 and settings["maze"] == "umaze"
    expected = collect_pointmaze(maze_task("umaze"), 500, seed=4, progress=False)
    assert (first == expected).all()
    monkeypatch.setattr(pointmaze, "_record", refuse)
    assert (pointmaze_dataset("umaze", 500, seed=4, root=tmp_path, progress=False) == first).all()
    for maze, steps, seed in (("umaze", 501, 4), ("umaze", 500, 5), ("medium", 500, 4)):
        with pytest.raises(AssertionError, match="although it is cached"):
            pointmaze_dataset(maze, steps, seed=seed, root=tmp_path, progress=False)


def test_other_physics_have_another_name(tmp_path, monkeypatch):
    pointmaze_dataset("umaze", 300, root=tmp_path, progress=False)
    monkeypatch.setattr(pointmaze, "ACTION_NOISE", 0.1)
    pointmaze_dataset("umaze", 300, root=tmp_path, progress=False)
    assert len(list(tmp_path.iterdir())) == 2


def test_cache_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_RAD_CACHE", str(tmp_path / "there"))
    assert cache_dir() == tmp_path / "there"
    pointmaze_dataset("umaze", 300, progress=False)
    assert len(list((tmp_path / "there").iterdir())) == 1
    monkeypatch.delenv("TORCHRL_RAD_CACHE")
    assert cache_dir().parts[-2:] == (".cache", "torchrl_rad")


def test_interrupted_collection_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(pointmaze, "PART", 2)
    record, calls = pointmaze._record, []

    def interrupted(*args):
        if len(calls) == 5:
            raise KeyboardInterrupt
        calls.append(args)
        record(*args)

    monkeypatch.setattr(pointmaze, "_record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pointmaze_dataset("umaze", 2100, root=tmp_path, progress=False)
    (parts,) = tmp_path.iterdir()  # no data set of this name yet
    assert parts.name.endswith(".parts") and len(list(parts.iterdir())) == 2
    (parts / "2-4.npz").write_bytes((parts / "2-4.npz").read_bytes()[:5000])  # cut by a crash

    calls.clear()
    monkeypatch.setattr(pointmaze, "_record", lambda *args: (calls.append(args), record(*args)))
    data = pointmaze_dataset("umaze", 2100, root=tmp_path, progress=False)
    assert len(calls) == 5  # episodes 2 to 6; 0 and 1 were kept
    assert (data == collect_pointmaze(maze_task("umaze"), 2100, progress=False)).all()
    assert [p.name for p in tmp_path.iterdir() if p.name.endswith(".parts")] == []


def test_killed_while_saving(tmp_path, monkeypatch):
    def killed(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pointmaze, "write_json", killed)
        with pytest.raises(KeyboardInterrupt):
            pointmaze_dataset("umaze", 300, root=tmp_path, progress=False)
    assert all(p.name.endswith(".parts") for p in tmp_path.iterdir())
    assert len(pointmaze_dataset("umaze", 300, root=tmp_path, progress=False)) == 300


@pytest.mark.parametrize("damage", ["cut", "missing"])
def test_damaged_cache_is_collected_anew(tmp_path, damage):
    whole = pointmaze_dataset("umaze", 300, root=tmp_path, progress=False).clone()
    (file,) = tmp_path.glob("*/steps/action.memmap")
    content = file.read_bytes()
    file.unlink()
    if damage == "cut":
        file.write_bytes(content[:100])
    with pytest.warns(UserWarning, match=r"action.memmap is .*collected anew"):
        again = pointmaze_dataset("umaze", 300, root=tmp_path, progress=False)
    assert (again == whole).all()


def test_unknown_maze():
    with pytest.raises(KeyError, match="unknown maze 'tiny'"):
        pointmaze_dataset("tiny", 300)


if __name__ == "__main__":
    pytest.main([__file__])
