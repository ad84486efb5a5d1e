"""Neighbours and targets for states along recorded trajectories, against a plain scan of all rows.

Percentiles are of consecutive calls, each with the next state of a trajectory.
"""

from __future__ import annotations

import argparse
import gc
from importlib.metadata import version
from itertools import cycle
from time import perf_counter

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import (
    ExpertDatabase,
    RetrievalSampler,
    RetrievalTargetModule,
    pointmaze_dataset,
)

THREADS = 1
VERSIONS = {name: version(name) for name in ("torch", "torchrl", "tensordict", "torchrl_rad")}
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
EPISODE = 500  # steps
BOX = 6.0  # side of the space walked in
STEP = 0.05  # of a walk, in each dim
ASIDE = 0.1  # distance of a driven trajectory from the recorded one
DRIVEN = 200  # consecutive states asked for
SECONDS = 3.0  # for the calls of one case; 10 at least


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), versions=VERSIONS)


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


def filled(steps: TensorDict, dims: list[int] | None = None) -> ExpertDatabase:
    sampler = RetrievalSampler("euclidean", dims, threshold=0.8, backend="auto")
    storage = LazyTensorStorage(len(steps), device=DEVICE)
    database = ExpertDatabase(storage, gamma=0.97, sampler=sampler)
    database.extend(steps)
    return database


@pytest.fixture(scope="module", params=[10_000, 100_000, 1_000_000], ids=["10k", "100k", "1M"])
def rows(request):
    return request.param


@pytest.fixture(scope="module", params=[2, 17, 29, 60], ids="{}d".format)
def dims(request):
    return request.param


@pytest.fixture(scope="module")
def database(rows, dims):
    """One at a time: the next one is made when no test needs this one any more."""
    yield filled(recorded(rows, dims))
    gc.collect()  # a buffer and its storage refer to each other


def beside(database: ExpertDatabase, queries: int) -> torch.Tensor:
    """Consecutive states [DRIVEN, queries, S], each trajectory a little aside of a recorded one."""
    generator = torch.Generator().manual_seed(1)
    begin = torch.linspace(0, len(database) - DRIVEN, queries).long()
    begin = begin - (begin % EPISODE - (EPISODE - DRIVEN)).clamp_min(0)  # within an episode
    index = begin + torch.arange(DRIVEN)[:, None]
    aside = torch.randn(queries, database.width, generator=generator)
    aside = ASIDE * torch.nn.functional.normalize(aside, dim=-1)
    return database[:]["observation"][index.to(DEVICE)] + aside.to(DEVICE)


def finished(result):
    """A GPU works on while Python goes on."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
    return result


def spent(call) -> float:
    """Milliseconds."""
    begin = perf_counter()
    finished(call())
    return 1e3 * (perf_counter() - begin)


def run(benchmark, call):
    """DRIVEN rounds of a quick call, fewer of a slow one; gives the result of the last one.

    The percentiles go into extra_info; the number of rounds is pytest-benchmark's.
    """
    call()  # what is made at the first call
    fits = int(1e3 * SECONDS / spent(call))
    rounds = max(10, min(DRIVEN, fits)) if benchmark.enabled else 1
    times = []

    def timed():
        begin = perf_counter()
        result = finished(call())
        times.append(1e3 * (perf_counter() - begin))
        return result

    result = benchmark.pedantic(timed, rounds=rounds)
    p50, p95 = np.percentile(times, [50, 95])
    benchmark.extra_info.update(p50_ms=float(p50), p95_ms=float(p95))
    return result


def run_beside_scan(benchmark, call, rows: torch.Tensor, states: torch.Tensor, k: int):
    """Also times what a search has to beat, before and after.

    That is a product with all rows and the k best of it, in float32, on states [T, Q, D].
    """
    offset = -rows.square().sum(-1) / 2  # from the product to the order of distances

    def scan(query):
        return spent(lambda: torch.addmm(offset, query, rows.T).topk(min(k, len(rows))))

    times = [scan(query) for query in states[:5]][1:]
    result = run(benchmark, call)
    times += [scan(query) for query in states[:5]][1:]
    plain_ms = float(np.median(times))
    ratio = plain_ms / benchmark.extra_info["p50_ms"]
    benchmark.extra_info.update(plain_scan_ms=plain_ms, ratio=ratio)
    return result


def cases(*marks):
    """Marks a test with all of them."""

    def mark(function):
        for one in (*marks, pytest.mark.timeout(1200)):  # the longest: 1M rows, 50 queries
            function = one(function)
        return function

    return mark


sizes = cases(
    pytest.mark.parametrize("k", [6, 500], ids="k{}".format),
    pytest.mark.parametrize("queries", [1, 50], ids="q{}".format),
)
rules = pytest.mark.parametrize("rule", ["highest", "followed"])


@sizes
def test_rad_search_speed(benchmark, database, k, queries):
    sampler, storage = database.sampler, database.storage
    sampler.k = k
    states = beside(database, queries)
    endless, rows = cycle(states), database[:]["observation"]

    def search():
        return sampler.search(storage, next(endless))

    _, info = run_beside_scan(benchmark, search, rows, states, k)
    index = type(sampler.build(storage)).__name__
    neighbours = float(info["valid"].sum(-1).float().mean())
    benchmark.extra_info.update(index=index, neighbours=neighbours)


def measure_target(benchmark, database, states, k, rule):
    """The whole target rule, asked for states [DRIVEN, Q, S] one after the other."""
    database.sampler.k = k
    select = RetrievalTargetModule(database, horizon=129, rule=rule, ahead=16)
    endless = cycle(states)

    def target():
        return select(TensorDict({"observation": next(endless)}, [states.shape[1]]))

    dims = list(database.sampler.dims or range(database.width))
    rows, compared = database[:]["observation"][:, dims].contiguous(), states[..., dims]
    targets = run_beside_scan(benchmark, target, rows, compared, k)
    assert targets["found"].all()  # without neighbours there is little to do


@sizes
@rules
def test_rad_target_speed(benchmark, database, k, queries, rule):
    measure_target(benchmark, database, beside(database, queries), k, rule)


@pytest.fixture(scope="module")
def replanned():
    """Episodes of PointMaze: a database of the first 80, and the states of 20 others."""
    steps = pointmaze_dataset("umaze", steps=30_000, progress=False).to(DEVICE)
    held, episodes = 24_000, 20
    others = steps["observation"][held:].unflatten(0, (episodes, -1))
    return filled(steps[:held], dims=[0, 1]), others


def along(others: torch.Tensor, queries: int) -> torch.Tensor:
    """Consecutive states [DRIVEN, queries, S] of the episodes; later ones if there are too few."""
    number = torch.arange(queries)
    begin = number // len(others) * 40
    return others[number % len(others), begin + torch.arange(DRIVEN)[:, None]]


@sizes
@rules
def test_rad_replan_speed(benchmark, replanned, k, queries, rule):
    """Along episodes that MuJoCo recorded and the database does not hold, searched by position."""
    database, others = replanned
    benchmark.extra_info["rows"] = len(database)
    measure_target(benchmark, database, along(others, queries), k, rule)


@pytest.mark.parametrize(
    "queries, goals", [(1, 1), (50, 1), (50, 50)], ids=["q1-g1", "q50-g1", "q50-g50"]
)
@rules
def test_rad_goal_speed(benchmark, replanned, queries, goals, rule):
    """Goals that rows bring along, beside the recorded returns, which need no look-up."""
    database, others = replanned
    database.sampler.k = 500
    places = others[:, ::10, :2].flatten(0, 1)  # recorded, so that somebody gets there
    goal = places[:: len(places) // goals][:goals].expand(queries, 2)
    settings = {"horizon": 129, "rule": rule, "ahead": 16}
    select = RetrievalTargetModule(database, goal_key="goal", **settings)
    plain = RetrievalTargetModule(database, **settings)
    endless = cycle(along(others, queries))

    def asked(module):
        return module(TensorDict({"observation": next(endless), "goal": goal}, [queries]))

    times = [spent(lambda: asked(plain)) for _ in range(21)][1:]
    found = run(benchmark, lambda: asked(select))["found"].float().mean()
    times += [spent(lambda: asked(plain)) for _ in range(20)]
    recorded_ms = float(np.median(times))
    added_ms = benchmark.extra_info["p50_ms"] - recorded_ms
    benchmark.extra_info.update(recorded_ms=recorded_ms, added_ms=added_ms, found=float(found))


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
