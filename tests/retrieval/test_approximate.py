import builtins
import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, RetrievalTargetModule
from torchrl_rad.retrieval import ScanIndex, approximate
from torchrl_rad.retrieval.approximate import FaissIndex
from torchrl_rad.retrieval.backends import build_index

pytest.importorskip("faiss")
METRICS = ["euclidean", "cosine"]


def walks(episodes=60, length=100, width=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    states = 0.05 * torch.randn(episodes, length, width, generator=generator)
    states[:, 0] = 6 * torch.rand(episodes, width, generator=generator)
    return states.cumsum(1).flatten(0, 1)


def recall(index, query, k):
    """Share of the true neighbours found."""
    exact = ScanIndex(index.rows, index.metric).search(query, k)[1].tolist()
    found = index.search(query, k)[1].tolist()
    hits = [len(set(a) & set(b)) for a, b in zip(exact, found, strict=True)]
    return sum(hits) / (k * len(query))


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("k", [1, 50])
def test_neighbours_are_found(metric, k):
    rows = walks()
    index = FaissIndex(rows, metric, k)
    assert index.recall >= 0.99
    query = rows[::37] + 0.01
    assert recall(index, query.double(), k) >= 0.98
    near, row = index.search(query, k)
    assert near.dtype == torch.float64 and (near[:, 1:] <= near[:, :-1]).all()
    exact = ScanIndex(rows, metric).search(query.double(), k)[0]
    assert torch.equal(near[:, 0], exact[:, 0])  # similarities are not rounded
    assert (row >= 0).all() and all(len(set(r)) == k for r in row.tolist())


def test_a_low_recall_is_refused_with_its_figure(monkeypatch):
    monkeypatch.setattr(approximate, "MOST_PROBED", 10_000)  # one cell
    noise = torch.randn(4000, 20, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"faiss finds 0\.\d+ of the 100 nearest rows in 1 of 102"):
        FaissIndex(noise, "euclidean", 100)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("count", [1, 5, 60])
def test_few_rows(metric, count):
    rows = walks(1, count)
    near, row = FaissIndex(rows, metric, 500).search(rows[:1], count)
    assert sorted(row[0].tolist()) == list(range(count)) and near.shape == (1, count)


def test_cells_with_too_few_rows_are_no_answer():
    rows = walks()
    index = FaissIndex(rows, "euclidean", 1)
    index.index.nprobe = 1  # a cell holds some 20
    query = rows[:3].double()
    near, row = index.search(query, 500)
    expected = ScanIndex(rows, "euclidean").search(query, 500)
    assert torch.equal(near, expected[0]) and torch.equal(row, expected[1])


def test_the_same_every_time():
    first, second = (FaissIndex(walks(), "cosine", 9).search(walks()[5:50], 9) for _ in range(2))
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])


def make_database(**sampler):
    state = walks()
    done = torch.zeros(len(state), 1, dtype=torch.bool)
    done[99::100] = True
    reward = (state[:, :1] < 2).float()
    steps = {"observation": state, "next": {"reward": reward, "done": done}}
    options = {"metric": "euclidean", "k": 20, "threshold": 0.3, **sampler}
    sampler = RetrievalSampler(**options)
    database = ExpertDatabase(LazyTensorStorage(len(state)), gamma=0.97, sampler=sampler)
    database.extend(TensorDict(steps, [len(state)]))
    return database


@pytest.mark.parametrize("rule", ["highest", "followed"])
@pytest.mark.parametrize("options", [{}, {"dims": [1, 0]}, {"normalize": True}])
def test_targets_are_mostly_the_exact_ones(rule, options):
    td = TensorDict({"observation": walks()[50::31] + 0.01})
    td.auto_batch_size_(1)
    found, exact = (
        RetrievalTargetModule(make_database(backend=backend, **options), 33, rule)(td.clone())
        for backend in ("faiss", "scan")
    )
    assert exact["found"].any()
    same = found["target_index"] == exact["target_index"]
    assert same.double().mean() > 0.95
    assert torch.equal(found["similarity"][same], exact["similarity"][same])


def test_the_chosen_row_is_among_those_found():
    database = make_database(backend="faiss")
    rank = torch.randperm(len(database), generator=torch.Generator().manual_seed(0))
    query = walks()[::97] + 0.01
    rows, near = database.sampler.nearest(database.storage, query)
    row, _, hit = database.sampler.best(database.storage, query, rank)
    valid = near >= 0.3
    expected = rows.gather(-1, torch.where(valid, rank[rows], -1).argmax(-1, keepdim=True))[:, 0]
    assert torch.equal(hit, valid[:, 0]) and torch.equal(row[hit], expected[hit])


def test_copies_and_settings():
    database = make_database(backend="faiss")
    database.retrieve(walks()[:1])
    other = copy.deepcopy(database.sampler)
    assert other._index is None and other.config["backend"] == "faiss"


def test_without_the_package(monkeypatch):
    real = builtins.__import__

    def absent(name, *args, **kwargs):
        if name == "faiss":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ImportError, match=r'pip install "torchrl_rad\[faiss\]"'):
        build_index(torch.zeros(4, 2), "euclidean", "faiss", 1)


def test_rows_elsewhere():
    with pytest.raises(ValueError, match="needs rows on the CPU, got meta"):
        build_index(torch.zeros(4, 2, device="meta"), "euclidean", "faiss", 1)
