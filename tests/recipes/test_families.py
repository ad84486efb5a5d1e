"""Both recipes on every other family, from small files in the layouts of the public sets."""

from __future__ import annotations

import math
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest

from torchrl_rad.data import KITCHEN_TASKS
from torchrl_rad.evaluation import measure_latency
from torchrl_rad.runs import RunFolder

from ..data.kitchen_states import goal_dict, kitchen_states
from .running import call

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")

COUNT, LENGTH = 6, 20  # episodes, and steps of each
GENERAL = (
    "threads=1",
    "optim.gradient_steps=2",
    "replay_buffer.batch_size=4",
    "replay_buffer.download=false",
    "logger.progress=false",
    "logger.log_interval=1",
    "evaluation.episodes=2",
    "++env.max_steps=6",
    # random states are far from those of the simulator
    *(f"retrieval.{name}.sampler.threshold=0.0" for name in ("paper", "followed")),
)
RECIPES = {
    "dl_rad.py": (
        *("network.horizon=9", "network.jumps=[4,1]", "network.temperature=[1.0,0.0]"),
        *("network.width=16", "network.heads=2", "network.blocks=1", "network.steps=1"),
        *("network.step_horizon=5", "network.step_width=16"),
        "retrieval.followed.target={rule: followed, ahead: 4}",
    ),
    "d_rad.py": (
        *("diffuser.horizon=8", "diffuser.multiples=[1,2]", "diffuser.width=8"),
        *("diffuser.steps=2", "diffuser.guide_stop=1", "diffuser.guide_steps=1"),
        "diffuser.return_model.width=8",
        *("diffuser.step_horizon=5", "diffuser.step_width=16"),
        "retrieval.followed.target={rule: followed, ahead: 4}",
    ),
}
# task, its own settings, and the figures that it reports beside the score: name and heading
FAMILIES = {
    "hopper": (
        "hopper-medium-replay",
        [
            f"retrieval.{name}.expert={{rule: episode_length, args: [{LENGTH}]}}"
            for name in ("paper", "highest")
        ]
        + ["retrieval.followed.network.condition=[0.95,0.2]"],  # of the two levels here
        {"length": "steps"},
    ),
    "antmaze": (
        "antmaze-medium-play",
        [f"retrieval.paper.expert={{rule: first_hit_within, args: [1, {LENGTH}]}}"],
        {"success": "success", "arrival": "steps to goal"},
    ),
    "kitchen": ("kitchen-partial", [], {"return": "return", "length": "steps"}),
    "ogbench": (
        "ogbench-antmaze-medium-stitch",
        [
            f"retrieval.{name}.target.goal_reward.radius=50"  # hardly any walks to the goal
            for name in ("paper", "followed")
        ],
        {"success": "success", "arrival": "steps to goal"},
    ),
}


def arrays(width, moves, lengths, seed=0):
    """Observations and actions of these widths, and the last row of each episode."""
    rng, count = np.random.default_rng(seed), sum(lengths)
    last = np.zeros(count, bool)
    last[np.cumsum(lengths) - 1] = True
    states = rng.normal(size=(count, width)).astype(np.float32)
    return states, rng.uniform(-1, 1, (count, moves)).astype(np.float32), last


def write_hdf5(path, **entries):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for key, value in entries.items():
            file[key] = value


def hopper(folder, width=11, moves=3):
    """hopper_medium_replay-v2: every other episode falls before its time."""
    states, actions, last = arrays(width, moves, [LENGTH, LENGTH - 6] * (COUNT // 2))
    falls = np.flatnonzero(last)[1::2]
    terminals = np.zeros(len(last), bool)
    terminals[falls] = True
    rng = np.random.default_rng(1)
    write_hdf5(
        folder / "hopper_medium_replay-v2.hdf5",
        observations=states,
        actions=actions,
        rewards=rng.uniform(1, 3, len(last)).astype(np.float32),
        terminals=terminals,
        timeouts=last & ~terminals,
        **{"infos/qpos": rng.normal(size=(len(last), 6)).astype(np.float32)},
        **{"infos/qvel": rng.normal(size=(len(last), 6)).astype(np.float32)},
        **{"infos/action_log_probs": -np.ones(len(last), np.float32)},
        **{"metadata/algorithm": "SAC"},
    )


def antmaze(folder, width=29, moves=8):
    """antmaze-medium-play: rows at the goal are marked, the walk goes on."""
    states, actions, last = arrays(width, moves, [LENGTH] * COUNT)
    goal = np.array([10.0, -10.0], np.float32)  # of cell (6, 6)
    share = np.tile(np.linspace(0, 1.2, LENGTH), COUNT).clip(max=1.0)[:, None]
    states[:, :2] = goal * share + 0.01 * states[:, :2]
    hit = np.linalg.norm(states[:, :2] - goal, axis=-1) <= 0.5
    hit = np.append(hit[1:], False) & ~last
    write_hdf5(
        folder / "antmaze-medium-play.hdf5",
        observations=states,
        actions=actions,
        rewards=hit.astype(np.float32),
        terminals=hit,
        timeouts=last,
        **{"infos/goal": np.tile(goal, (len(last), 1))},
        **{"infos/qpos": states[:, :15], "infos/qvel": states[:, -14:]},
    )


def kitchen(folder, width=59, moves=9):
    """D4RL/kitchen/partial-v2: a Minari set of FrankaKitchen, whose rewards count at every step."""
    minari = pytest.importorskip("minari")
    tasks, box = KITCHEN_TASKS["partial"], gymnasium.spaces.Box
    episodes = []
    for number in range(COUNT):
        # one more thing in place every four steps: two, three or four of them
        done = np.arange(LENGTH + 1)[:, None] >= 4 * np.arange(1, 5)
        done[:, 2 + number % 3 :] = False
        states = kitchen_states(done, tasks, width, seed=number)
        goals = goal_dict(states, tasks)
        _, actions, last = arrays(width, moves, [LENGTH], seed=number)
        episodes.append(
            minari.data_collector.EpisodeBuffer(
                observations=goals,
                actions=actions.astype(np.float64),
                rewards=list(done[1:].sum(-1).astype(float)),
                terminations=[False] * LENGTH,
                truncations=last.tolist(),
                infos={"ctrl": np.zeros((LENGTH + 1, 9))},
            )
        )
    wanted = {
        task: box(-np.inf, np.inf, value.shape[1:]) for task, value in goals["desired_goal"].items()
    }
    space = {
        "observation": box(-np.inf, np.inf, (width,)),
        "achieved_goal": gymnasium.spaces.Dict(wanted),
        "desired_goal": gymnasium.spaces.Dict(wanted),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            "D4RL/kitchen/partial-v2",
            episodes,
            observation_space=gymnasium.spaces.Dict(space),
            action_space=box(-1.0, 1.0, (moves,), np.float64),
        )


def ogbench(folder, width=29, moves=8):
    """antmaze-medium-stitch-v0: no rewards, one row more than steps in each trajectory."""
    pytest.importorskip("ogbench")
    states, actions, last = arrays(width, moves, [LENGTH + 1] * COUNT)
    states[:, :2] *= 10
    np.savez_compressed(
        folder / "antmaze-medium-stitch-v0.npz",
        observations=states,
        actions=actions,
        terminals=last,
        qpos=states[:, :15],
        qvel=states[:, -14:],
    )


MAKERS = {"hopper": hopper, "antmaze": antmaze, "kitchen": kitchen, "ogbench": ogbench}


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Latencies from a few calls: they would take most of the time."""
    few = partial(measure_latency, calls=2)
    monkeypatch.setattr("torchrl_rad.experiment.scoring.measure_latency", few)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where data sets are looked for: here and nowhere else."""
    monkeypatch.setenv("TORCHRL_RAD_DATA", str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    return tmp_path


def run(recipe, family, folder, *changes):
    """A recipe on a family's data set: its exit code, what it prints, what it says of errors."""
    task, options, _ = FAMILIES[family]
    settings = (f"task={task}", *GENERAL, *RECIPES[recipe], *options)
    return call(recipe, *settings, f"folder={folder / 'run'}", *changes)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("family", FAMILIES)
def test_a_run(family, recipe, folder):
    MAKERS[family](folder)
    code, text, err = run(recipe, family, folder)
    assert code == 0, err
    results = RunFolder.open(folder / "run").results()
    task, _, figures = FAMILIES[family]
    assert results["task"] == task
    names = ["backbone", "paper", "followed"]
    assert sorted(results["rows"]) == sorted(names + ["highest"] * (family == "hopper"))
    for row in results["rows"].values():
        assert figures.keys() <= row.keys()
        assert math.isfinite(row["return"]) and math.isfinite(row["score"])
        assert len(row["episode_scores"]) == 2 and np.isfinite(row["episode_scores"]).all()
        for name in figures.keys() - {"arrival"}:  # there is none where no episode arrives
            assert math.isfinite(row[name])
    assert results["rows"]["followed"]["found"] > 0  # there was a target to plan for
    (head,) = (line for line in text.splitlines() if line.startswith("| policy |"))
    assert set(figures.values()) <= {cell.strip() for cell in head.split("|")}


@pytest.mark.parametrize(
    ("recipe", "family", "came", "expected"),
    [
        ("dl_rad.py", "hopper", (17, 6), (11, 3)),  # walker2d's
        ("d_rad.py", "antmaze", (107, 8), (29, 8)),  # of AntMaze-v5
        ("dl_rad.py", "kitchen", (60, 9), (59, 9)),  # of D4RL's own kitchen
        ("d_rad.py", "ogbench", (4, 2), (29, 8)),  # a point's
    ],
)
def test_data_of_another_environment(recipe, family, came, expected, folder):
    MAKERS[family](folder, *came)
    code, _, err = run(recipe, family, folder)
    error = err.splitlines()[-1]
    assert code == 1 and error.startswith("error: ") and "Traceback" not in err
    assert f"of widths {came}, but {FAMILIES[family][0]} has {expected}" in error
    assert not (folder / "run" / "metrics.csv").exists()  # nothing was trained on it


def test_an_environment_of_another_version_than_the_data(folder):
    MAKERS["antmaze"](folder)
    code, _, err = run("dl_rad.py", "antmaze", folder, "env.env_id=AntMaze_Medium-v5")
    error = err.splitlines()[-1]
    assert code == 1 and error.startswith("error: ") and "Traceback" not in err
    assert "of widths (29, 8), but antmaze-medium-play has (107, 8)" in error
    assert "the version of the data in env.env_id" in error


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("+retrieval.followed.target.aheads=3", "unexpected keyword argument 'aheads'"),
        ("retrieval.followed.expert={rule: first_hit_within, args: [1]}", "argument: 'high'"),
        ("retrieval.followed.sampler.k=few", "a setting of the planner or of retrieval is wrong"),
        ("replay_buffer.batch_size=0", "replay_buffer.batch_size is 0; expected 1 or more"),
        ("threads=0", "threads is 0 and"),
    ],
)
def test_a_wrong_setting_ends_in_one_line(setting, message, folder):
    MAKERS["hopper"](folder)
    code, _, err = run("dl_rad.py", "hopper", folder, setting)
    error = err.splitlines()[-1]
    assert code == 1 and error.startswith("error: ") and message in error
    assert "Traceback" not in err


@pytest.mark.parametrize("recipe", RECIPES)
def test_an_evaluation_that_cannot_be_is_refused_before_the_training(recipe, folder):
    MAKERS["hopper"](folder)
    code, _, err = run(recipe, "hopper", folder, "evaluation.replan=200")
    error = err.splitlines()[-1]
    assert code == 1 and error.startswith("error: interval is 200; expected 1 to ")
    assert not (folder / "run" / "metrics.csv").exists()


def test_a_file_cut_short(folder):
    hopper(folder)
    path = folder / "hopper_medium_replay-v2.hdf5"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    code, _, err = run("dl_rad.py", "hopper", folder)
    error = err.splitlines()[-1]
    assert code == 1 and error.startswith(f"error: {path} is damaged or cut short")
