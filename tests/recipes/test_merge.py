"""One table of several runs, from the command line."""

from __future__ import annotations

import io
import json
import runpy
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import pytest

RECIPE = Path(__file__).parents[2] / "recipes" / "merge.py"


def call(*arguments):
    """Runs the recipe in this process: exit code, what it prints, what it says of errors."""
    out, err = io.StringIO(), io.StringIO()
    argv = mock.patch.object(sys, "argv", [str(RECIPE), *map(str, arguments)])
    try:
        with argv, redirect_stdout(out), redirect_stderr(err):
            runpy.run_path(str(RECIPE), run_name="__main__")
    except SystemExit as stop:
        return stop.code, out.getvalue(), err.getvalue()
    return 0, out.getvalue(), err.getvalue()


@pytest.fixture
def folder(tmp_path):
    def write(name, score, task="pointmaze-umaze"):
        row = {"score": score, "return": 2 * score, "episode_scores": [score - 1, score + 1]}
        path = tmp_path / name
        path.mkdir()
        content = {"task": task, "rows": {"backbone": row, "followed": row}}
        (path / "results.json").write_text(json.dumps(content))
        return path

    return write


def test_table(folder):
    code, out, err = call(folder("a", 10.0), folder("b", 20.0))
    assert (code, err) == (0, "")
    # between seeds: 5 x t(1, 97.5 %) = 63.5; pooled: 9, 11, 19, 21, half as wide again as 9.4
    cells = "| 30.0 | 15.0 | 63.5 | 4 | 10.0, 20.0 |"
    assert out.splitlines() == [
        "| policy | return | score | +- 95 % | episodes | score of each seed |",
        "|---|---|---|---|---|---|",
        f"| backbone {cells}",
        f"| followed {cells}",
    ]


def test_one_run(folder):
    code, out, _ = call(folder("a", 10.0))
    assert code == 0
    assert out.splitlines()[2].endswith("| 2 | 10.0 |")


def test_runs_without_results_are_named_beside_the_table(folder, tmp_path):
    for name in ("b", "c"):
        (tmp_path / name).mkdir()
    (tmp_path / "c" / "error.txt").write_text("error: the disk is full\n")
    code, out, _ = call(folder("a", 10.0), tmp_path / "b", tmp_path / "c")
    assert out.splitlines()[2].endswith("| 2 | 10.0 |")
    assert code == (
        "2 runs have no results (go on with resume=<folder>):\n"
        f"  {tmp_path / 'b'}: it is not over, or was killed\n"
        f"  {tmp_path / 'c'}: error: the disk is full"
    )


def test_no_run_has_results(tmp_path):
    code, out, _ = call(tmp_path / "a")
    assert out == ""
    assert code.startswith("1 run has no results")


def test_several_tasks(folder):
    code, out, _ = call(folder("a", 10.0), folder("b", 20.0, "pointmaze-large"), folder("c", 30.0))
    assert code == 0
    rows = [line.split(" | ") for line in out.splitlines()[2:]]
    assert [row[0].removeprefix("| ") for row in rows] == [
        "pointmaze-umaze backbone",
        "pointmaze-umaze followed",
        "pointmaze-large backbone",
        "pointmaze-large followed",
    ]
    assert [row[2] for row in rows] == ["20.0", "20.0", "20.0", "20.0"]
    assert [row[-1] for row in rows] == ["10.0, 30.0 |"] * 2 + ["20.0 |"] * 2


def test_no_folder():
    code, _, err = call()
    assert code == 2
    assert "the following arguments are required: folders" in err


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
