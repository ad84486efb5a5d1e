"""Batches of windows, against TorchRL's SliceSampler at the same length and batch."""

from __future__ import annotations

import argparse
from importlib.metadata import version

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import SliceSampler, TensorDictReplayBuffer, TensorStorage

from torchrl_rad import window_buffer

THREADS = 1
VERSIONS = {name: version(name) for name in ("torch", "torchrl", "tensordict", "torchrl_rad")}
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
EPISODE = 500  # steps


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), versions=VERSIONS)


@pytest.fixture(scope="module", params=[10_000, 100_000, 1_000_000], ids=["10k", "100k", "1M"])
def steps(request) -> TensorDict:
    """What a training reads of PointMaze data: whole episodes [rows]."""
    rows = request.param
    done = torch.zeros(rows, 1, dtype=torch.bool, device=DEVICE)
    done[EPISODE - 1 :: EPISODE] = True
    state = torch.randn(rows, 4, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    following = {
        "observation": state,
        "reward": state[:, :1],
        "done": done,
        "terminated": torch.zeros_like(done),
        "truncated": done,
    }
    columns = {
        "observation": state,
        "action": state[:, :2],
        "episode": torch.arange(rows, device=DEVICE) // EPISODE,
        "next": following,
    }
    return TensorDict(columns, [rows])


def rad(steps: TensorDictBase, length: int, batch: int) -> TensorDictReplayBuffer:
    return window_buffer(steps, length, batch)


def slices(steps: TensorDictBase, length: int, batch: int, **options) -> TensorDictReplayBuffer:
    sampler = SliceSampler(slice_len=length, traj_key="episode", **options)
    storage = TensorStorage(steps)
    return TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=batch * length)


def cached_slices(steps: TensorDictBase, length: int, batch: int) -> TensorDictReplayBuffer:
    """The episodes' bounds are looked up once, as window_buffer does."""
    return slices(steps, length, batch, cache_values=True)


@pytest.mark.parametrize("buffer", [rad, slices, cached_slices], ids=lambda make: make.__name__)
@pytest.mark.parametrize("batch", [32, 128], ids="b{}".format)
@pytest.mark.parametrize("length", [33, 129], ids="h{}".format)
def test_rad_window_sampling_speed(benchmark, steps, buffer, length, batch):
    made = buffer(steps, length, batch)

    def sample():
        windows = made.sample().reshape(-1, length)
        if DEVICE.type == "cuda":  # a GPU works on while Python goes on
            torch.cuda.synchronize(DEVICE)
        return windows

    benchmark.extra_info.update(buffer=buffer.__name__, windows=batch)
    windows = benchmark.pedantic(sample, rounds=20, warmup_rounds=2)
    assert len(windows) == batch
    assert (windows["episode"] == windows["episode"][:, :1]).all()


def test_rad_window_starts_speed(benchmark, steps):
    """The first batch after the data changed looks for the episodes anew."""
    made = window_buffer(steps, 129, 128)

    benchmark.pedantic(made.sample, setup=made.storage._bump_mutation_revision, rounds=5)


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
