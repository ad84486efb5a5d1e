"""A database that grows by the policy's own episodes."""

from __future__ import annotations

import json

import pytest

from torchrl_rad import ExpertDatabase
from torchrl_rad.data.pointmaze import pointmaze_dataset

from .running import call

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")


def test_grows_by_what_reached_the_goal(whole, tmp_path):
    policy = whole[0].path / "policies" / "followed"
    digest = ExpertDatabase.loads(policy / "database").digest()
    out = tmp_path / "grown"
    options = ["--start", "1", "--rounds", "3", "--rows", "3", "--threads", "1", "--out", str(out)]
    code, text, err = call("growth.py", str(policy), *options)
    assert code == 0, err
    results = json.loads((out / "results.json").read_text())
    assert (out / "growth.png").stat().st_size > 5000
    held = [entry["demonstrations"] for entry in results["rounds"]]
    assert held[0] == 1 and [entry["seen"] for entry in results["rounds"]] == [0, 3, 6]
    for before, after, entry in zip(held, held[1:], results["rounds"], strict=False):
        assert after - before == round(3 * entry["success"])
        assert len(entry["scores"]) == 3
        line = f"{entry['seen']:5d} seen, {before:4d} demonstrations: score {entry['score']:6.1f}"
        assert line in text
    # the saved policy is as it was
    assert ExpertDatabase.loads(policy / "database").digest() == digest


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
