"""Filling, indexing, saving and opening a database, and what it takes of memory."""

from __future__ import annotations

import argparse
import gc
import shutil
from collections import deque
from importlib.metadata import version

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, RetrievalTargetModule

THREADS = 1
VERSIONS = {name: version(name) for name in ("torch", "torchrl", "tensordict", "torchrl_rad")}
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
EPISODE = 500  # steps
BOX = 6.0  # side of the space walked in
STEP = 0.05  # of a walk, in each dim
ASIDE = 0.01  # of a query from a recorded state, in each dim
NODE = 72  # bytes of a node of scipy's k-d tree, which Python does not see


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), versions=VERSIONS)


def recorded(rows: int, dims: int) -> TensorDict:
    """Random walks [rows] of EPISODE small steps, rewarded in one corner of their box."""
    generator = torch.Generator().manual_seed(0)
    walk = torch.randn(rows // EPISODE, EPISODE, dims, generator=generator).mul_(STEP)
    walk[:, 0] = BOX * torch.rand(rows // EPISODE, dims, generator=generator)
    state = walk.cumsum(1).remainder_(2 * BOX).sub_(BOX).abs_().neg_().add_(BOX)  # reflected
    state = state.reshape(rows, dims).to(DEVICE)
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


@pytest.fixture(scope="module", params=[2, 17, 29, 60], ids="{}d".format)
def dims(request):
    return request.param


@pytest.fixture(scope="module")
def database(rows, dims):
    """One at a time: the next one is made when no test needs this one any more."""
    database = empty_database(rows)
    database.extend(recorded(rows, dims))
    yield database
    gc.collect()  # a buffer and its storage refer to each other


@pytest.fixture(scope="module")
def saved(database, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "database"
    database.dumps(path)
    yield path
    shutil.rmtree(path)  # up to half a GB, which pytest would keep


def finished(result):
    """A GPU works on while Python goes on."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
    return result


def blocks(thing) -> dict[int, int]:
    """Address and bytes of each block of memory that a part of the library holds on to.

    Not those of the database that it refers to.
    """
    if isinstance(thing, torch.Tensor):
        storage = thing.untyped_storage()
        return {storage.data_ptr(): storage.nbytes()}
    if isinstance(thing, np.ndarray):
        while isinstance(thing.base, np.ndarray):
            thing = thing.base
        return {thing.ctypes.data: thing.nbytes}
    if isinstance(thing, cKDTree):
        return {id(thing): NODE * thing.size, **blocks([thing.indices, thing.data])}
    if isinstance(thing, dict):
        thing = list(thing.values())
    elif isinstance(thing, ExpertDatabase):
        thing = []
    elif type(thing).__module__.startswith("torchrl_rad") and hasattr(thing, "__dict__"):
        thing = list(vars(thing).values())
    held: dict[int, int] = {}
    for part in thing if isinstance(thing, (list, tuple, deque)) else []:
        for address, size in blocks(part).items():
            held[address] = max(size, held.get(address, 0))
    return held


def own_bytes(thing, database: ExpertDatabase) -> int:
    """Bytes that it holds beside the rows of the database."""
    shared = blocks(list(database[:].values(True, True)))
    return sum(size for address, size in blocks(thing).items() if address not in shared)


def queries(database: ExpertDatabase) -> torch.Tensor:
    """Consecutive states [64, S] beside an episode."""
    return database[:]["observation"][100:164] + ASIDE


def test_rad_database_extend_speed(benchmark, rows, dims):
    steps = recorded(rows, dims)

    def fresh():
        gc.collect()  # that of the round before
        return (empty_database(rows), steps), {}

    benchmark.pedantic(lambda d, s: finished(d.extend(s)), setup=fresh, rounds=3)
    benchmark.extra_info.update(timed="extend", megabytes=round(steps.bytes() / 1e6, 1))


def test_rad_index_build_speed(benchmark, database):
    """Also the memory of the structure and of the rule's columns, after queries along an episode.

    It is the search structure's own memory that is counted, not the rows, which it shares.
    """

    def forget():
        database.sampler.invalidate()
        return (database.storage,), {}

    build = database.sampler.build
    benchmark.pedantic(lambda storage: finished(build(storage)), setup=forget, rounds=3)
    select = RetrievalTargetModule(database)
    for state in queries(database):
        select(TensorDict({"observation": state[None]}, [1]))
    index = build(database.storage)
    payload, structure = database[:].bytes(), own_bytes(index, database)
    columns = own_bytes([index, select], database) - structure
    benchmark.extra_info.update(
        timed="index",
        index=type(index).__name__,
        payload_bytes=payload,
        index_bytes=structure,
        rule_bytes=columns,
        index_share=structure / payload,
    )


copied = pytest.mark.parametrize("memmap", [False, True], ids=["copied", "memmap"])


@copied
def test_rad_database_load_speed(benchmark, saved, memmap):
    benchmark.extra_info["timed"] = "load, memmap" if memmap else "load, copied"
    benchmark.pedantic(ExpertDatabase.loads, (saved,), {"memmap": memmap}, rounds=3)


@copied
def test_rad_first_answer_speed(benchmark, database, saved, memmap):
    """From a folder to the neighbours of a state: opening, reading, indexing, searching."""
    state = queries(database)[:1]
    benchmark.extra_info["timed"] = "first answer, memmap" if memmap else "first answer, copied"

    def answer():
        return finished(ExpertDatabase.loads(saved, memmap=memmap).retrieve(state))

    def forget():
        gc.collect()

    hits = benchmark.pedantic(answer, setup=forget, rounds=3)
    assert hits["valid"].any()


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
