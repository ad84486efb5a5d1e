"""Every task by its name: what its file says."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("hydra")

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchrl_rad import ExpertDatabase
from torchrl_rad.data.experts import expert_from_config
from torchrl_rad.envs import make_task
from torchrl_rad.experiment import resolve_dataset
from torchrl_rad.policy import build_policy

from .running import RECIPES

CONFIG = RECIPES / "config"
TASKS = sorted(path.stem for path in (CONFIG / "task").glob("*.yaml"))
PAPER = {  # RAD's appendix: horizon, jumps, expert rule, similarity
    "antmaze": (129, [32, 8, 1], ("first_hit_within", [150, 600]), "euclidean", 0.8),
    "hopper": (129, [32, 8, 1], ("episode_length", [1000]), "cosine", 0.6),
    "halfcheetah": (129, [32, 8, 1], ("episode_length", [1000]), "cosine", 0.6),
    "walker2d": (129, [32, 8, 1], ("episode_length", [1000]), "cosine", 0.6),
    "kitchen": (49, [16, 4, 1], ("return_at_least", [3]), "cosine", 0.9),
}


def config(task, recipe="dl_rad"):
    with initialize_config_dir(str(CONFIG.absolute()), version_base="1.3"):
        cfg = compose(recipe, overrides=[f"task={task}"])
    return OmegaConf.to_container(cfg, resolve=True)


def test_there_are_all_of_the_paper():
    robots = ("hopper", "halfcheetah", "walker2d")
    kinds = ("medium-replay", "medium", "medium-expert")
    expected = {f"{robot}-{kind}" for robot in robots for kind in kinds}
    expected |= {f"antmaze-{size}-{kind}" for size in ("medium", "large")
                 for kind in ("play", "diverse")}  # fmt: skip
    expected |= {f"ogbench-antmaze-{size}-{kind}" for size in ("medium", "large")
                 for kind in ("stitch", "explore")}  # fmt: skip
    expected |= {"kitchen-partial", "kitchen-mixed"}
    expected |= {f"pointmaze-{maze}" for maze in ("umaze", "medium", "large")}
    assert set(TASKS) == expected


@pytest.mark.parametrize("name", TASKS)
def test_what_a_task_says(name):
    cfg = config(name)
    task = make_task(cfg["env"])
    assert cfg["env"]["name"] == name and name.endswith(task.name)
    low, high = task.reference_scores
    assert low < high and task.max_steps > 0
    assert set(cfg["retrieval"]) - {"highest"} == {"paper", "followed"}
    for options in cfg["retrieval"].values():
        parts = set(options) - {"network"}  # if it plans in a way of its own
        assert {"expert", "gamma", "sampler", "target", "estimator"} == parts
        if options["expert"] is not None:
            expert_from_config(options["expert"])
    network = dict(cfg["network"])
    reach, width = network.pop("step_horizon"), network.pop("step_width")
    small = {**network, "width": 20, "heads": 2, "blocks": 1}
    sizes = {"state_dim": 4, "action_dim": 2, "planner": small}
    build_policy(sizes)
    for options in cfg["retrieval"].values():
        target = {"horizon": reach, **options["target"]}
        estimator = {"width": width, **options["estimator"]}
        own = {**sizes, "planner": {**small, **options.get("network", {})}}
        policy = build_policy({**own, "target": target, "estimator": estimator}, ExpertDatabase())
        assert policy[0].horizon == policy[1].horizon == reach


@pytest.mark.parametrize("name", [task for task in TASKS if task.split("-")[0] in PAPER])
def test_the_paper_s_settings(name):
    cfg = config(name)
    horizon, jumps, rule, metric, threshold = PAPER[name.split("-")[0]]
    assert cfg["network"]["horizon"] == horizon and cfg["network"]["jumps"] == jumps
    paper = cfg["retrieval"]["paper"]
    assert (paper["expert"]["rule"], paper["expert"]["args"]) == rule
    sampler = paper["sampler"]
    assert (sampler["metric"], sampler["threshold"], sampler["k"]) == (metric, threshold, 500)
    assert sampler["dims"] == (None if metric == "cosine" else [0, 1])


@pytest.mark.parametrize("name", TASKS)
def test_d_rad_s_settings(name):
    cfg = config(name, "d_rad")
    diffuser = cfg["diffuser"]
    horizons = {  # RAD's appendix, whose 265 must be 256: a U-Net halves it
        "antmaze": 64, "ogbench": 64, "pointmaze-umaze": 128, "pointmaze-medium": 256,
        "pointmaze-large": 384,
    }  # fmt: skip
    expected = horizons.get(name, horizons.get(name.split("-")[0], 32))
    assert diffuser["horizon"] == expected
    assert cfg["retrieval"]["paper"]["sampler"]["k"] == 6
    reach = diffuser.pop("step_horizon")
    diffuser.pop("step_width")
    for options in cfg["retrieval"].values():
        target = {"horizon": reach, **options["target"]}
        small = {**diffuser, "width": 8, "return_model": {**diffuser["return_model"], "width": 8}}
        about = {"state_dim": 4, "action_dim": 2, "planner": small}
        build_policy({**about, "target": target}, ExpertDatabase())


def test_data_sets_that_are_here_come_first(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_RAD_DATA", str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    cfg = config("hopper-medium-replay")
    resolve_dataset(cfg)
    assert cfg["replay_buffer"]["dataset"] == ["mujoco/hopper/simple-replay-v0"]
    cfg = config("hopper-medium-replay")
    (tmp_path / "hopper-medium-replay.hdf5").touch()
    resolve_dataset(cfg)
    assert cfg["replay_buffer"]["dataset"] == [str(tmp_path / "hopper-medium-replay.hdf5")]
    (tmp_path / "hopper_medium_replay-v2.hdf5").touch()  # D4RL's own is preferred
    cfg = config("hopper-medium-replay")
    resolve_dataset(cfg)
    assert Path(cfg["replay_buffer"]["dataset"][0]).name == "hopper_medium_replay-v2.hdf5"
    cfg = config("ogbench-antmaze-medium-stitch")
    with pytest.raises(FileNotFoundError, match="name its folder by TORCHRL_RAD_DATA"):
        resolve_dataset(cfg)
    cfg = config("pointmaze-umaze")
    resolve_dataset(cfg)
    assert cfg["replay_buffer"]["dataset"] == "collected"
