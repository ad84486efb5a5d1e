"""Neighbours and targets for states along recorded trajectories; filling and opening a database."""

from __future__ import annotations

import argparse
import gc
from itertools import cycle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, RetrievalTargetModule, ScanIndex

THREADS = 1
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
EPISODE = 500  # steps
BOX = 6.0  # side of the space walked in
STEP = 0.05  # of a walk, in each dim
ASIDE = 0.1  # distance of a query from the recorded state
DRIVEN = 64  # consecutive states asked for


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE))


def walks(rows: int, dims: int) -> torch.Tensor:
    """Recorded states [rows, dims]: random walks of EPISODE small steps, reflected by the box."""
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(rows // EPISODE, EPISODE, dims, generator=generator).mul_(STEP)
    states[:, 0] = BOX * torch.rand(rows // EPISODE, dims, generator=generator)
    states = states.cumsum(1).remainder_(2 * BOX)
    return states.sub_(BOX).abs_().neg_().add_(BOX).reshape(rows, dims)


def recorded(rows: int, dims: int) -> TensorDict:
    """Whole episodes [rows], rewarded in one corner of the box."""
    state = walks(rows, dims).to(DEVICE)
    done = torch.zeros(rows, 1, dtype=torch.bool, device=DEVICE)
    done[EPISODE - 1 :: EPISODE] = True
    reward = (state[:, :2].amax(-1, keepdim=True) < 0.5).float()
    return TensorDict({"observation": state, "next": {"reward": reward, "done": done}}, [rows])


def empty_database(rows: int) -> ExpertDatabase:
    sampler = RetrievalSampler("euclidean", threshold=0.8, backend="auto")
    return ExpertDatabase(LazyTensorStorage(rows, device=DEVICE), gamma=0.97, sampler=sampler)


@pytest.fixture(scope="module", params=[10_000, 100_000, 1_000_000], ids=["10k", "100k", "1M"])
def rows(request):
    return request.param


@pytest.fixture(scope="module", params=[2, 17, 29], ids="{}d".format)
def dims(request):
    return request.param


@pytest.fixture(scope="module")
def database(rows, dims):
    """One at a time: the next one is made when no test needs this one any more."""
    database = empty_database(rows)
    database.extend(recorded(rows, dims))
    yield database
    gc.collect()  # a buffer and its storage refer to each other


def driven(database: ExpertDatabase, queries: int) -> cycle:
    """Endless consecutive states [queries, S], each beside a recorded episode."""
    generator = torch.Generator().manual_seed(1)
    last = len(database) - DRIVEN
    begin = torch.linspace(0, last, queries).long() // EPISODE * EPISODE
    index = begin + torch.arange(DRIVEN)[:, None]
    aside = torch.randn(*index.shape, database.width, generator=generator)
    aside = ASIDE * torch.nn.functional.normalize(aside, dim=-1)
    return cycle((database[:]["observation"][index.to(DEVICE)] + aside.to(DEVICE)).unbind(0))


def finished(result):
    """A GPU works on while Python goes on."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
    return result


def run(benchmark, call, database: ExpertDatabase, queries: int):
    """Many rounds of a quick call, one of the slowest; gives the result of the last one."""
    index = database.sampler.build(database.storage)
    benchmark.extra_info["index"] = type(index).__name__
    # a tree looks at few rows, a scan at all of them
    entries = len(database) * database.width * queries if isinstance(index, ScanIndex) else 0
    rounds = max(1, min(50, 100_000_000 // max(1, entries)))
    return benchmark.pedantic(lambda: finished(call()), rounds=rounds, warmup_rounds=rounds // 10)


sizes = [
    pytest.mark.parametrize("k", [6, 500], ids="k{}".format),
    pytest.mark.parametrize("queries", [1, 50], ids="q{}".format),
    pytest.mark.timeout(1200),  # the longest scan: 1M rows, 29 dims, 50 queries
]


def with_sizes(function):
    for mark in sizes:
        function = mark(function)
    return function


@with_sizes
def test_rad_search_speed(benchmark, database, k, queries):
    sampler, storage = database.sampler, database.storage
    sampler.k = k
    states = driven(database, queries)
    _, info = run(benchmark, lambda: sampler.search(storage, next(states)), database, queries)
    benchmark.extra_info["neighbours"] = float(info["valid"].sum(-1).float().mean())


@with_sizes
@pytest.mark.parametrize("rule", ["highest", "followed"])
def test_rad_target_speed(benchmark, database, k, queries, rule):
    database.sampler.k = k
    states = driven(database, queries)
    select = RetrievalTargetModule(database, horizon=129, rule=rule, ahead=16)
    select(TensorDict({"observation": next(states)[:1]}, [1]))  # makes the columns of the rule

    def target():
        return select(TensorDict({"observation": next(states)}, [queries]))

    found = run(benchmark, target, database, queries)["found"]
    assert found.all()  # without neighbours there is little to do


def test_rad_database_extend_speed(benchmark, rows, dims):
    steps = recorded(rows, dims)

    def fresh():
        gc.collect()  # that of the round before
        return (empty_database(rows), steps), {}

    benchmark.pedantic(lambda d, s: finished(d.extend(s)), setup=fresh, rounds=3)
    benchmark.extra_info["megabytes"] = round(steps.bytes() / 1e6, 1)


def test_rad_index_build_speed(benchmark, database):
    def forget():
        database.sampler.invalidate()
        return (database.storage,), {}

    build = database.sampler.build
    benchmark.pedantic(lambda storage: finished(build(storage)), setup=forget, rounds=3)


@pytest.mark.parametrize("memmap", [False, True], ids=["copied", "memmap"])
def test_rad_database_load_speed(benchmark, database, memmap, tmp_path):
    database.dumps(tmp_path / "database")
    benchmark.pedantic(ExpertDatabase.loads, (tmp_path / "database",), {"memmap": memmap}, rounds=3)


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
