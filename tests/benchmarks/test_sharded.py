"""The benchmark of databases beyond memory, at a small size."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

FILE = Path(__file__).parents[2] / "benchmarks" / "sharded.py"


@pytest.fixture(scope="module")
def sharded():
    spec = importlib.util.spec_from_file_location("sharded_benchmark", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_built_asked_and_compared(sharded, tmp_path):
    rows, threads = 60_000, torch.get_num_threads()
    folder = tmp_path / "database"
    built = sharded.measured(sharded.build, folder, rows, 25_000)
    assert (built["rows"], built["shards"]) == (rows, 3) and built["peak_MB"]["anonymous"] > 0
    assert sharded.ask(folder, 10)["batch_1"]["calls"] == 9
    assert sharded.compare(folder, rows) == {"queries": 24, "equal": 24}
    assert torch.get_num_threads() == threads


def test_returns_by_hand(sharded):
    value = sharded.returns(torch.tensor([[0.0, 1.0, 0.0, 2.0]]).numpy())
    assert value[0].tolist() == pytest.approx([0.97 + 2 * 0.97**3, 1 + 2 * 0.97**2, 1.94, 2])
