"""A database that grows by the policy's own episodes."""

from __future__ import annotations

import json

import pytest

from torchrl_rad import ExpertDatabase
from torchrl_rad.data.pointmaze import pointmaze_dataset

from .running import call

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")


def grow(policy, out, *options):
    """Runs the recipe: its results and what it printed."""
    fixed = ("--rows", "3", "--threads", "1", "--out", str(out))
    code, text, err = call("growth.py", str(policy), *fixed, *options)
    assert code == 0, err
    assert (out / "growth.png").stat().st_size > 5000
    return json.loads((out / "results.json").read_text()), text


def test_grows_by_what_reached_the_goal(whole, tmp_path):
    policy = whole[0].path / "policies" / "followed"
    digest = ExpertDatabase.loads(policy / "database").digest()
    results, text = grow(policy, tmp_path / "grown", "--start", "1", "--rounds", "3")
    rounds = results["runs"]["1"]
    held = [entry["demonstrations"] for entry in rounds]
    assert held[0] == 1 and [entry["seen"] for entry in rounds] == [0, 3, 6]
    for before, after, entry in zip(held, held[1:], rounds, strict=False):
        assert after - before == round(3 * entry["success"])
        assert len(entry["scores"]) == 3
        line = f"{entry['seen']:5d} seen, {before:4d} demonstrations: score {entry['score']:6.1f}"
        assert line in text
    # the saved policy is as it was
    assert ExpertDatabase.loads(policy / "database").digest() == digest


def test_goes_on_where_it_stopped(whole, tmp_path):
    policy = whole[0].path / "policies" / "followed"
    once, _ = grow(policy, tmp_path / "once", "--start", "1", "--rounds", "2", "--prune")
    first, _ = grow(policy, tmp_path / "twice", "--start", "1", "--rounds", "1")
    second, _ = grow(policy, tmp_path / "twice", "--start", "1", "--rounds", "2", "--prune")
    assert second["runs"] == once["runs"]
    assert first["runs"]["1"] == once["runs"]["1"][:1]
    last, pruned = once["runs"]["1"][1:]
    assert pruned["pruned"] and not last["pruned"]
    assert pruned["demonstrations"] == len(last["followed"]) <= last["demonstrations"]
    assert set(pruned["followed"]) <= set(last["followed"])
    code, _, err = call("growth.py", str(policy), "--rows", "4", "--out", str(tmp_path / "twice"))
    assert code == 1 and "pass another --out" in err


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_workers_see_what_was_added(ray, whole, tmp_path):
    policy = whole[0].path / "policies" / "followed"
    fixed = ("--start", "1", "--rounds", "2", "--prune", "--unit", "2")
    here, _ = grow(policy, tmp_path / "here", *fixed)
    there, _ = grow(policy, tmp_path / "there", *fixed, "--backend", "ray", "--workers", "2")
    assert there["runs"] == here["runs"]
    first, last, _ = there["runs"]["1"]
    added = last["demonstrations"] - first["demonstrations"]
    assert added == sum(score > -17.28 for score in first["scores"])  # each that paid, once


def test_sizes(whole, tmp_path):
    policy = whole[0].path / "policies" / "followed"
    results, _ = grow(policy, tmp_path / "sizes", "--start", "1", "2", "--rounds", "1")
    assert [runs[0]["demonstrations"] for runs in results["runs"].values()] == [1, 2]


@pytest.mark.parametrize(
    "options, message",
    [
        (["--start", "0"], "--start is 0; there are"),
        (["--start", "9999"], "--start is 9999; there are"),
        (["--rows", "0"], "--rows and --rounds are at least 1"),
        (["--start", "1", "--capacity", "10"], "rows do not fit: the storage has room for 10"),
    ],
)
def test_settings_that_are_none(whole, options, message):
    code, _, err = call("growth.py", str(whole[0].path / "policies" / "followed"), *options)
    assert code == 1 and message in err


def test_no_policy(tmp_path):
    code, _, err = call("growth.py", str(tmp_path))
    assert code == 1 and "error: " in err and "policy.json" in err


def test_the_data_have_some_demonstrations():
    reward = pointmaze_dataset("umaze", 3000, progress=False)["next", "reward"]
    assert (reward > 0).any()
