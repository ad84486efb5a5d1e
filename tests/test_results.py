"""Tables of one run and of several."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy import stats

from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.results import (
    COLUMNS,
    format_table,
    merge_results,
    write_results,
)

# the tables of Student's t distribution, 97.5 %
T1, T3 = 12.7062047, 3.1824463


def row(score, episode_scores, **others):
    return {"score": score, "episode_scores": episode_scores, "return": score / 2, **others}


@pytest.fixture
def folder(tmp_path):
    """Writes a run folder with a results.json."""

    def write(name, rows, task="pointmaze-umaze"):
        path = tmp_path / name
        path.mkdir()
        (path / "results.json").write_text(json.dumps({"task": task, "rows": rows}))
        return path

    return write


# one table


def test_table_by_hand():
    rows = {
        "backbone": {"return": 12.34, "score": -8.26, "success": 0.5, "episodes": 100},
        "followed": {
            "score": 155.04,
            "interval": 6.96,
            "return": 237.8,
            "success": 1.0,
            "arrival": 62.6,
            "share": 0.9996,
            "found": 1.0,
            "similarity": 0.98765,
            "step_error": 7.04,
            "episodes": 100,
            "TS": "0.9 / 1.1",
        },
    }
    heading = (
        "| policy | return | score | +- 95 % | success | steps to goal | share at goal | found "
        "| similarity | step error | episodes | TS ms |"
    )
    assert format_table(rows).splitlines() == [
        heading,
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
        "| backbone | 12.3 | -8.3 | - | 0.50 | - | - | - | - | - | 100 | - |",
        "| followed | 237.8 | 155.0 | 7.0 | 1.00 | 63 | 1.000 | 1.000 | 0.988 | 7.0 | 100 "
        "| 0.9 / 1.1 |",
    ]


@pytest.mark.parametrize("nothing", [None, math.nan, math.inf, -math.inf, np.float64("nan")])
def test_what_there_is_not_shows_as_a_dash(nothing):
    assert format_table({"a": {"arrival": nothing}}).splitlines()[-1] == "| a | - |"


def test_columns_come_in_order_whatever_the_order_of_the_figures():
    figures = {key: "x" if COLUMNS[key][1] == "{}" else 1.0 for key in reversed(COLUMNS)}
    headings = format_table({"a": figures}).splitlines()[0]
    assert headings == f"| policy | {' | '.join(heading for heading, _ in COLUMNS.values())} |"


def test_figures_that_are_no_column_are_left_out():
    table = format_table({"a": {"score": 1.0, "episode_returns": [1.0], "latency_ms": {}}})
    assert table.splitlines()[0] == "| policy | score |"


# several runs


def test_merge_where_seeds_differ(folder):
    folders = [
        folder("0", {"paper": row(10.0, [0.0, 20.0], success=0.5, step_error=6.0)}),
        folder("1", {"paper": row(20.0, [10.0, 30.0], success=1.0, step_error=8.0)}),
    ]
    merged = merge_results(folders)["paper"]
    # between seeds: 10 and 20, deviation 7.0711, over sqrt 2: 5; pooled: 0, 20, 10, 30 have the
    # deviation sqrt(500 / 3), over sqrt 4, times 3.18: 20.54
    assert merged["interval"] == pytest.approx(5 * T1)
    assert merged["interval"] > T3 * math.sqrt(500 / 3) / 2
    assert merged["score"] == 15.0
    assert merged["return"] == 7.5
    assert merged["success"] == 0.75
    assert merged["step_error"] == 7.0
    assert merged["episodes"] == 4
    assert merged["seeds"] == "10.0, 20.0"


def test_merge_where_seeds_agree(folder):
    folders = [
        folder("0", {"paper": row(10.0, [0.0, 20.0])}),
        folder("1", {"paper": row(10.0, [0.0, 20.0])}),
    ]
    merged = merge_results(folders)["paper"]
    assert merged["interval"] == pytest.approx(T3 * math.sqrt(400 / 3) / 2)  # 0, 20, 0, 20
    assert merged["score"] == 10.0


def test_merge_three_seeds_against_scipy(folder):
    rng = np.random.default_rng(0)
    scores = rng.normal(150, 30, (3, 20)) + np.array([[0.0], [1.0], [-2.0]])
    paths = [folder(str(i), {"a": row(s.mean(), s.tolist())}) for i, s in enumerate(scores)]
    low, high = stats.t.interval(0.95, 59, scores.mean(), stats.sem(scores.ravel()))
    between = stats.t.interval(0.95, 2, scores.mean(), stats.sem(scores.mean(1)))
    merged = merge_results(paths)["a"]
    assert merged["score"] == pytest.approx(scores.mean())
    assert merged["interval"] == pytest.approx(max(high - low, between[1] - between[0]) / 2)


def test_merge_one_run(folder):
    merged = merge_results([folder("0", {"a": row(10.0, [0.0, 20.0])})])["a"]
    assert merged["interval"] == pytest.approx(10 * T1)  # the episodes' own
    assert merged["seeds"] == "10.0"


def test_merge_seeds_of_different_numbers_of_episodes(folder):
    folders = [
        folder("0", {"a": row(10.0, [10.0] * 3)}),
        folder("1", {"a": row(20.0, [20.0])}),
    ]
    merged = merge_results(folders)["a"]
    assert merged["score"] == 15.0  # of seeds, not of episodes
    assert merged["episodes"] == 4


def test_merge_leaves_out_what_a_run_lacks(folder):
    folders = [
        folder("0", {"backbone": row(1.0, [1.0, 1.0]), "paper": row(2.0, [2.0, 2.0], found=1.0)}),
        folder("1", {"paper": row(2.0, [2.0, 2.0])}),
    ]
    merged = merge_results(folders)
    assert list(merged) == ["paper"]
    assert "found" not in merged["paper"]


@pytest.mark.parametrize("nothing", [None, math.nan])
def test_merge_means_over_the_seeds_that_arrived(folder, nothing):
    folders = [
        folder("0", {"a": row(1.0, [1.0, 1.0], arrival=60.0)}),
        folder("1", {"a": row(2.0, [2.0, 2.0], arrival=nothing)}),
    ]
    assert merge_results(folders)["a"]["arrival"] == 60.0


def test_merged_rows_make_a_table(folder):
    folders = [
        folder("0", {"backbone": row(1.0, [0.0, 2.0]), "paper": row(10.0, [0.0, 20.0])}),
        folder("1", {"backbone": row(1.0, [0.0, 2.0]), "paper": row(20.0, [10.0, 30.0])}),
    ]
    lines = format_table(merge_results(folders)).splitlines()
    assert lines[0] == "| policy | return | score | +- 95 % | episodes | score of each seed |"
    assert lines[2] == "| backbone | 0.5 | 1.0 | 1.8 | 4 | 1.0, 1.0 |"
    assert lines[3] == "| paper | 7.5 | 15.0 | 63.5 | 4 | 10.0, 20.0 |"


def test_results_hold_no_constant_that_json_lacks(tmp_path):
    rows = {"a": {"arrival": math.nan, "share": [1.0, math.inf, (-math.inf,)], "episodes": 3}}
    write_results(tmp_path, {"task": "nan", "rows": rows})
    text = (tmp_path / "results.json").read_text()
    read = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert read["rows"] == {"a": {"arrival": None, "share": [1.0, None, [None]], "episodes": 3}}
    assert read["task"] == "nan"


def test_no_results(folder, tmp_path):
    good = folder("0", {"a": row(1.0, [1.0])})
    (tmp_path / "1").mkdir()
    with pytest.raises(CheckpointError) as caught:
        merge_results([good, tmp_path / "1"])
    assert f"{tmp_path / '1'} has no results.json" in str(caught.value)
    assert f"(resume={tmp_path / '1'})" in str(caught.value)


def test_damaged_results(folder):
    path = folder("0", {})
    (path / "results.json").write_text('{"task": "pointmaze-')
    with pytest.raises(CheckpointError, match=r"results\.json is damaged: it is not JSON"):
        merge_results([path])


@pytest.mark.parametrize("content", ["[]", "{}", '{"task": "pointmaze-umaze"}'])
def test_results_of_something_else(folder, content):
    path = folder("0", {})
    (path / "results.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"results\.json is not of a run"):
        merge_results([path])


def test_other_task(folder):
    folders = [folder("0", {}), folder("1", {}, task="pointmaze-large")]
    with pytest.raises(CheckpointError) as caught:
        merge_results(folders)
    assert "several tasks, ['pointmaze-large', 'pointmaze-umaze']; merge each" in str(caught.value)


def test_nothing_to_merge():
    with pytest.raises(CheckpointError, match="no run folders"):
        merge_results([])


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
