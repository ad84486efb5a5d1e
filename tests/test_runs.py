"""The folder of a run and its table of metrics."""

from __future__ import annotations

import json
import math
import os
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad import runs
from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.runs import MetricsLog, RunFolder, environment_facts

FLOATS = st.floats(allow_nan=False)


@pytest.fixture
def log(tmp_path):
    log = MetricsLog(tmp_path / "metrics.csv")
    for step in (10, 20, 30):
        log.write(step, {"planner/loss": step / 3, "planner/size": 1.0})
    return log


# metrics


def test_rows(log):
    assert log.path.read_text() == (
        "step,planner/loss,planner/size\n"
        "10,3.3333333333333335,1.0\n20,6.666666666666667,1.0\n30,10.0,1.0\n"
    )
    assert log.rows()[1] == {"step": 20.0, "planner/loss": 20 / 3, "planner/size": 1.0}


def test_no_file_no_rows(tmp_path):
    assert MetricsLog(tmp_path / "metrics.csv").rows() == []


@pytest.mark.parametrize("step, left", [(30, 3), (29, 2), (20, 2), (10, 1), (9, 0), (0, 0)])
def test_rewind(log, step, left):
    lines = log.path.read_text().splitlines(keepends=True)
    log.rewind(step)
    assert log.path.read_text() == "".join(lines[: left + 1] if left else [])
    log.write(99, {"planner/loss": 0.5, "planner/size": 2.0})
    assert log.path.read_text() == "".join([*lines[: left + 1], "99,0.5,2.0\n"])


def test_rewind_of_nothing(tmp_path):
    log = MetricsLog(tmp_path / "metrics.csv")
    log.rewind(0)
    assert log.rows() == []
    log.write(1, {"loss": 1.0})
    assert log.path.read_text() == "step,loss\n1,1.0\n"


@pytest.mark.parametrize("cut", range(1, 12))
def test_half_written_last_line(log, cut):
    text = log.path.read_text()
    log.path.write_text(text[:-cut])  # what a kill in the middle of a write leaves
    assert [row["step"] for row in log.rows()] == [10, 20]
    log.rewind(30)
    assert log.path.read_text() == text[: text.index("30,")]


def test_half_written_heading(tmp_path):
    log = MetricsLog(tmp_path / "metrics.csv")
    log.path.write_text("step,lo")
    assert log.rows() == []
    log.rewind(0)
    log.write(1, {"loss": 1.0})
    assert log.path.read_text() == "step,loss\n1,1.0\n"


def test_special_numbers(tmp_path):
    log = MetricsLog(tmp_path / "metrics.csv")
    log.write(1, {"a": math.nan, "b": -math.inf, "c": 5e-324})
    (row,) = log.rows()
    assert math.isnan(row["a"]) and row["b"] == -math.inf and row["c"] == 5e-324


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(FLOATS, FLOATS), min_size=1, max_size=5), st.integers(0, 6))
def test_numbers_survive(tmp_path_factory, values, step):
    log = MetricsLog(tmp_path_factory.mktemp("log") / "metrics.csv")
    for number, (first, second) in enumerate(values, 1):
        log.write(number, {"first": first, "second": second})
    expected = [
        {"step": number, "first": first, "second": second}
        for number, (first, second) in enumerate(values, 1)
    ]
    assert log.rows() == expected
    before = log.path.read_text().splitlines()
    log.rewind(step)
    assert log.rows() == expected[:step]
    assert log.path.read_text().splitlines() == (before[: step + 1] if step else [])


def test_full_disk(log, monkeypatch):
    text = log.path.read_text()

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        log.rewind(10)
    assert log.path.read_text() == text


# folders


def test_create_and_open(tmp_path):
    config = {"seed": 3, "network": {"jumps": [32, 8, 1]}, "resume": None}
    run = RunFolder.create(tmp_path / "new" / "run", config)
    assert run.path == tmp_path / "new" / "run"
    again = RunFolder.open(str(run.path))
    assert again.path == run.path
    assert again.config() == config
    assert again.results() == {}
    assert again.metrics.path == run.path / "metrics.csv"


def test_relative_folder_stays_where_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = RunFolder.create("run", {})
    monkeypatch.chdir("/")
    assert run.config() == {}


def test_create_in_an_empty_folder(tmp_path):
    assert RunFolder.create(tmp_path, {"seed": 0}).config() == {"seed": 0}


def test_create_twice(tmp_path):
    RunFolder.create(tmp_path, {"seed": 0})
    with pytest.raises(CheckpointError) as caught:
        RunFolder.create(tmp_path, {"seed": 1})
    assert str(caught.value) == (
        f"{tmp_path} holds a run already; go on with it by resume={tmp_path}, "
        "or choose another folder."
    )
    assert RunFolder.open(tmp_path).config() == {"seed": 0}


def test_open_nothing(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        RunFolder.open(tmp_path / "absent")
    assert f"{tmp_path / 'absent'} holds no run: config.json is missing." in str(caught.value)
    assert "Pass the folder that the run printed" in str(caught.value)
    assert not (tmp_path / "absent").exists()


def test_damaged_config(tmp_path):
    (tmp_path / "config.json").write_text('{"seed": ')
    with pytest.raises(CheckpointError, match=r"config\.json is damaged: it is not JSON"):
        RunFolder.open(tmp_path).config()


@pytest.mark.parametrize("inner", ["", "deeper/run"])
def test_a_file_in_the_way(tmp_path, inner):
    blocked = tmp_path / "taken"
    blocked.write_text("something else")
    with pytest.raises(CheckpointError) as caught:
        RunFolder.create(blocked / inner, {})
    assert f"the run folder {blocked / inner} cannot be written: " in str(caught.value)
    assert str(caught.value).endswith("Choose another with folder=<path>.")
    assert blocked.read_text() == "something else"


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(CheckpointError, match="cannot be written: Permission denied"):
        RunFolder.create(tmp_path / "run", {})
    tmp_path.chmod(0o700)


@pytest.mark.parametrize("failing", ["mkdir", "fsync"])
def test_refused_by_the_system(tmp_path, monkeypatch, failing):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(*{"mkdir": (Path, "mkdir"), "fsync": (os, "fsync")}[failing], refuse)
    with pytest.raises(CheckpointError, match="cannot be written: Permission denied"):
        RunFolder.create(tmp_path / "run", {})


# episodes


def episodes(rows=3, steps=4):
    torch.manual_seed(0)
    following = {
        "observation": torch.randn(rows, steps, 2),
        "reward": torch.rand(rows, steps, 1),
        "done": torch.rand(rows, steps, 1) > 0.5,
    }
    return TensorDict(
        {
            "observation": torch.randn(rows, steps, 2),
            "target_index": torch.randint(9, (rows, steps, 1)),
            "found": torch.rand(rows, steps, 1) > 0.5,
            "similarity": torch.full((rows, steps, 1), -torch.inf),
            "next": following,
        },
        [rows, steps],
    )


def test_episodes_round_trip(tmp_path):
    run, steps = RunFolder.create(tmp_path, {}), episodes()
    run.save_episodes("paper", steps)
    run.save_episodes("followed", episodes(2, 5))
    loaded = RunFolder.open(tmp_path).load_episodes("paper")
    assert loaded.batch_size == torch.Size([3, 4])
    keys = set(steps.keys(True, True))
    assert set(loaded.keys(True, True)) == keys
    for key in keys:
        assert torch.equal(loaded[key], steps[key]), key
        assert loaded[key].dtype == steps[key].dtype
    assert run.load_episodes("followed").shape == torch.Size([2, 5])


def test_episodes_saved_again(tmp_path):
    run = RunFolder.create(tmp_path, {})
    run.save_episodes("paper", episodes())
    run.save_episodes("paper", episodes(1, 2))
    assert run.load_episodes("paper").shape == torch.Size([1, 2])


def test_no_episodes(tmp_path):
    assert RunFolder.create(tmp_path, {}).load_episodes("paper") is None


def test_damaged_episodes(tmp_path):
    run = RunFolder.create(tmp_path, {})
    run.save_episodes("paper", episodes())
    file = tmp_path / "episodes" / "paper.safetensors"
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(CheckpointError, match=r"paper\.safetensors is damaged"):
        run.load_episodes("paper")


def test_results(tmp_path):
    run = RunFolder.create(tmp_path, {})
    (tmp_path / "results.json").write_text('{"task": "pointmaze-umaze", "rows": {}}')
    assert run.results() == {"task": "pointmaze-umaze", "rows": {}}


# what results.json says of the machine


def test_environment_facts(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["recipes/dl_rad.py", "seed=1"])
    facts = json.loads(json.dumps(environment_facts()))
    assert facts["command"] == "python recipes/dl_rad.py seed=1"
    assert facts["threads"] == torch.get_num_threads()
    assert facts["cpus"] == os.cpu_count()
    assert facts["python"] == sys.version.split()[0]
    assert facts["versions"]["torchrl"] == version("torchrl")
    assert facts["versions"]["torch"] == version("torch")
    assert facts["versions"]["mujoco"] == version("mujoco")


def test_package_that_is_not_installed(monkeypatch):
    monkeypatch.setattr(runs, "PACKAGES", ("torch", "no-such-package"))
    versions = environment_facts([])["versions"]
    assert versions == {"torch": version("torch"), "no-such-package": "not installed"}


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))


def test_two_runs_do_not_write_one_folder(tmp_path):
    run = RunFolder.create(tmp_path / "run", {})
    with run.locked():
        with pytest.raises(CheckpointError, match="another run is writing to .*run; wait"):
            with RunFolder.open(run.path).locked():
                raise AssertionError("both write")
    with run.locked():  # free again
        pass
