"""Starts that no demonstration covers, with and without a target."""

from __future__ import annotations

import json

import pytest

from .running import call

WITHOUT = ("--without", "3,1")


def test_scores_by_distance(whole, tmp_path):
    policy, out = whole[0].path / "policies" / "followed", tmp_path / "fallback.json"
    options = ("--episodes", "1", "--level", "0.5", "--threads", "1", "--out", str(out))
    code, text, err = call("fallback.py", str(policy), *WITHOUT, *options)
    assert code == 0, err
    results = json.loads(out.read_text())
    assert 0 < results["threshold"] < 1 and f"similarity {results['threshold']:.3f}" in text
    rows = results["rows"]
    assert list(rows) == ["a target always", "calibrated", "no target"]
    bins = [[entry["distance"] for entry in table] for table in rows.values()]
    assert bins[0] == bins[1] == bins[2]
    assert all(sum(entry["episodes"] for entry in table) == 7 for table in rows.values())
    assert all(entry["fallback"] == 0 for entry in rows["a target always"])
    assert all(entry["fallback"] == 1 for entry in rows["no target"])
    far = 1 / results["threshold"] - 1
    for entry in rows["calibrated"]:
        low, high = entry["distance"]
        if low > far:
            assert entry["start_fallback"] == 1
        if high is not None and high < far:
            assert entry["start_fallback"] == 0


@pytest.mark.parametrize(
    "options, message",
    [
        (["--level", "2"], "--level is 2.0; expected a share between 0 and 1"),
        (["--without", "0,0"], "cell (0, 0) of PointMaze_UMaze-v3 is a wall or outside the map"),
        (["--without", "1,1"], "no demonstration is left"),
        (["--episodes", "0"], "--episodes is 0; at least one is needed"),
    ],
)
def test_settings_that_are_none(whole, options, message):
    policy = whole[0].path / "policies" / "followed"
    code, _, err = call("fallback.py", str(policy), *WITHOUT, *options)
    assert code == 1 and err.startswith("error: ") and message in err
