"""Behaviour cloning of the ways to one goal."""

from __future__ import annotations

import pytest

from .running import call

FEW = ("umaze", "--steps", "3000", "--gradient-steps", "200", "--episodes", "2", "--threads", "1")


def row(text):
    return next(line for line in text.splitlines() if line.startswith("| umaze"))


def test_clones_the_ways_to_a_goal():
    code, text, err = call("behaviour_cloning.py", *FEW, "--goal", "3,1")
    assert code == 0, err
    assert row(text).startswith("| umaze (3, 1) |")
    count = int(text.split(" steps on the way to (3, 1)")[0].split()[-1])
    assert 0 < count < 3000
    assert row(call("behaviour_cloning.py", *FEW, "--goal", "3,1")[1]) == row(text)


@pytest.mark.parametrize(
    "options, message",
    [
        (["nowhere"], "unknown maze 'nowhere'"),
        (["umaze", "--goal", "0,0"], "cell (0, 0) of PointMaze_UMaze-v3 is a wall"),
        (["umaze", "--steps", "300", "--goal", "1,1", "--seed", "0"], "no recorded episode visits"),
    ],
)
def test_settings_that_are_none(options, message):
    code, _, err = call("behaviour_cloning.py", *options, "--episodes", "1")
    assert code == 1 and f"error: {message}" in err
