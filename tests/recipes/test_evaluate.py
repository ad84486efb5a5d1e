"""Scoring a saved policy from the command line."""

from __future__ import annotations

import io
import logging
import runpy
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import pytest
import torch
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, maze_task, reaches_goal
from torchrl_rad.data.pointmaze import collect_pointmaze
from torchrl_rad.policy import build_policy, fit_scales, save_policy

RECIPE = Path(__file__).parents[2] / "recipes" / "evaluate.py"
ABOUT = {
    "maze": "umaze",
    "state_dim": 4,
    "action_dim": 2,
    "planner": {
        "horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1, "steps": 1
    },
    "target": {"rule": "followed", "ahead": 4},
    "estimator": {"width": 8, "estimate": "recorded"},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A policy with fresh weights and the demonstrations of a small collection."""
    data = collect_pointmaze(maze_task("umaze"), 3000, progress=False)
    sampler = RetrievalSampler("euclidean", dims=[0, 1], k=50, threshold=0.8)
    database = ExpertDatabase(LazyTensorStorage(3000), expert=reaches_goal(), sampler=sampler)
    database.extend(data)
    torch.manual_seed(0)
    policy = build_policy(ABOUT, database)
    fit_scales(policy, data.set("return_to_go", data["next", "reward"].squeeze(-1)))
    path = tmp_path_factory.mktemp("run") / "policies" / "followed"
    save_policy(path, policy, ABOUT, database)
    return path


def call(*arguments):
    """Runs the recipe in this process: exit code, what it prints, what it says of errors."""
    out, err = io.StringIO(), io.StringIO()
    threads, logger = torch.get_num_threads(), logging.getLogger("torchrl")
    level = logger.level
    argv = mock.patch.object(sys, "argv", [str(RECIPE), *map(str, arguments)])
    try:
        with argv, redirect_stdout(out), redirect_stderr(err):
            runpy.run_path(str(RECIPE), run_name="__main__")
    except SystemExit as stop:
        return stop.code, out.getvalue(), err.getvalue()
    finally:
        torch.set_num_threads(threads)
        logger.setLevel(level)
    return 0, out.getvalue(), err.getvalue()


def score(folder, *options):
    code, out, err = call(folder, "--threads", "1", *options)
    assert code == 0, err
    return out.splitlines()


def columns(lines):
    """The row of the table, without the times, which differ from run to run."""
    headings, row = ([cell.strip() for cell in line.split("|")] for line in (lines[0], lines[2]))
    return {key: cell for key, cell in zip(headings, row, strict=True) if "ms" not in key}


def test_same_seed_same_score(folder):
    first, second, other = (
        score(folder, "--episodes", "3", "--seed", seed) for seed in ("7", "7", "8")
    )
    assert columns(first) == columns(second)
    assert columns(first) != columns(other)
    assert columns(first)["policy"] == "umaze"
    assert columns(first)["episodes"] == "3"
    assert 0 < float(columns(first)["found"]) <= 1
    assert {"TS ms", "SE ms", "PL ms"} <= {cell.strip() for cell in first[0].split("|")}
    assert first[-1] == (
        "score: 100 x (return - min) / (max - min), reference returns 23.85 and 161.86 of D4RL's "
        "maze2d v1 (d4rl/infos.py)"
    )


def test_folder_in_any_place(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "copy")
    lines = [score(path, "--episodes", "1") for path in (folder, tmp_path / "copy")]
    assert columns(lines[0]) == columns(lines[1])


def test_no_policy(tmp_path):
    code, out, _ = call(tmp_path)
    assert code.startswith(f"error: {tmp_path} holds no policy: policy.json is missing.")
    assert out == ""


def test_damaged_policy(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "copy")
    weights = tmp_path / "copy" / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    code, _, _ = call(tmp_path / "copy")
    assert code.startswith(f"error: {weights} is cut short: it has ")


def test_no_folder():
    code, _, err = call()
    assert code == 2
    assert "the following arguments are required: folder" in err


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
