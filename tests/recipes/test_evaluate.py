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

from ..saved_policy import save_small_policy

RECIPE = Path(__file__).parents[2] / "recipes" / "evaluate.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A policy with fresh weights and the demonstrations of a small collection."""
    path = tmp_path_factory.mktemp("run") / "policies" / "followed"
    save_small_policy(path)
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


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_same_on_ray(ray, folder, monkeypatch):
    monkeypatch.chdir(folder.parent)
    fixed = ("--episodes", "3", "--rows", "2")
    here, there = (score(folder.name, *fixed, *options) for options in ([], ["--backend", "ray"]))
    assert columns(here) == columns(there)


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


# other goals


def test_goals_without_training(whole, tmp_path):
    policy = whole[0].path / "policies" / "followed"
    csv, picture = tmp_path / "followed.csv", tmp_path / "followed.png"
    written = ["--csv", str(csv), "--picture", str(picture)]
    lines = score(policy, "--episodes", "2", "--goals", "3,1", "1,3", *written)
    assert picture.stat().st_size > 10_000
    rows = [[cell.strip() for cell in line.split("|")][1] for line in lines[2:4]]
    assert rows == ["umaze (3, 1)", "umaze (1, 3)"]
    assert "the return model is of it" in lines[-1]
    followed = csv.read_text().splitlines()
    assert followed[0].startswith("row,step,found,episode,episode_step,target_step,similarity")
    assert len(followed) == 1 + 4 * 300
    assert {line.split(",")[2] for line in followed[1:]} <= {"0", "1"}


def test_another_database(whole, folder):
    run, _ = whole
    policy, other = run.path / "policies" / "followed", folder / "database"
    lines = score(policy, "--episodes", "1", "--database", str(other))
    own = score(policy, "--episodes", "1")
    assert columns(lines)["similarity"] != columns(own)["similarity"]
    goals = score(policy, "--episodes", "1", "--goals", "3,1", "--database", str(other))
    assert "umaze (3, 1)" in goals[2]


@pytest.mark.parametrize(
    "options, message",
    [
        (["--goals", "0,0"], "cell (0, 0) of PointMaze_UMaze-v3 is a wall or outside the map"),
        (["--goals", "9,9"], "cell (9, 9) of PointMaze_UMaze-v3 is a wall or outside the map"),
        (["--database", "nowhere"], "nowhere holds no database"),
        (["--episodes", "0"], "--episodes is 0; at least one is needed"),
        (["--workers", "2"], "collector.workers is 2, but backend=direct is one process"),
        (["--goals", "3,1", "--rows", "1"], "--goals are driven by one process, all at once"),
    ],
)
def test_settings_that_are_none(whole, options, message):
    code, out, _ = call(whole[0].path / "policies" / "followed", "--episodes", "1", *options)
    assert code.startswith("error: ") and message in code and out == ""


def test_goals_of_a_policy_without_targets(whole, tmp_path):
    backbone = whole[0].path / "policies" / "backbone"
    lines = score(backbone, "--episodes", "2", "--goals", "3,1", "1,3")
    assert "found" not in lines[0] and "umaze (1, 3)" in lines[3]
    for option in ("--csv", "--picture"):
        code, _, _ = call(backbone, "--goals", "3,1", option, str(tmp_path / "none"))
        assert "retrieves nothing to write down" in code


def test_goals_of_a_policy_without_its_run(folder):
    code, _, _ = call(folder, "--goals", "3,1")
    assert "holds no run: config.json is missing" in code


@pytest.mark.parametrize("text", ["3", "a,b", "1,2,3"])
def test_a_goal_that_is_no_cell(folder, text):
    code, _, err = call(folder, "--goals", text)
    assert code == 2 and f"argument --goals: invalid maze_cell value: '{text}'" in err


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
