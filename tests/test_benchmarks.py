"""Every benchmark runs, once and at its smallest size."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "benchmarks").glob("test_*.py"))
LARGER = "100k 1M 17d 29d 60d k500 q50 c4 c16 c64 b4 b16 b50 b64 b128 h129".split()
LARGER += "bf16 fp16 hopper antmaze s20".split()


def functions(tree):
    nodes = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    return {node.name: node for node in nodes if node.name.startswith("test_")}


@pytest.mark.timeout(900)  # a second process that loads everything anew
def test_each_benchmark_runs_at_its_smallest_size():
    command = [sys.executable, "-m", "pytest", "benchmarks", "--benchmark-disable", "-vv"]
    # -vv: pyproject.toml asks for -q, which takes one v away
    command += ["-p", "no:cacheprovider", "-k", f"not ({' or '.join(LARGER)})"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "RL_WARNINGS": "0", "COLUMNS": "200"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    ran = re.findall(r"(\w+)\.py::(\w+)(?:\[\S+\])? PASSED", done.stdout)
    expected = {(f.stem, name) for f in FILES for name in functions(ast.parse(f.read_text()))}
    assert set(ran) == expected


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_benchmarks_need_nothing_beside_them(file):
    """TorchRL's harness gets them copied next to its own conftest.py."""
    assert not (ROOT / "benchmarks" / "conftest.py").exists()
    tree = ast.parse(file.read_text())
    imported = {
        alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names
    }
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported |= {node.module for node in froms}
    assert all(node.level == 0 for node in froms)
    neighbours = {path.stem for path in FILES}
    assert not {name.split(".")[0] for name in imported} & (neighbours | {"benchmarks", "tests"})
    for name, function in functions(tree).items():
        assert "benchmark" in {argument.arg for argument in function.args.args}, name
