"""The main recipe: a small run from end to end, its interruptions and its errors."""

from __future__ import annotations

import hashlib
import json
import random
import re
import shlex
import shutil
import signal
import time
from importlib.metadata import version

import pytest
import torch

from torchrl_rad.experiment.recipe import _new_folder
from torchrl_rad.policy import load_policy
from torchrl_rad.results import format_table
from torchrl_rad.runs import MetricsLog, RunFolder

from .running import POLICIES, SAVE, SMALL, STEPS, call, start

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

# what a run leaves


def test_files(whole):
    run, _ = whole
    names = {path.name for path in run.path.iterdir()}
    assert names == {
        ".lock",
        "checkpoints",
        "config.json",
        "curves.png",
        "episodes",
        "metrics.csv",
        "policies",
        "results.json",
        "targets.png",
    }
    assert {path.name for path in (run.path / "policies").iterdir()} == set(POLICIES)
    episodes = {path.name for path in (run.path / "episodes").iterdir()}
    assert episodes == {f"{name}.safetensors" for name in POLICIES}
    for picture in ("curves.png", "targets.png"):
        assert (run.path / picture).read_bytes().startswith(b"\x89PNG")


def test_config(whole):
    config = whole[0].config()
    assert config["env"]["name"] == "pointmaze-umaze"
    assert config["optim"]["gradient_steps"] == STEPS
    assert config["retrieval"]["followed"]["target"]["rule"] == "followed"


def test_metrics(whole):
    rows = whole[0].metrics.rows()
    assert [row["step"] for row in rows] == list(range(1, STEPS + 1))
    names = {key.split("/")[0] for key in rows[0]} - {"step"}
    assert names == {"planner", "backbone", "estimator", "inverse", "return"}


def test_results(whole):
    run, printed = whole
    results = run.results()
    assert results["task"] == "pointmaze-umaze" and results["seed"] == 0
    assert results["threads"] == 1
    assert results["versions"]["torch"] == version("torch")
    assert "dl_rad.py threads=1" in results["command"]
    assert tuple(results["rows"]) == POLICIES
    for name, row in results["rows"].items():
        steps = run.load_episodes(name)
        reward = steps["next", "reward"].squeeze(-1)
        assert steps.shape == torch.Size([2, 300])
        assert row["episode_returns"] == reward.sum(-1).tolist()
        assert row["return"] == pytest.approx(reward.sum(-1).mean().item())
        # D4RL's reference returns
        scores = [100 * (value - 23.85) / (161.86 - 23.85) for value in row["episode_returns"]]
        assert row["episode_scores"] == pytest.approx(scores)
        assert row["score"] == pytest.approx(sum(scores) / 2)
        assert set(row["latency_ms"]) == {"1", "2"}
    assert "found" not in results["rows"]["backbone"]
    assert results["rows"]["paper"]["step_error"] > 0
    assert results["rows"]["followed"]["step_error"] is None
    assert "D4RL" in results["score_source"]
    assert format_table(results["rows"]) in printed
    assert results["score_source"] in printed
    assert f"run folder: {run.path}" in printed
    assert "3000 steps in 10 episodes: no faults" in printed


def test_all_policies_start_from_the_same_states(whole):
    first = [whole[0].load_episodes(name)["observation"][:, 0] for name in POLICIES]
    assert torch.equal(first[0], first[1]) and torch.equal(first[0], first[2])


def test_policies_load(whole):
    policies = {name: load_policy(whole[0].path / "policies" / name) for name in POLICIES}
    (backbone,), (select, *_), (other, _, planner) = policies.values()
    target = whole[0].config()["retrieval"]["followed"]["target"]
    assert (select.rule, other.rule, other.ahead) == ("highest", "followed", target["ahead"])
    # one training serves both rules, and the backbone's heads are those of the planner
    weights = policies["paper"].state_dict()
    for key, value in policies["followed"].state_dict().items():
        assert torch.equal(value, weights[key]), key
    inverse = planner.inverse_dynamics.state_dict()
    for key, value in backbone.inverse_dynamics.state_dict().items():
        assert torch.equal(value, inverse[key]), key


def test_weights_of_a_run_give_its_figures_without_a_training(tmp_path, whole):
    run, _ = whole
    folder = tmp_path / "again"
    code, _, err = call("dl_rad.py", *SMALL, f"weights={run.path}", f"folder={folder}")
    assert code == 0, err
    again = RunFolder.open(folder)
    for name in POLICIES:
        same, found = run.load_episodes(name), again.load_episodes(name)
        assert torch.equal(found["observation"], same["observation"]), name
    assert not (folder / "checkpoints").exists() and not (folder / "curves.png").exists()


def test_evaluate_gives_the_figures_of_the_run(whole):
    run, _ = whole
    folder = run.path / "policies" / "followed"
    arguments = [str(folder), "--episodes", "2", "--threads", "1", "--precision"]
    arguments.append(run.config()["optim"]["precision"])
    code, out, err = call("evaluate.py", *arguments)
    assert code == 0, err
    row = run.results()["rows"]["followed"]
    assert f"| umaze | {row['return']:.1f} | {row['score']:.1f} |" in out


# interruptions


def digests(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((folder / "policies").rglob("weights.safetensors"))
    }


def assert_equal(folder, run):
    """The same losses as text, and the same weights to the bit."""
    metrics = folder / "metrics.csv"
    assert metrics.read_text() == run.metrics.path.read_text()
    assert digests(folder) == digests(run.path)
    assert len(digests(folder)) == len(POLICIES)


def latest(folder):
    """Step and number of the newest checkpoint."""
    found = [path.name.split("-")[1:] for path in (folder / "checkpoints").glob("step-*")]
    return max(((int(number), int(step)) for step, number in found), default=(0, 0))[::-1]


def wait_for_checkpoint(process, folder, beyond):
    while process.poll() is None and latest(folder)[1] <= beyond:
        time.sleep(0.002)


def test_killed_twice(tmp_path, whole):
    rng, folder = random.Random(0), tmp_path / "run"
    arguments = [*SMALL, f"folder={folder}"]
    for _ in range(2):
        process = start(*arguments)
        wait_for_checkpoint(process, folder, latest(folder)[1])
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.communicate()
        step, number = latest(folder)
        assert number > 0
        rows = MetricsLog(folder / "metrics.csv").rows()
        assert rows[-1]["step"] - step <= SAVE  # at most one interval is lost
        arguments = [f"resume={folder}"]
    # the same weights give the same episodes, so that they need not be driven again
    shutil.copytree(whole[0].path / "episodes", folder / "episodes", dirs_exist_ok=True)
    code, _, err = call("dl_rad.py", *arguments)
    assert code == 0, err
    assert_equal(folder, whole[0])


def test_interrupted(tmp_path, whole):
    folder = tmp_path / "run"
    process = start(*SMALL, f"folder={folder}")
    wait_for_checkpoint(process, folder, 0)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130, err
    step = int(re.search(r"stopped and saved at step (\d+); go on with:", err)[1])
    assert latest(folder)[0] == step
    assert "Traceback" not in err
    python, script, *arguments = shlex.split(err.splitlines()[-1])
    assert (python, script) == ("python", "recipes/dl_rad.py")
    code, _, err = call("dl_rad.py", *arguments)
    assert code == 0, err
    assert_equal(folder, whole[0])
    for name in POLICIES:
        episodes, expected = (run.load_episodes(name) for run in (RunFolder(folder), whole[0]))
        assert (episodes == expected).all()


def test_resumed_run_of_another_task(tmp_path, whole):
    folder = tmp_path / "run"
    shutil.copytree(whole[0].path / "checkpoints", folder / "checkpoints")
    config = whole[0].config()
    config["env"]["name"] = "pointmaze-other"
    (folder / "config.json").write_text(json.dumps(config))
    assert_error(
        call("dl_rad.py", f"resume={folder}"),
        r"is a checkpoint of task 'pointmaze-umaze', this run is task 'pointmaze-other'",
    )


def test_resumed_run_with_other_data(tmp_path, whole):
    folder = tmp_path / "run"
    shutil.copytree(whole[0].path / "checkpoints", folder / "checkpoints")
    config = whole[0].config()
    config["replay_buffer"]["seed"] = 1
    (folder / "config.json").write_text(json.dumps(config))
    assert_error(call("dl_rad.py", f"resume={folder}"), r"is a checkpoint of normalizer '")


# bad input


def assert_error(ran, message):
    """One line that names the fault, and nothing of Python's inside."""
    code, _, err = ran
    assert code not in (0, None)
    assert "Traceback" not in err and "Error executing job" not in err
    lines = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, err
    assert err.splitlines()[-1] == lines[0]
    assert re.search(message, lines[0]), lines[0]


@pytest.mark.parametrize(
    "override, message",
    [
        ("network.jumps=[32,8,2]", r"jumps \[32, 8, 2\] do not multiply out to horizon 129"),
        ("network.horizon=100", r"do not multiply out to horizon 100"),
        ("network.horizon=1", r"a plan has 2 states or more"),
        ("network.steps=0", r"steps is 0; a plan needs at least one inference step"),
        ("network.candidates=0", r"candidates is 0"),
        ("network.process=dance", r"dance"),
        ("network.placement=nowhere", r"nowhere"),
        ("retrieval.paper.sampler.threshold=1.5", r"threshold is 1.5.*\[0, 1\]"),
        ("retrieval.paper.sampler.threshold=-0.1", r"threshold is -0.1.*\[0, 1\]"),
        ("retrieval.paper.sampler.k=0", r"k is 0"),
        ("retrieval.paper.sampler.metric=taxi", r"taxi"),
        ("retrieval.paper.target.tolerance=-1", r"tolerance is -1; it must not be negative"),
        ("retrieval.paper.target.rule=lowest", r"rule is 'lowest'"),
        ("retrieval.followed.target.ahead=500", r"ahead is 500"),
        ("loss.step_pairs=0", "pairs is 0; expected one or more from each window"),
        ("network.step_horizon=130", r"the horizon of 'target' is 130.*built for 129"),
        ("+retrieval.paper.target.horizon=65", r"the horizon of 'target' is 65.*step_horizon"),
        ("+retrieval.paper.estimator.horizon=65", r"the horizon of 'estimator' is 65"),
        ("retrieval.paper.gamma=1.5", r"gamma is 1.5"),
        (
            "retrieval.paper.expert={rule: first_hit_within, args: [0, 0]}",
            r"none of the 10 episodes is an expert's by the rule first_hit_within\(0, 0\); choose",
        ),
        ("retrieval.paper.expert={rule: luck, args: []}", r"unknown expert rule 'luck'; known"),
        ("optim.gradient_steps=0", r"steps is 0; expected 1 or more"),
        ("optim.precision=fp8", r"precision is 'fp8'"),
        ("logger.backend=paper", r"logger.backend is 'paper'; expected 'csv', 'tensorboard' or"),
        ("logger.save_interval=0", r"save_interval is 0; expected 1 or more"),
        ("env.maze=moon", r"unknown maze 'moon'; known mazes are \['large', 'medium', 'umaze'\]"),
        ("replay_buffer.steps=0", r"steps is 0"),
    ],
)
def test_error(tmp_path, override, message):
    assert_error(call("dl_rad.py", *SMALL, f"folder={tmp_path / 'run'}", override), message)


def test_unknown_task(tmp_path):
    code, _, err = call("dl_rad.py", "task=pointmaze-moon", f"folder={tmp_path / 'run'}")
    assert code == 1
    assert "Could not find 'task/pointmaze-moon'" in err
    for name in ("pointmaze-umaze", "pointmaze-medium", "pointmaze-large"):
        assert name in err
    assert "Traceback" not in err
    assert not (tmp_path / "run").exists()


def test_unknown_data_set(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    options = ("replay_buffer.dataset=D4RL/pointmaze/moon-v2", "replay_buffer.download=false")
    ran = call("dl_rad.py", *SMALL, f"folder={tmp_path / 'run'}", *options)
    assert_error(ran, r"'D4RL/pointmaze/moon-v2' is not here .* pass download=True")


def test_horizon_longer_than_the_episodes(tmp_path):
    options = ("network.horizon=321", f"folder={tmp_path / 'run'}")
    assert_error(call("dl_rad.py", *SMALL, *options), r"no episode has 321 steps")


def test_unwritable_folder(tmp_path):
    (tmp_path / "taken").write_text("something else")
    ran = call("dl_rad.py", *SMALL, f"folder={tmp_path / 'taken' / 'run'}")
    assert_error(ran, r"the run folder .* cannot be written: .* Choose another with folder=<path>")


def test_folder_of_another_run(whole):
    path = whole[0].path
    ran = call("dl_rad.py", *SMALL, f"folder={path}")
    assert_error(ran, f"holds a run already; go on with it by resume={re.escape(str(path))}")


def test_resume_of_nothing(tmp_path):
    assert_error(call("dl_rad.py", f"resume={tmp_path}"), r"holds no run: config.json is missing")


def test_resume_of_a_damaged_run(tmp_path, whole):
    folder = tmp_path / "run"
    shutil.copytree(whole[0].path, folder)
    weights = sorted((folder / "checkpoints").glob("step-*/planner.loss.safetensors"))[-1]
    weights.write_bytes(weights.read_bytes()[:-3])
    assert_error(call("dl_rad.py", f"resume={folder}"), r"planner.loss.safetensors is cut short")


# several seeds


def test_seeds_and_their_table(tmp_path):
    code, out, err = call(
        "dl_rad.py", "--multirun", *SMALL, "seed=0,1", "optim.gradient_steps=2"
    )  # fmt: skip
    assert code == 0, err
    folders = sorted((tmp_path / "outputs" / "pointmaze-umaze").iterdir())
    assert [RunFolder.open(folder).config()["seed"] for folder in folders] == [0, 1]
    first, second = (folder / "metrics.csv" for folder in folders)
    assert first.read_text() != second.read_text()
    code, table, err = call("merge.py", *map(str, folders))
    assert code == 0, err
    lines = table.splitlines()
    assert [line.split(" | ")[0] for line in lines] == [
        "| policy", "|---" * len(lines[0].split(" | ")) + "|", *(f"| {name}" for name in POLICIES)
    ]  # fmt: skip
    for line, name in zip(lines[2:], POLICIES, strict=True):
        scores = [RunFolder.open(f).results()["rows"][name]["score"] for f in folders]
        assert f"| {sum(scores) / 2:.1f} |" in line
        assert f"| 4 | {scores[0]:.1f}, {scores[1]:.1f} |" in line


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_failed_run_does_not_end_a_sweep(launcher, tmp_path):
    """One of the runs that a launcher starts has nothing to do."""
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.removesuffix('_local')}_launcher")
    one = ["hydra.launcher.n_jobs=1"] if launcher == "joblib" else []
    code, _, err = call(
        "dl_rad.py", "--multirun", f"hydra/launcher={launcher}", *one, *SMALL,
        "~retrieval.followed", "optim.gradient_steps=2,0,1",
    )  # fmt: skip
    assert code == 1
    assert "steps is 0; expected 1 or more" in err
    runs = {
        RunFolder.open(folder).config()["optim"]["gradient_steps"]: folder
        for folder in (tmp_path / "outputs" / "pointmaze-umaze").iterdir()
    }
    done = {steps: (folder / "results.json").exists() for steps, folder in runs.items()}
    assert done == {2: True, 0: False, 1: True}
    code, table, err = call("merge.py", *map(str, runs.values()))
    assert code == 1
    assert len(table.splitlines()) == 4  # backbone and paper
    assert err.splitlines()[1] == f"  {runs[0]}: error: steps is 0; expected 1 or more."
    # gone on with, it is alive
    assert_error(call("dl_rad.py", f"resume={runs[0]}"), "steps is 0")


def test_runs_that_begin_in_one_second_get_folders_of_their_own(tmp_path, monkeypatch):
    names = [_new_folder("outputs/task/now-seed0").name for _ in range(3)]
    assert names == ["now-seed0", "now-seed0-2", "now-seed0-3"]


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
