"""What the recipes share: data, databases, policies, loggers, scores."""

from __future__ import annotations

import copy
import os
from unittest import mock

import pytest
import torch

from torchrl_rad import MazeTask, make_maze_env, make_task, maze_task
from torchrl_rad.checkpoint import CheckpointError, write_json
from torchrl_rad.data.pointmaze import pointmaze_dataset
from torchrl_rad.experiment import (
    BACKBONE,
    check_data,
    collect_episodes,
    evaluate_policies,
    load_starts,
    make_data,
    make_database,
    make_logger,
    make_policies,
    policy_row,
    restrict,
    save_policies,
    saved_maze,
    saved_task,
    share_weights,
    step_error,
    take_weights,
    window_sampler,
)
from torchrl_rad.runs import RunFolder

PLANNER = {
    "horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1, "steps": 1,
    "candidates": 2,
}  # fmt: skip
NETWORK = {**PLANNER, "step_horizon": 6, "step_width": 8}
SAMPLER = {"metric": "euclidean", "dims": [0, 1], "k": 50, "threshold": 0.8}
RETRIEVAL = {
    "paper": {
        "expert": {"rule": "reaches_goal", "args": []},
        "gamma": 0.997,
        "sampler": SAMPLER,
        "target": {"rule": "highest", "tolerance": 0.0},
        "estimator": {"estimate": "mode"},
    },
    "followed": {
        "expert": None,
        "gamma": 0.97,
        "sampler": SAMPLER,
        "target": {"rule": "followed", "ahead": 4},
        "estimator": {"estimate": "recorded"},
    },
}
CONFIG = {
    "seed": 0,
    "device": "cpu",
    "env": {"name": "pointmaze-umaze", "family": "pointmaze", "maze": "umaze"},
    "replay_buffer": {
        "dataset": "collected", "steps": 3000, "seed": 0, "download": False, "batch_size": 8,
        "without": None, "coverage": 0.0, "keep": None,
    },
    "optim": {"precision": "fp32"},
    "network": NETWORK,
    "loss": {"gamma": 0.9},
    "logger": {"backend": "csv", "mode": "offline", "project_name": "tests", "progress": False},
    "evaluation": {"episodes": 2, "seed": 10_000, "starts": None},
}  # fmt: skip
TASK = maze_task("umaze")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    with mock.patch.dict(os.environ, TORCHRL_RAD_CACHE=str(folder)):
        pointmaze_dataset("umaze", 3000, progress=False)
        return make_data(CONFIG)[1]


@pytest.fixture
def policies(data):
    torch.manual_seed(0)
    return make_policies(NETWORK, RETRIEVAL, data)


def logging_to(**changes):
    config = copy.deepcopy(CONFIG)
    config["logger"].update(changes)
    return config


# data


def test_data(data):
    assert data.shape == torch.Size([3000])
    value, reward = data["return_to_go"].double(), data["next", "reward"].squeeze(-1).double()
    last = data["next", "done"].squeeze(-1)
    following = torch.where(last, 0.0, value.roll(-1))
    torch.testing.assert_close(value, reward + 0.9 * following, atol=1e-5, rtol=1e-5)


def test_a_region_is_left_out(data):
    source = {**CONFIG["replay_buffer"], "without": [[3, 1]]}
    left = restrict(TASK, data, source)
    centre, half = TASK.cells([(3, 1)])
    assert half == 0.5
    inside = ((left["observation"][:, :2] - centre).abs() <= half).all(-1)
    assert 0 < len(left) < len(data) and not inside.any()
    # episodes are whole
    counts = {int(e): int((data["episode"] == e).sum()) for e in left["episode"].unique()}
    assert {e: int((left["episode"] == e).sum()) for e in counts} == counts
    assert len(restrict(TASK, data, {**source, "coverage": 1.0})) == len(data)


def test_demonstrations_alone(data):
    keep = {"rule": "reaches_goal", "args": []}
    left = restrict(TASK, data, {**CONFIG["replay_buffer"], "keep": keep})
    assert len(left) == len(make_database(data, RETRIEVAL["paper"]))
    none = {"rule": "first_hit_within", "args": [0, 0]}
    with pytest.raises(ValueError, match="no episode is left by replay_buffer.keep=first_hit"):
        restrict(TASK, data, {**CONFIG["replay_buffer"], "keep": none})


def test_a_region_of_what_is_no_maze(data):
    hopper = make_task({"name": "hopper", "family": "locomotion", "env_id": "Hopper-v5"})
    with pytest.raises(ValueError, match="hopper has no cells: it is no maze"):
        restrict(hopper, data, {**CONFIG["replay_buffer"], "without": [[1, 1]]})
    with pytest.raises(ValueError, match="is a wall or outside the map"):
        restrict(TASK, data, {**CONFIG["replay_buffer"], "without": [[0, 0]]})


def test_starts(tmp_path):
    h5py = pytest.importorskip("h5py")
    assert load_starts(None) is None
    assert load_starts({"cells": [[1, 1], [2, 3]]}) == [(1, 1), (2, 3)]
    with pytest.raises(ValueError, match="expected cells or states"):
        load_starts({"cells": []})
    with pytest.raises(FileNotFoundError, match="nowhere.hdf5"):
        load_starts({"states": "nowhere.hdf5"})
    torch.manual_seed(0)
    with h5py.File(tmp_path / "random.hdf5", "w") as file:
        for name, width in (("observations", 11), ("actions", 3)):
            file[name] = torch.randn(6, width).numpy()
        file["rewards"], file["terminals"] = torch.ones(6).numpy(), [False] * 6
        file["timeouts"] = [False, False, True] * 2
        qpos = torch.randn(6, 6)
        file["infos/qpos"], file["infos/qvel"] = qpos.numpy(), torch.randn(6, 6).numpy()
    starts = load_starts({"states": str(tmp_path / "random.hdf5")})
    assert torch.allclose(starts["qpos"].float(), qpos) and starts["qvel"].shape == (6, 6)
    hopper = make_task({"name": "hopper", "family": "locomotion", "env_id": "Hopper-v5"})
    hopper.make_row(0, starts).reset(seed=0)


def test_task_of_a_saved_policy(tmp_path):
    write_json(tmp_path / "policy.json", {"env": CONFIG["env"]})
    assert saved_maze(tmp_path) == saved_task(tmp_path) == TASK
    robot = {"name": "hopper", "family": "locomotion", "env_id": "Hopper-v5"}
    write_json(tmp_path / "policy.json", {"env": robot})
    assert saved_task(tmp_path).max_steps == 1000
    with pytest.raises(ValueError, match="is of hopper; this needs one of a PointMaze"):
        saved_maze(tmp_path)
    with pytest.raises((FileNotFoundError, CheckpointError)):
        saved_task(tmp_path / "nowhere")


def test_data_without_faults(data):
    found = check_data(TASK, data)
    assert found.ok
    assert "3000 steps in 10 episodes: no faults" in str(found)


def test_faults_are_named(data):
    spoiled = data.clone()
    spoiled["action"][607] = torch.nan
    with pytest.raises(ValueError, match="the data cannot be trained on") as caught:
        check_data(TASK, spoiled)
    assert "action" in str(caught.value) and "episode 2" in str(caught.value)


def test_data_of_another_environment(data):
    hopper = make_task({"name": "hopper", "family": "locomotion", "env_id": "Hopper-v5"})
    with pytest.raises(ValueError, match=r"of widths \(4, 2\), but hopper has \(11, 3\)"):
        check_data(hopper, data)


def test_database(data):
    database = make_database(data, RETRIEVAL["paper"])
    assert database.gamma == 0.997
    rows = database[:]
    kept = data["episode"].unique()[
        [bool(data["next", "reward"][data["episode"] == e].any()) for e in range(10)]
    ]
    assert rows["episode"].unique().tolist() == kept.tolist()
    assert 0 < len(kept) < 10
    # the database's own discount, not that of L_g
    assert len(make_database(data, RETRIEVAL["followed"])) == 3000
    first = data["episode"] == kept[0]
    reward = data["next", "reward"][first].squeeze(-1).double()
    expected = (reward * 0.997 ** torch.arange(300).double()).sum()
    assert rows["return_to_go"][0].item() == pytest.approx(expected.item(), rel=1e-5)


def test_no_expert_left(data):
    options = {**RETRIEVAL["paper"], "expert": {"rule": "first_hit_within", "args": [0, 0]}}
    with pytest.raises(ValueError, match="none of the 10 episodes is an expert's by the rule"):
        make_database(data, options)


def test_windows(data):
    torch.manual_seed(0)
    draw = window_sampler(data, 9, 64)
    windows = draw()
    assert windows.shape == torch.Size([64, 9])
    assert (windows["episode"] == windows["episode"][:, :1]).all()
    assert torch.equal(windows["observation"][:, 1:], windows["next", "observation"][:, :-1])
    assert not torch.equal(draw()["observation"], windows["observation"])
    torch.manual_seed(0)
    assert torch.equal(window_sampler(data, 9, 64)()["observation"], windows["observation"])


# policies


def test_policies(policies, data):
    assert list(policies) == [BACKBONE, "paper", "followed"]
    backbone, paper, followed = (parts.policy for parts in policies.values())
    assert len(backbone) == 1 and not backbone[0].targets
    assert paper[0].rule == "highest" and followed[0].rule == "followed"
    assert policies[BACKBONE].database is None
    assert paper[0].database is policies["paper"].database
    assert paper[0].database is not followed[0].database
    for policy in (backbone, paper, followed):
        mean = data["observation"].mean(0)
        torch.testing.assert_close(policy[-1].normalizer.mean, mean, atol=1e-5, rtol=1e-5)


def test_shared_weights(policies):
    own = copy.deepcopy(policies[BACKBONE].policy[-1].networks.state_dict())
    share_weights(policies, "paper")
    backbone, paper, followed = (parts.policy for parts in policies.values())
    weights = paper.state_dict()
    assert all(torch.equal(value, weights[key]) for key, value in followed.state_dict().items())
    for part in ("inverse_dynamics", "return_model"):
        given = getattr(paper[-1], part).state_dict()
        for key, value in getattr(backbone[-1], part).state_dict().items():
            assert torch.equal(value, given[key]), key
    # the backbone plans without targets: its networks are trained by themselves
    kept = backbone[-1].networks.state_dict()
    assert all(torch.equal(value, kept[key]) for key, value in own.items())


def test_finer_levels_without_targets_are_the_backbones(data):
    torch.manual_seed(0)
    policies = make_policies({**NETWORK, "placement": "shifted_first"}, RETRIEVAL, data)
    own = copy.deepcopy(policies[BACKBONE].policy[-1].networks[0].state_dict())
    share_weights(policies, "paper")
    backbone, given = (policies[name].policy[-1].networks for name in (BACKBONE, "paper"))
    assert all(
        torch.equal(v, given[1].state_dict()[k]) for k, v in backbone[1].state_dict().items()
    )
    assert all(torch.equal(v, own[k]) for k, v in backbone[0].state_dict().items())


def test_weights_of_another_run(tmp_path, policies, data):
    share_weights(policies, "paper")
    run = RunFolder.create(tmp_path / "run", CONFIG)
    save_policies(run, CONFIG, policies)
    torch.manual_seed(1)
    anyone = {**RETRIEVAL["followed"], "target": {"rule": "random"}}
    others = make_policies(NETWORK, {"random": anyone, "followed": RETRIEVAL["followed"]}, data)
    take_weights(others, run.path)
    for name, source in ((BACKBONE, BACKBONE), ("random", "paper"), ("followed", "paper")):
        given = policies[source].policy[-1].state_dict()
        found = others[name].policy[-1].state_dict()
        assert all(torch.equal(value, given[key]) for key, value in found.items()), name


def test_a_policy_plans_in_its_own_way_with_the_same_weights(data):
    network = {**NETWORK, "condition": 0.9}
    own = {**RETRIEVAL["followed"], "network": {"condition": [0.9, 0.2], "steps": 2}}
    policies = make_policies(network, {**RETRIEVAL, "followed": own}, data)
    share_weights(policies, "paper")
    paper, followed = (policies[name].policy[-1] for name in ("paper", "followed"))
    assert paper.condition.shares == (0.9, 0.9) and followed.condition.shares == (0.9, 0.2)
    assert followed.condition.wanted[0] == paper.condition.wanted[0]
    assert followed.condition.wanted[1] < paper.condition.wanted[1]
    assert (paper.steps, followed.steps) == (1, 2)
    state = followed.state_dict()
    assert all(torch.equal(value, state[key]) for key, value in paper.state_dict().items())
    description = policies["followed"].description["planner"]
    assert description["condition"] == [0.9, 0.2]  # what a saved policy is built from


def test_no_weights_to_take(tmp_path, policies, data):
    with pytest.raises(CheckpointError, match="holds no trained policy with targets: give a run"):
        take_weights(policies, tmp_path)
    run = RunFolder.create(tmp_path / "run", CONFIG)
    save_policies(run, CONFIG, policies)
    wider = make_policies({**NETWORK, "width": 32}, RETRIEVAL, data)
    with pytest.raises(CheckpointError, match="does not fit this module"):
        take_weights(wider, run.path)


def test_step_error_by_hand(policies, monkeypatch):
    policy = policies["paper"].policy
    pairs = {
        "observation": torch.zeros(3, 4),
        "target": torch.zeros(3, 4),
        "target_step": torch.tensor([[1], [4], [8]]),
    }
    monkeypatch.setattr("torchrl_rad.experiment.scoring.draw_step_pairs", lambda *_, **__: pairs)
    logits = torch.full((3, 5), -9.0)
    logits[0, 0] = logits[1, 1] = logits[2, 4] = 9.0  # steps 1, 2 and 5: errors 0, 2 and 3
    monkeypatch.setattr(type(policy[1]), "logits", lambda *_: logits)
    assert step_error(policy, {"observation": None}) == pytest.approx(5 / 3)


# scores


def test_same_seed_same_episodes(policies):
    policy, env = policies["paper"].policy, make_maze_env(TASK, 2)
    first, second, other = (
        collect_episodes(env, policy, 12, seed, progress=False) for seed in (3, 3, 4)
    )
    assert (first == second).all()
    assert not torch.equal(first["observation"][:, 0], other["observation"][:, 0])
    assert first.shape == torch.Size([2, 12])
    assert first["next", "observation"].dtype == torch.float32


@pytest.mark.parametrize("progress", [False, True])
def test_progress_counts_each_step(policies, capsys, progress):
    env = make_maze_env(TASK, 1)
    collect_episodes(env, policies[BACKBONE].policy, 6, 0, "mine", progress=progress)
    assert ("evaluating mine: 100%" in capsys.readouterr().err) is progress


def test_row(policies):
    policy = policies["paper"].policy
    steps = collect_episodes(make_maze_env(TASK, 3), policy, 12, 0, progress=False)
    threads = torch.get_num_threads()
    row = policy_row(TASK, policy, steps)
    assert torch.get_num_threads() == threads
    returns = steps["next", "reward"].sum((1, 2)).tolist()
    assert row["episode_returns"] == returns
    assert row["episode_scores"] == pytest.approx(
        [100 * (value - 23.85) / (161.86 - 23.85) for value in returns]
    )
    assert row["episodes"] == 3
    assert set(row["latency_ms"]) == {"1", "3"}
    latency = row["latency_ms"]["1"]
    modules = {"RetrievalTargetModule", "StepEstimator", "DiffuserLitePlanner", "total"}
    assert set(latency) == modules
    planner = latency["DiffuserLitePlanner"]
    assert row["PL"] == f"{planner['p50']:.1f} / {planner['p95']:.1f}"


def test_what_was_evaluated_is_not_done_again(tmp_path, policies, data, monkeypatch):
    run = RunFolder.create(tmp_path, CONFIG)
    steps = collect_episodes(
        make_maze_env(TASK, 2), policies["paper"].policy, 12, 0, progress=False
    )
    for name in policies:
        run.save_episodes(name, steps if name != BACKBONE else steps.select("observation", "next"))

    def refuse(*args, **kwargs):
        raise AssertionError("driven again")

    monkeypatch.setattr(MazeTask, "make_env", refuse)
    rows, episodes = evaluate_policies(run, CONFIG, TASK, policies, data)
    assert list(rows) == list(episodes) == list(policies)
    assert (episodes["paper"] == steps).all()
    assert run.results()["rows"]["paper"]["episode_returns"] == rows["paper"]["episode_returns"]
    assert rows["paper"]["step_error"] >= 0
    assert rows["followed"]["step_error"] is None
    assert "step_error" not in rows[BACKBONE]


# loggers


def test_csv_alone(tmp_path):
    run = RunFolder.create(tmp_path / "run", CONFIG)
    make_logger(run, CONFIG)(10, {"planner/loss": 0.5})
    assert run.metrics.path.read_text() == "step,planner/loss\n10,0.5\n"
    assert {path.name for path in run.path.iterdir()} == {"config.json", "metrics.csv"}


def test_unknown_backend(tmp_path):
    run = RunFolder.create(tmp_path, CONFIG)
    with pytest.raises(ValueError) as caught:
        make_logger(run, logging_to(backend="paper"))
    expected = "logger.backend is 'paper'; expected 'csv', 'tensorboard' or 'wandb'."
    assert str(caught.value) == expected


def test_tensorboard(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from torch.utils import tensorboard

    writers = []

    class Writer(tensorboard.SummaryWriter):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            writers.append(self)

    monkeypatch.setattr(tensorboard, "SummaryWriter", Writer)
    run = RunFolder.create(tmp_path / "run", CONFIG)
    log = make_logger(run, logging_to(backend="tensorboard"))
    log(10, {"planner/loss": 0.5})
    log(20, {"planner/loss": 0.25})
    (writer,) = writers
    writer.flush()
    (file,) = (run.path / "tensorboard").rglob("events.out.*")
    events = EventAccumulator(str(file.parent))
    events.Reload()
    seen = [(event.step, event.value) for event in events.Scalars("planner/loss")]
    assert seen == [(10, 0.5), (20, 0.25)]
    assert [row["step"] for row in run.metrics.rows()] == [10, 20]


@pytest.mark.filterwarnings("ignore")
def test_wandb_offline(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    run = RunFolder.create(tmp_path / "run", CONFIG)
    log = make_logger(run, logging_to(backend="wandb"))
    try:
        log(10, {"planner/loss": 0.5})
        assert wandb.run.settings.mode == "offline"
        assert wandb.run.project == "tests"
        assert wandb.run.config["network"]["horizon"] == 9
    finally:
        wandb.finish()
    assert list(run.path.rglob("*.wandb")), list(tmp_path.rglob("*"))
    assert run.metrics.rows() == [{"step": 10.0, "planner/loss": 0.5}]


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
