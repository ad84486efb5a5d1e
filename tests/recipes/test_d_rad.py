"""D-RAD from the command line: the same run as DL-RAD's with another planner."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict

from torchrl_rad import DiffuserPlanner, load_policy
from torchrl_rad.runs import RunFolder

from .running import call

pytest.importorskip("hydra")

SMALL = (
    "threads=1",
    "optim.gradient_steps=12",
    "diffuser.horizon=32",
    "diffuser.width=8",
    "diffuser.multiples=[1,2]",
    "diffuser.steps=2",
    "diffuser.candidates=2",
    "diffuser.return_model.width=8",
    "diffuser.guide_stop=1",
    "diffuser.step_width=16",
    "logger.progress=false",
    "logger.save_interval=4",
    "evaluation.episodes=2",
    "replay_buffer.batch_size=8",
    "replay_buffer.steps=3000",
    "retrieval.paper.expert={rule: reaches_goal, args: []}",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("d_rad") / "run"
    code, text, err = call("d_rad.py", *SMALL, f"folder={folder}")
    assert code == 0, err
    return RunFolder.open(folder), text


def test_what_a_run_leaves(run):
    run, text = run
    results = run.results()
    assert list(results["rows"]) == ["backbone", "paper", "followed"]
    for name, row in results["rows"].items():
        assert f"| {name} | {row['return']:.1f} |" in text
        assert "DiffuserPlanner" in row["latency_ms"]["1"]
    config = json.loads((run.path / "config.json").read_text())
    assert config["network"]["kind"] == "diffuser" and "diffuser" not in config
    assert config["retrieval"]["paper"]["sampler"]["k"] == 6
    losses = (run.path / "metrics.csv").read_text().splitlines()[0]
    assert {"planner/loss_denoising", "return/loss_guidance"} <= set(losses.split(","))
    assert (run.path / "targets.png").stat().st_size > 10_000


def test_saved_policies_act(run):
    folder = run[0].path / "policies"
    for name in ("paper", "backbone"):
        policy = load_policy(folder / name)
        assert isinstance(policy[-1], DiffuserPlanner)
        assert policy[-1].targets == (name == "paper")
        out = policy(TensorDict({"observation": torch.zeros(3, 4)}, [3]))
        assert out["action"].shape == (3, 2) and (out["action"].abs() <= 1).all()
        assert out["plan"].shape == (3, 32, 4) and (out["plan"][:, 0] == 0).all()


def test_scored_again_as_it_was(run):
    run, _ = run
    policy = str(run.path / "policies" / "paper")
    options = ("--episodes", "2", "--threads", "1", "--seed", "10000")
    code, text, err = call("evaluate.py", policy, *options)
    assert code == 0, err
    assert f"| {run.results()['rows']['paper']['return']:.1f} |" in text


def test_same_seed_same_weights(run, tmp_path):
    whole, _ = run
    code, _, err = call("d_rad.py", *SMALL, f"folder={tmp_path / 'run'}", "evaluation.episodes=1")
    assert code == 0, err
    again = RunFolder.open(tmp_path / "run")
    weights = [
        load_policy(each.path / "policies" / "paper").state_dict() for each in (whole, again)
    ]
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])


def test_a_horizon_that_cannot_be_halved(tmp_path):
    code, _, err = call("d_rad.py", *SMALL, "diffuser.horizon=33", f"folder={tmp_path / 'run'}")
    assert code == 1 and "a plan of 33 steps cannot be halved 1 times" in err
