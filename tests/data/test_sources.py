"""Every family of data through the one loader, in small files of the public layouts."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_rad import GoalReward, relabel_goal
from torchrl_rad.data import (
    KITCHEN_TASKS,
    concatenate_steps,
    data_report,
    episode_length,
    episode_lengths,
    first_hit_within,
    load_dataset,
    load_minari,
    newly_done,
    relabel_tasks,
    return_at_least,
    subtasks_done,
)

from .kitchen_states import goal_dict, kitchen_states

h5py = pytest.importorskip("h5py")
minari = pytest.importorskip("minari")
GOAL = np.array([10.0, -10.0])  # of the evaluation, AntMaze medium


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    return tmp_path


def write_hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        for key, value in arrays.items():
            file.create_dataset(key, data=value, compression="gzip")
    return path


def box(width):
    return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float64)


def write_minari(name, episodes, space, actions):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            name,
            [minari.data_collector.EpisodeBuffer(**episode) for episode in episodes],
            observation_space=gymnasium.spaces.Dict(space),
            action_space=gymnasium.spaces.Box(-1, 1, (actions,), np.float32),
        )
    return name


def ends_at(lengths):
    end = np.zeros(sum(lengths), bool)
    end[np.cumsum(lengths) - 1] = True
    return end


def kept(rule, td):
    return rule.select(td.split(episode_lengths(td).tolist())).tolist()


# locomotion


def hopper(path, lengths, seed=0):
    rng, count = np.random.default_rng(seed), sum(lengths)
    over = np.repeat(np.array(lengths) == 1000, lengths)
    return write_hdf5(
        path,
        **{
            "observations": rng.normal(size=(count, 11)).astype(np.float32),
            "actions": rng.uniform(-1, 1, (count, 3)).astype(np.float32),
            "rewards": rng.uniform(0, 3, count).astype(np.float32),
            "terminals": ends_at(lengths) & ~over,
            "timeouts": ends_at(lengths) & over,
            "infos/qpos": rng.normal(size=(count, 6)).astype(np.float32),
            "infos/qvel": rng.normal(size=(count, 6)).astype(np.float32),
        },
    )


def test_locomotion(root):
    medium = hopper(root / "hopper_medium-v2.hdf5", [30, 1000, 7])
    expert = hopper(root / "hopper_expert-v2.h5", [1000, 12], seed=1)
    one = load_dataset(str(medium))
    assert kept(episode_length(1000), one) == [False, True, False]
    both = load_dataset([medium, expert], infos=("qpos", "qvel"))
    assert data_report(both).ok
    assert episode_lengths(both).tolist() == [30, 1000, 7, 1000, 12]
    assert both["episode"].unique().tolist() == [0, 1, 2, 3, 4]
    assert kept(episode_length(1000), both) == [False, True, False, True, False]
    assert both["info", "qpos"].shape == (2049, 6)
    assert torch.equal(both[: len(one)]["next", "reward"], one["next", "reward"])


# antmaze


def ant_walk(lengths, seed=0):
    """Episodes [L + 1, 29] that pass the goal of the evaluation and go on there for a while."""
    rng, walks = np.random.default_rng(seed), []
    for length in lengths:
        body = rng.normal(size=(length + 1, 29))
        way = np.clip(np.linspace(0, 1.4, length + 1), 0, 1)[:, None]
        body[:, :2] = way * GOAL + rng.uniform(-0.1, 0.1, (length + 1, 2))
        walks.append(body)
    return walks


def antmaze_hdf5(path, walks, actions):
    now = np.concatenate([walk[:-1] for walk in walks])
    following = np.concatenate([walk[1:] for walk in walks])
    hit = np.linalg.norm(following[:, :2] - GOAL, axis=-1) <= 0.5
    return write_hdf5(
        path,
        **{
            "observations": now.astype(np.float32),
            "actions": np.concatenate(actions).astype(np.float32),
            "rewards": hit.astype(np.float32),
            "terminals": hit,
            "timeouts": ends_at([len(a) for a in actions]),
            "infos/goal": np.ones((len(now), 2), np.float32),
            "infos/qpos": now[:, :15].astype(np.float32),
            "infos/qvel": now[:, 15:].astype(np.float32),
        },
    )


def antmaze_minari(name, walks, actions):
    episodes = []
    for walk, action in zip(walks, actions, strict=True):
        rows = len(walk)
        goal = np.tile([1.0, 1.0], (rows, 1))  # of the recording
        episodes.append(
            {
                "observations": {
                    "observation": walk[:, 2:],
                    "achieved_goal": walk[:, :2],
                    "desired_goal": goal,
                },
                "actions": action.astype(np.float32),
                "rewards": [0.0] * (rows - 1),
                "terminations": [False] * (rows - 1),
                "truncations": [False] * (rows - 2) + [True],
                "infos": {"success": [False] * rows, "qpos": walk[:, :15], "qvel": walk[:, 15:]},
            }
        )
    space = {"observation": box(27), "achieved_goal": box(2), "desired_goal": box(2)}
    return write_minari(name, episodes, space, 8)


def test_antmaze_from_both_layouts(root):
    rng, lengths = np.random.default_rng(0), [60, 50, 40]
    walks = ant_walk(lengths)
    actions = [rng.uniform(-1, 1, (length, 8)) for length in lengths]
    name = antmaze_minari("D4RL/antmaze/medium-play-v1", walks, actions)
    options = {"infos": ("qpos", "qvel"), "progress": False}
    from_hub = load_dataset(name, ("achieved_goal", "observation"), **options)
    path = antmaze_hdf5(root / "antmaze-medium-play-v2.hdf5", walks, actions)
    from_file = load_dataset(path, **options)
    for td in (from_hub, from_file):
        assert data_report(td).ok
        assert episode_lengths(td).tolist() == lengths
        assert not td["next", "terminated"].any()
    for key in ("observation", "action", "episode", ("info", "qpos"), ("info", "qvel")):
        assert torch.equal(from_hub[key], from_file[key]), key
    recorded = from_file["next", "reward"]
    assert not from_hub["next", "reward"].any()
    labelled = relabel_goal(from_hub, GOAL)
    assert torch.equal(labelled["next", "reward"], recorded)
    assert torch.equal(relabel_goal(from_file, GOAL)["next", "reward"], recorded)
    wider = relabel_goal(from_hub, GOAL, GoalReward(radius=1.5))["next", "reward"]
    assert wider.sum() > recorded.sum() and (wider >= recorded).all()
    first = [int(r.flatten().argmax()) + 1 for r in recorded.split(lengths)]
    rule = first_hit_within(first[1], first[0])
    assert first[2] < first[1] and kept(rule, labelled) == [True, True, False]


# kitchen


def kitchen_episodes():
    """In-place flags [L + 1, 4] of three episodes: 3 done one by one, 2 done, 4 with undoing."""
    one = np.zeros((9, 4), bool)
    one[2, 0] = one[5, 1] = one[7:, 2] = True  # never more than one at once
    two = np.zeros((6, 4), bool)
    two[3:, :2] = True
    four = np.zeros((8, 4), bool)
    four[2:5, 0] = four[3:, 1] = four[4:, 2] = four[6, 3] = True
    return [one, two, four]


def test_kitchen_from_both_layouts(root):
    tasks = KITCHEN_TASKS["partial"]
    flags = kitchen_episodes()
    rng = np.random.default_rng(0)
    episodes = []
    for i, in_place in enumerate(flags):
        steps = len(in_place) - 1
        episodes.append(
            {
                "observations": goal_dict(kitchen_states(in_place, tasks, seed=i), tasks),
                "actions": rng.uniform(-1, 1, (steps, 9)).astype(np.float32),
                "rewards": in_place[1:].sum(-1).astype(float).tolist(),
                "terminations": [False] * steps,
                "truncations": [False] * (steps - 1) + [True],
                "infos": {"ctrl": np.ones((steps + 1, 9))},
            }
        )
    first = episodes[0]["observations"]
    goals = {task: box(first["achieved_goal"][task].shape[1]) for task in tasks}
    space = {
        "observation": box(59),
        "achieved_goal": gymnasium.spaces.Dict(goals),
        "desired_goal": gymnasium.spaces.Dict(goals),
    }
    name = write_minari("D4RL/kitchen/partial-v2", episodes, space, 9)
    recorded = load_dataset(name, progress=False)
    assert data_report(recorded).ok and recorded["observation"].shape == (20, 59)
    from_goals = load_minari(name, progress=False, reward=newly_done)
    from_states = relabel_tasks(recorded, tasks)
    states = np.concatenate(
        [kitchen_states(in_place, tasks, 60, seed=i) for i, in_place in enumerate(flags)]
    )
    count = len(states)
    path = write_hdf5(
        root / "mini_kitchen_microwave_kettle_light_slider-v0.hdf5",
        observations=states.astype(np.float32),
        actions=rng.uniform(-1, 1, (count, 9)).astype(np.float32),
        rewards=np.concatenate(flags).sum(-1).astype(np.float32),
        terminals=ends_at([len(in_place) for in_place in flags]),
    )
    from_file = relabel_tasks(load_dataset(path), tasks)
    assert data_report(from_file).ok
    for td in (from_goals, from_states, from_file):
        returns = [e["next", "reward"].sum().item() for e in td.split(episode_lengths(td).tolist())]
        assert returns == [3, 2, 4]
        assert kept(return_at_least(3), td) == [True, False, True]
    assert torch.equal(from_goals["next", "reward"], from_states["next", "reward"])
    # counted at once, a task that comes undone is missed
    assert kept(subtasks_done(3), recorded) == [False, False, True]


# ogbench


def test_ogbench(root):
    rng, paths = np.random.default_rng(0), []
    for name, trajectories in (("", 3), ("-val", 1)):
        count = 201 * trajectories
        paths.append(root / f"antmaze-medium-stitch-v0{name}.npz")
        qpos, qvel = rng.normal(size=(count, 15)), rng.normal(size=(count, 14))
        np.savez_compressed(
            paths[-1],
            observations=np.concatenate([qpos, qvel], -1).astype(np.float32),
            actions=rng.uniform(-1, 1, (count, 8)).astype(np.float32),
            terminals=ends_at([201] * trajectories),
            qpos=qpos.astype(np.float32),
            qvel=qvel.astype(np.float32),
        )
    td = load_dataset(paths, infos=("qpos", "qvel"))
    assert data_report(td).ok
    assert episode_lengths(td).tolist() == [200] * 4
    assert torch.equal(td["info", "qpos"], td["observation"][:, :15])
    assert relabel_goal(td, td["next", "observation"][7, :2])["next", "reward"][7] == 1


# several sources


def table(ids, width=2, **infos):
    rows = torch.arange(1.0, len(ids) + 1)[:, None]
    columns = {"observation": rows.expand(-1, width), "episode": torch.tensor(ids)}
    return TensorDict({**columns, **infos}, [len(ids)])


def test_ids_are_unique_and_the_tables_untouched():
    first, second = table([4, 4, 9]), table([0, 3])
    joined = concatenate_steps([first, second, first])
    assert joined["episode"].tolist() == [4, 4, 9, 10, 13, 14, 14, 19]
    assert second["episode"].tolist() == [0, 3]
    assert joined["observation"][:, 0].tolist() == [1, 2, 3, 1, 2, 1, 2, 3]


def test_one_table():
    assert concatenate_steps([table([2, 2])])["episode"].tolist() == [2, 2]


def test_tables_that_do_not_fit():
    with pytest.raises(ValueError, match="there is nothing to join"):
        load_dataset([])
    with pytest.raises(ValueError, match=r"b cannot be joined to a: 'observation' is .*\[T, 3\]"):
        concatenate_steps([table([0]), table([0], 3)], ["a", "b"])
    with pytest.raises(ValueError, match="'extra' is torch.float32 .* there and missing here"):
        concatenate_steps([table([0]), table([0], extra=torch.ones(1))])
    with pytest.raises(ValueError, match="table 1 has no steps"):
        concatenate_steps([table([0]), table([0])[:0]])


def test_widths_are_named_by_source(root):
    hopper(root / "hopper.hdf5", [5])
    write_hdf5(
        root / "walker.hdf5",
        observations=np.ones((5, 17)),
        actions=np.ones((5, 6)),
        rewards=np.ones(5),
        terminals=ends_at([5]),
    )
    with pytest.raises(ValueError, match="walker.hdf5 cannot be joined to .*hopper.hdf5"):
        load_dataset([root / "hopper.hdf5", root / "walker.hdf5"])


def test_neither_a_file_nor_an_id():
    with pytest.raises(FileNotFoundError, match="'hopper.h6' is not here"):
        load_dataset("hopper.h6", progress=False)
    with pytest.raises(FileNotFoundError, match="there is no file hopper.h5"):
        load_dataset("hopper.h5")
    with pytest.raises(FileNotFoundError, match="there is no file hopper.npz"):
        load_dataset("hopper.npz")
