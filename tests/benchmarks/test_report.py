"""Tables and pictures of a benchmark run, from the command line."""

from __future__ import annotations

import io
import json
import runpy
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "report.py"
MACHINE = {"cpu": {"brand_raw": "Some CPU", "count": 8}, "python_version": "3.11.7"}


def call(*arguments):
    """Runs the script in this process: exit code, what it prints, what it says of errors."""
    out, err = io.StringIO(), io.StringIO()
    argv = mock.patch.object(sys, "argv", [str(SCRIPT), *map(str, arguments)])
    try:
        with argv, redirect_stdout(out), redirect_stderr(err):
            runpy.run_path(str(SCRIPT), run_name="__main__")
    except SystemExit as stop:
        return stop.code, out.getvalue(), err.getvalue()
    return 0, out.getvalue(), err.getvalue()


def benchmark(name, params, seconds, **extra):
    """As pytest-benchmark writes it."""
    extra = {"threads": 1, "device": "cpu", "versions": {"torch": "2.15.0"}, **extra}
    identity = "-".join(map(str, params.values()))
    return {
        "name": f"test_rad_{name}_speed[{identity}]",
        "params": params,
        "extra_info": extra,
        "stats": {"median": seconds},
    }


def target(rows, dims, k, queries, p50, plain, rule="highest"):
    params = {"rows": rows, "dims": dims, "rule": rule, "k": k, "queries": queries}
    figures = {"p95_ms": 2 * p50, "plain_scan_ms": plain, "ratio": plain / p50}
    return benchmark("target", params, 1e-3 * p50, p50_ms=p50, **figures)


def scaling(candidates, batch, precision, seconds):
    params = {"candidates": candidates, "batch": batch, "precision": precision}
    figures = {"plain_ms": 2000 * seconds, "ratio": 2.0}
    return benchmark("plan_scaling", params, seconds, size="antmaze", **figures)


@pytest.fixture
def written(tmp_path):
    def write(*benchmarks):
        content = {
            "machine_info": MACHINE,
            "commit_info": {"id": "0123456789abcdef", "dirty": False},
            "datetime": "2026-11-25T12:00:00+00:00",
            "benchmarks": list(benchmarks),
        }
        path = tmp_path / "benchmarks.json"
        path.write_text(json.dumps(content))
        return path

    return write


def tables(out):
    """Title -> lines of the table, and what stands above them all."""
    above, *parts = out.strip().split("### ")
    return above.strip(), {part.splitlines()[0]: part.strip().splitlines()[2:] for part in parts}


def test_target_rule(written):
    lines = [
        target(1_000_000, 2, 500, 1, 0.5, 6.25),
        target(10_000, 17, 500, 1, 1.0, 0.25),
        target(10_000, 17, 6, 1, 0.8, 0.2),
        target(10_000, 2, 6, 50, 123.4, 12.34),
    ]
    code, out, err = call(written(*lines))
    assert (code, err) == (0, "")
    above, found = tables(out)
    assert above == (
        "Some CPU, 8 cores, 1 thread(s), cpu; Python 3.11.7, torch 2.15.0; "
        "commit 0123456, 2026-11-25. "
        "Times are medians in ms; a ratio is the time of the plain way over ours, from one test."
    )
    # by rows, then dims; digits as many as three; a dash where a benchmark is absent
    assert found == {
        "Target rule 'highest', queries: 1": [
            "| rows | dims | k 6: ms | k 6: p95 | k 6: plain scan | k 6: ratio "
            "| k 500: ms | k 500: p95 | k 500: plain scan | k 500: ratio |",
            "|---|---|---|---|---|---|---|---|---|---|",
            "| 10k | 17 | 0.80 | 1.60 | 0.20 | 0.25 | 1.00 | 2.00 | 0.25 | 0.25 |",
            "| 1M | 2 | - | - | - | - | 0.50 | 1.00 | 6.25 | 12.5 |",
        ],
        "Target rule 'highest', queries: 50": [
            "| rows | dims | k 6: ms | k 6: p95 | k 6: plain scan | k 6: ratio |",
            "|---|---|---|---|---|---|",
            "| 10k | 2 | 123 | 247 | 12.3 | 0.10 |",
        ],
    }


def test_plans_and_actions(written):
    params = {"process": "flow", "size": "hopper", "candidates": 64, "batch": 1}
    plan = {"plain_ms": 60.0, "ratio": 3.0}
    parts = {name: {"p50": 1.0, "p95": 2.5} for name in ("TS", "SE", "ID")}
    parts |= {"PL": {"p50": 17.0, "p95": 20.0}, "total": {"p50": 20.0, "p95": 25.0}}
    code, out, _ = call(
        written(
            benchmark("plan", {"precision": "bf16", **params}, 0.01, **plan),
            benchmark("plan", {"precision": "fp32", **params}, 0.02, **plan),
            benchmark(
                "policy",
                {"precision": "fp32", "rule": "followed", **params},
                0.02,
                milliseconds=parts,
                share_of_ts_and_se=0.1,
            ),
        )
    )
    assert code == 0
    _, found = tables(out)
    assert found["Plans; the plain ones are in float32"] == [
        "| size | process | environments | candidates | fp32: ms | fp32: plain | fp32: ratio "
        "| bf16: ms | bf16: plain | bf16: ratio |",
        "|---|---|---|---|---|---|---|---|---|---|",
        "| hopper | flow | 1 | 64 | 20.0 | 60.0 | 3.00 | 10.0 | 60.0 | 3.00 |",
    ]
    assert found["One action, median / 95 % in ms"][2:] == [
        "| hopper | followed | flow | fp32 | 1 | 64 | 1.00 / 2.50 | 1.00 / 2.50 | 17.0 / 20.0 "
        "| 1.00 / 2.50 | 20.0 / 25.0 | 10.0 % |",
    ]


def test_training_and_data(written):
    params, at = {"size": "antmaze"}, {"rows": 100_000, "dims": 29}
    memory = {"payload_bytes": 12_000_000, "index_bytes": 400_000, "rule_bytes": 1_200_000}
    code, out, _ = call(
        written(
            benchmark(
                "update", {**params, "precision": "fp32"}, 0.5, objective="denoising", windows=256
            ),
            benchmark(
                "training_step",
                {**params, "precision": "bf16"},
                0.3,
                objective="all",
                windows=256,
                plain_ms=600.0,
                ratio=2.0,
            ),
            benchmark("index_build", at, 0.004, timed="index", **memory),
            benchmark("first_answer", {**at, "memmap": True}, 0.02, timed="first answer, memmap"),
            benchmark("window_sampling", {"steps": 10_000, "length": 33}, 2e-4, buffer="rad"),
        )
    )
    assert code == 0
    _, found = tables(out)
    assert found["A training step; the plain one is in float32"] == [
        "| objective | size | batch | fp32: ms | bf16: ms | bf16: plain | bf16: ratio |",
        "|---|---|---|---|---|---|---|",
        "| denoising | antmaze | 256 | 500 | - | - | - |",
        "| all | antmaze | 256 | - | 300 | 600 | 2.00 |",
    ]
    assert found["Databases"] == [
        "| rows | dims | index: ms | index: index MB | index: rule MB | index: payload MB "
        "| first answer, memmap: ms |",
        "|---|---|---|---|---|---|---|",
        "| 100k | 29 | 4.00 | 0.40 | 1.20 | 12.0 | 20.0 |",
    ]
    assert found["Windows, beside those of SliceSampler"][2:] == ["| 10k | 33 | - | 0.20 |"]


def test_pictures(written, tmp_path):
    asked = [target(10**power, 2, 6, 1, power, 2.0**power) for power in (4, 5, 6)]
    grown = [scaling(1, n, p, 0.01 * n) for n in (1, 4) for p in ("fp32", "bf16")]
    folder = tmp_path / "new" / "pictures"
    code, out, _ = call(written(*asked, *grown), "--pictures", folder)
    assert code == 0
    names = ["target-rule.png", "plans.png"]
    assert out.strip().split("\n\n")[-2:] == [f"![{name}]({folder / name})" for name in names]
    for name in names:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_lines_drawn(written):
    """Panels hold what the JSON says, whatever draws them."""
    script = runpy.run_path(str(SCRIPT))
    entries = script["read_entries"](
        json.loads(
            written(
                target(10_000, 2, 6, 1, 0.5, 1.0),
                target(10_000, 2, 6, 1, 9.0, 1.0, rule="followed"),
                scaling(1, 1, "fp32", 0.01),
                scaling(1, 16, "fp32", 0.05),
                scaling(16, 1, "fp32", 0.02),
            ).read_text()
        )
    )
    (panel,) = script["target_panels"](entries)
    assert panel.title == "1 query, 6 neighbours"
    assert [[e.values[y] for e in found] for found, y, _ in panel.lines] == [[0.5], [1.0], []]
    environments, candidates = script["plan_panels"](entries)
    ours, plain = environments.lines
    assert [(e.values["batch"], e.values["ms"]) for e in ours[0]] == [(1, 10.0), (16, 50.0)]
    assert [e.values[plain[1]] for e in plain[0]] == [20.0, 100.0]
    assert [e.values["candidates"] for e in candidates.lines[0][0]] == [1, 16]


def test_nothing_to_draw(written, tmp_path):
    path = written(benchmark("window_sampling", {"steps": 10_000}, 2e-4, buffer="rad"))
    code, out, _ = call(path, "--pictures", tmp_path / "pictures")
    assert code == 0
    assert "![" not in out
    assert list((tmp_path / "pictures").iterdir()) == []


def test_only_ours(written):
    other = {**benchmark("x", {}, 1.0), "name": "test_dqn_speed[None]"}
    path = written(other)
    assert call(path)[0] == f"error: {path} holds no benchmark of torchrl_rad."


def test_missing_file(tmp_path):
    path = tmp_path / "benchmarks.json"
    assert call(path)[0] == (
        f"error: {path} does not exist; "
        f"python -m pytest benchmarks --benchmark-only --benchmark-json {path} writes it."
    )


@pytest.mark.parametrize("content", ["[]", "{}", '{"benchmarks": []}', "3"])
def test_json_of_something_else(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_text(content)
    assert call(path)[0] == (
        f"error: {path} was not written by pytest-benchmark (--benchmark-json)."
    )


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe"])
def test_no_json(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_bytes(content)
    code, out, _ = call(path)
    assert code.startswith(f"error: {path} cannot be read as JSON: ")
    assert "\n" not in code
    assert out == ""
