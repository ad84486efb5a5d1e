"""Two processes train as one does."""

from __future__ import annotations

import csv
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad import DenoisingLoss, DiffuserLitePlanner, InverseDynamics, Normalizer
from torchrl_rad.objectives.step import draw_step_pairs
from torchrl_rad.parallel import (
    Share,
    draw_rows,
    drawing_for,
    first_before_others,
    first_decides,
    is_first,
    mean_over_processes,
    process_group,
    share_of_batch,
    wait_for_all,
    wanted_by_any,
)

TRAINER = """
import sys
import torch
from tensordict import TensorDict
from torchrl_rad import DenoisingLoss, DiffuserLitePlanner, InverseDynamics, Normalizer
from torchrl_rad import StepEstimationLoss, StepEstimator, draw_step_pairs
from torchrl_rad.checkpoint import Checkpointer
from torchrl_rad.parallel import is_first, process_group
from torchrl_rad.runs import MetricsLog
from torchrl_rad.training import Objective, train

out, until, steps, resume, batch = sys.argv[1], *map(int, sys.argv[2:])
torch.set_num_threads(1)
torch.manual_seed(0)
states = Normalizer.identity(2)
planner = DiffuserLitePlanner(states, InverseDynamics(states, states, 1), 9, (4, 1), width=16)
backbone = DiffuserLitePlanner(states, planner.inverse_dynamics, 9, (4, 1), width=16, targets=False)
pairs = lambda windows: draw_step_pairs(windows["observation"], pairs=2)
plain = lambda windows: windows
objectives = {
    "planner": Objective(DenoisingLoss(planner, delay=True), plain, 1e-2, steps, ema=0.9),
    # a level without gradients
    "backbone": Objective(DenoisingLoss(backbone, only=[0]), plain, 1e-2, steps),
    "estimator": Objective(StepEstimationLoss(StepEstimator(states, 9, 16)), pairs, 1e-2, steps),
}
sample = lambda: TensorDict({"observation": torch.randn(batch, 9, 2)}, [batch])
log = MetricsLog(out + "/metrics.csv")
try:
    with process_group("cpu"):
        torch.manual_seed(1)
        train(objectives, sample, until, Checkpointer(out + "/saved"), 2, 1, log.write, {},
              resume=bool(resume), begun=log.rewind, progress=False)
except ValueError as error:
    sys.exit(f"error: {error}")
"""


def run(folder: Path, processes: int, until: int, resume: bool = False, batch: int = 8):
    """Trains in so many new processes, or in this one; the result and the file of the losses."""
    folder.mkdir(exist_ok=True)
    script = folder / "trainer.py"
    script.write_text(TRAINER)
    arguments = [str(script), str(folder), str(until), "6", str(int(resume)), str(batch)]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]
    done = None
    if processes == 1:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", arguments)
            runpy.run_path(str(script))
    else:
        done = subprocess.run(
            [*torchrun, str(processes), *arguments],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=250,
        )
    return done, folder / "metrics.csv"


def losses(path: Path) -> list[dict[str, float]]:
    with open(path) as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def assert_same(one: list[dict[str, float]], other: list[dict[str, float]]) -> None:
    assert [row["step"] for row in one] == [row["step"] for row in other]
    for left, right in zip(one, other, strict=True):
        assert left == pytest.approx(right, rel=1e-4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    _, path = run(tmp_path_factory.mktemp("one"), 1, 6)
    return losses(path)


def test_two_processes_lose_what_one_does(alone, tmp_path):
    done, path = run(tmp_path, 2, 6)
    assert done.returncode == 0, done.stderr
    assert "find_unused_parameters" not in done.stderr
    assert len(alone) == 6
    assert alone[0] != pytest.approx(alone[-1])  # they do change
    assert_same(losses(path), alone)


def test_goes_on_with_one_process(alone, tmp_path):
    """Two processes stop at step 4; one goes on."""
    done, path = run(tmp_path, 2, 4)
    assert done.returncode == 0, done.stderr
    assert len(losses(path)) == 4
    run(tmp_path, 1, 6, resume=True)
    assert_same(losses(path), alone)


def test_a_batch_without_equal_parts(tmp_path):
    done, path = run(tmp_path, 2, 6, batch=7)
    assert done.returncode != 0
    assert "a batch of 7 has no equal parts for 2 processes" in done.stderr
    assert "replay_buffer.batch_size" in done.stderr
    assert not path.exists() or not losses(path)


# in one process


@given(st.integers(1, 4), st.integers(1, 5), st.integers(0, 3))
def test_shares_draw_what_the_whole_batch_draws(world, size, seed):
    def draw(rows):
        return torch.rand(rows, 2)

    torch.manual_seed(seed)
    whole, after = draw(world * size), torch.rand(1)
    for rank in range(world):
        torch.manual_seed(seed)
        with drawing_for(Share(rank, world)):
            part = draw_rows(draw, size)
        assert torch.equal(part, whole[rank * size : (rank + 1) * size])
        assert torch.equal(torch.rand(1), after)  # generators stay in step


def test_losses_of_shares_average_to_that_of_the_batch():
    states = Normalizer.identity(2)
    planner = DiffuserLitePlanner(states, InverseDynamics(states, states, 1), 9, (4, 1), width=16)
    for parameter in planner.networks.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    loss = DenoisingLoss(planner)
    batch = TensorDict({"observation": torch.randn(6, 9, 2)}, [6])
    torch.manual_seed(0)
    whole = loss(batch)["loss_denoising"]
    parts = []
    for rank in range(3):
        share = Share(rank, 3)
        torch.manual_seed(0)
        with drawing_for(share):
            parts.append(loss(share.of(batch))["loss_denoising"])
    assert torch.stack(parts).mean().item() == pytest.approx(whole.item(), rel=1e-5)
    assert parts[0].item() != pytest.approx(parts[1].item())


def test_pairs_of_shares_are_those_of_the_batch():
    windows = torch.randn(4, 9, 2)
    torch.manual_seed(0)
    whole = draw_step_pairs(windows, pairs=3)
    parts = []
    for rank in range(2):
        share = Share(rank, 2)
        torch.manual_seed(0)
        with drawing_for(share):
            parts.append(draw_step_pairs(share.of(windows), pairs=3))
    assert (torch.cat(parts) == whole).all()


def test_alone_there_is_nothing_to_share(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with process_group("cpu") as device:
        assert device == "cpu" and not torch.distributed.is_initialized()
    assert share_of_batch() == Share(0, 1) and is_first()
    assert first_decides(lambda: 3) == 3 and first_before_others(lambda: 4) == 4
    assert wanted_by_any(True) is True and wanted_by_any(False) is False
    assert mean_over_processes({"a": 0.5}) == {"a": 0.5}
    wait_for_all()


def test_fewer_gpus_than_processes(monkeypatch):
    for name, value in (("WORLD_SIZE", "4"), ("LOCAL_RANK", "0"), ("LOCAL_WORLD_SIZE", "4")):
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(ValueError, match="started 4 processes .* sees 2 GPUs"):
        with process_group("cuda"):
            pass


def test_no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="sees no GPU; use device=cpu"):
        with process_group("cuda"):
            pass
