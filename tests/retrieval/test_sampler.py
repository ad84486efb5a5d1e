import copy
import json
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer

from torchrl_rad import RetrievalSampler
from torchrl_rad.retrieval import search

from ..oracle import neighbours, ranking


def rows(states):
    return TensorDict({"observation": torch.as_tensor(states)}, [len(states)])


def buffer(states, storage=LazyTensorStorage, capacity=64, **settings):
    sampler = RetrievalSampler(**{"metric": "euclidean", "k": 3, "threshold": 0.0, **settings})
    made = TensorDictReplayBuffer(storage=storage(capacity), sampler=sampler)
    if len(states):
        made.extend(rows(states))
    return made


def found(made, query):
    return made.sampler.search(made.storage, torch.as_tensor(query))[0].tolist()


LINE = [[0.0], [1.0], [2.0], [3.0]]


# search


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("backend", ["auto", "scan"])
@pytest.mark.parametrize("dims", [None, [0], [2, 0]])
def test_equals_brute_force(storage, metric, backend, dims):
    generator = torch.Generator().manual_seed(3)
    states = torch.randint(-2, 3, (60, 3), generator=generator).float()  # many ties
    query = torch.randint(-2, 3, (9, 3), generator=generator).float()
    settings = {"metric": metric, "dims": dims, "k": 7, "threshold": 0.6}
    made = buffer(states, storage, backend=backend, **settings)
    index, info = made.sampler.search(made.storage, query)
    for number, state in enumerate(query.tolist()):
        near = neighbours(state, states.tolist(), **settings)
        count = len(near)
        assert index[number].tolist() == [i for _, i in near] + [-1] * (7 - count)
        assert info["valid"][number].tolist() == [True] * count + [False] * (7 - count)
        assert info["similarity"][number, :count].tolist() == pytest.approx([s for s, _ in near])


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("dims", [None, [1, 2]])
def test_normalize_measures_on_standardised_states(metric, dims):
    generator = torch.Generator().manual_seed(0)
    # entries of very different width, and a constant one whose mean is rounded
    scale = torch.tensor([1000.0, 1.0, 0.0, 0.01])
    states = torch.randn(40, 4, generator=generator) * scale + 0.1
    query = torch.randn(6, 4, generator=generator) * scale + 0.1
    made = buffer(states, metric=metric, normalize=True, dims=dims, k=5)
    index, near = made.sampler.nearest(made.storage, query)
    for number, state in enumerate(query.tolist()):
        ranked = ranking(state, states.tolist(), metric, dims, normalize=True)[:5]
        assert index[number].tolist() == [i for _, i in ranked]
        assert near[number].tolist() == pytest.approx([s for s, _ in ranked], rel=1e-9)


def test_constant_entries_do_not_blow_up():
    # the mean of ten times 0.1 is not 0.1 to the last bit
    states = torch.full((10, 2), 0.1, dtype=torch.float64)
    made = buffer(states, normalize=True)
    query = torch.tensor([[0.1, 0.1 + 1e-6]], dtype=torch.float64)
    assert made.sampler.nearest(made.storage, query)[1][0, 0] == pytest.approx(1.0, abs=1e-5)


def test_outputs():
    made = buffer(LINE, threshold=0.5)
    query = torch.tensor([[[1.75], [9.0]], [[0.0], [3.0]]])
    index, info = made.sampler.search(made.storage, query)
    assert index.tolist() == [[[2, 1, -1], [-1] * 3], [[0, 1, -1], [3, 2, -1]]]
    assert index.dtype == torch.int64
    assert info["similarity"].dtype == torch.float32 and info["valid"].dtype == torch.bool
    assert info["valid"].tolist() == (index >= 0).tolist()
    # given below the threshold, too: 1 / (1 + 6)
    assert info["similarity"][0, 1, 0].item() == pytest.approx(1 / 7)
    assert found(made, [0.4]) == [0, 1, -1]  # no batch at all


@pytest.mark.parametrize("backend", ["tree", "scan"])
@pytest.mark.parametrize("entries", [1, 50, 1000])
def test_many_queries_are_asked_in_parts(backend, entries, monkeypatch):
    states = torch.randn(70, 2, generator=torch.Generator().manual_seed(0)).round(decimals=1)
    made = buffer(states, backend=backend, k=9, capacity=70)
    rows, near = made.sampler.nearest(made.storage, states)
    monkeypatch.setattr(search, "SCAN_ENTRIES", entries)
    again, other = made.sampler.nearest(made.storage, states)
    assert torch.equal(rows, again) and torch.equal(near, other)


def test_threshold_counts_as_near_enough():
    made = buffer([[0.0], [0.25], [0.5]], threshold=0.8)
    assert found(made, [0.0]) == [0, 1, -1]


def test_more_neighbours_than_rows():
    made = buffer(LINE, k=6)
    index, info = made.sampler.search(made.storage, torch.tensor([[0.1]]))
    assert index.tolist() == [[0, 1, 2, 3, -1, -1]]
    assert info["similarity"][0, 4:].tolist() == [-torch.inf] * 2


def test_query_without_rows():
    made = buffer([])
    index, info = made.sampler.search(made.storage, torch.zeros(2, 5))
    assert index.tolist() == [[-1] * 3] * 2 and not info["valid"].any()
    assert info["similarity"].tolist() == [[-torch.inf] * 3] * 2


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("backend", ["tree", "scan"])
@pytest.mark.parametrize("dims", [None, [0]])
def test_query_with_nan_has_no_neighbour(bad, backend, dims):
    # also where the bad entry is not compared
    made = buffer([[0.0, 0.0], [1.0, 0.0]], backend=backend, dims=dims, k=2)
    index, info = made.sampler.search(made.storage, torch.tensor([[0.0, bad], [1.0, 0.0]]))
    assert index.tolist() == [[-1, -1], [1, 0]]
    assert info["similarity"][0].tolist() == [-torch.inf] * 2


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("normalize", [True, False])
def test_other_types_of_query(dtype, normalize):
    made = buffer(LINE, normalize=normalize)
    index, info = made.sampler.search(made.storage, torch.tensor([[1.75]], dtype=dtype))
    assert index.tolist() == [[2, 1, 3]] and info["similarity"].dtype == torch.float32


def test_float64_states_are_not_rounded():
    # in float32 both rows and the query are 1.0
    states = torch.tensor([[1.0], [1.0 + 1e-12]], dtype=torch.float64)
    made = buffer(states, k=1)
    assert found(made, torch.tensor([[1.0 + 2e-12]], dtype=torch.float64)) == [[1]]


@pytest.mark.parametrize("dims", [None, [0]])
def test_wrong_width(dims):
    made = buffer([[0.0, 0.0]], dims=dims)
    with pytest.raises(ValueError, match="the query has 3 entries, a state of the database 2"):
        made.sampler.search(made.storage, torch.zeros(1, 3))


def test_dims_beyond_the_state():
    made = buffer([[0.0, 0.0]], dims=[0, 2])
    with pytest.raises(ValueError, match=r"dims are \[0, 2\], but a state has 2 entries"):
        made.sampler.search(made.storage, torch.zeros(1, 2))


def test_nested_key():
    storage = LazyTensorStorage(4)
    storage.set(range(2), TensorDict({"a": {"b": torch.tensor([[0.0], [1.0]])}}, [2]))
    sampler = RetrievalSampler("euclidean", k=1, key=("a", "b"))
    assert sampler.search(storage, torch.tensor([[0.9]]))[0].tolist() == [[1]]


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"metric": "manhattan"}, "metric is 'manhattan'; expected 'cosine' or 'euclidean'"),
        ({"backend": "grid"}, "backend is 'grid'; expected one of"),
        ({"k": 0}, "k is 0; at least one neighbour"),
        ({"threshold": 1.01}, r"threshold is 1.01; .* lies in \[0, 1\]"),
        ({"threshold": -0.1}, r"threshold is -0.1; .* lies in \[0, 1\]"),
        ({"threshold": float("nan")}, "threshold is nan"),
        ({"dims": []}, r"dims are \[\]; expected places in a state"),
        ({"dims": [0, -1]}, r"dims are \[0, -1\]; expected places in a state"),
    ],
)
def test_wrong_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        RetrievalSampler(**settings)


def test_tree_refuses_cosine():
    made = buffer(LINE, metric="cosine", backend="tree")
    with pytest.raises(ValueError, match="backend='tree' needs metric='euclidean'"):
        found(made, [[1.0]])


# what changes in the storage


def extend(made):
    made.extend(rows([[8.9]]))


def write(made):
    made[0] = rows([[8.9]])[0]


def set_in_place(made):
    made.set_("observation", torch.tensor([[8.9], [1.0], [2.0], [3.0]]))


@pytest.mark.parametrize("change, row", [(extend, 4), (write, 0), (set_in_place, 0)])
def test_notices_changes(change, row):
    made = buffer(LINE)
    assert found(made, [9.0])[0] == 3
    change(made)
    assert found(made, [9.0])[0] == row


def test_empty_and_refilled():
    made = buffer(LINE)
    found(made, [9.0])
    made.empty()
    assert found(made, [9.0]) == [-1] * 3
    made.extend(rows([[7.0]]))
    assert found(made, [9.0]) == [0, -1, -1]


def test_writes_on_leaves_need_invalidate():
    made = buffer(LINE)
    found(made, [9.0])
    made.storage[:]["observation"][0] = 8.9
    assert found(made, [9.0])[0] == 3
    made.sampler.invalidate()
    assert found(made, [9.0])[0] == 0


def test_one_sampler_asked_about_two_storages():
    one, other = buffer(LINE), buffer([[3.0], [2.0], [1.0], [0.0]])
    assert one.sampler.search(one.storage, torch.tensor([0.1]))[0][0] == 0
    assert one.sampler.search(other.storage, torch.tensor([0.1]))[0][0] == 3


def test_build_makes_the_structure_once():
    made = buffer(LINE)
    first = made.sampler.build(made.storage)
    found(made, [1.0])
    assert made.sampler.build(made.storage) is first
    extend(made)
    assert made.sampler.build(made.storage) is not first


# TorchRL's contract


def test_sample_is_uniform_over_the_rows():
    made = buffer(LINE)
    torch.manual_seed(0)
    drawn = torch.cat([made.sample(400)["index"] for _ in range(5)])
    counts = drawn.bincount(minlength=4)
    assert len(counts) == 4 and (counts - 500).abs().max() < 100  # 5 deviations


def test_sample_uses_the_generator_of_the_buffer():
    def draws():
        made = buffer(LINE)
        made.set_rng(torch.Generator().manual_seed(7))
        return made.sample(20)["index"].tolist()

    assert draws() == draws()
    made = buffer(LINE)
    made.set_rng(torch.Generator().manual_seed(7))
    made.sampler.load_state_dict({**made.sampler.state_dict(), "k": 2})
    assert made.sample(20)["index"].tolist() == draws()  # settings are no reason to lose it


def test_sample_from_nothing():
    with pytest.raises(RuntimeError, match="the database is empty: extend it"):
        buffer([]).sampler.sample(LazyTensorStorage(3), 2)


SETTINGS = {
    "metric": "euclidean", "dims": [1], "k": 2, "threshold": 0.3, "normalize": True,
    "backend": "scan", "key": ("a", "b"),
}  # fmt: skip


def test_state_dict():
    sampler = RetrievalSampler(**SETTINGS)
    assert sampler.state_dict() == SETTINGS
    other = RetrievalSampler()
    other.load_state_dict(sampler.state_dict())
    assert other.config == SETTINGS
    with pytest.raises(ValueError, match="k is 0"):
        other.load_state_dict({**SETTINGS, "k": 0})


def test_state_dict_drops_what_was_built():
    made = buffer(LINE)
    assert found(made, [9.0]) == [3, 2, 1]
    made.sampler.load_state_dict({**made.sampler.config, "metric": "cosine"})
    assert found(made, [9.0]) == [1, 2, 3]  # all alike


def test_dumps_and_loads(tmp_path):
    sampler = RetrievalSampler(**SETTINGS)
    sampler.dumps(tmp_path / "new" / "folder")
    saved = json.loads((tmp_path / "new" / "folder" / "sampler.json").read_text())
    assert saved["k"] == 2
    other = RetrievalSampler()
    other.loads(tmp_path / "new" / "folder")
    assert other.config == SETTINGS  # a nested key as well


def test_buffer_dumps_and_loads(tmp_path):
    made = buffer(LINE, k=2)
    made.dumps(tmp_path)
    other = buffer([], k=3)
    other.loads(tmp_path)
    assert found(other, [9.0]) == [3, 2]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_hold_no_cache(duplicate):
    made = buffer(torch.zeros(5000, 2), capacity=5000, normalize=True)
    made.set_rng(torch.Generator().manual_seed(0))
    made.sampler.search(made.storage, torch.zeros(1, 2))
    assert len(pickle.dumps(made.sampler)) < 1000
    other = duplicate(made.sampler)
    assert other.config == made.sampler.config and other._index is None and other._rng is None
    query = torch.tensor([[0.0, 1.0]])
    assert torch.equal(
        other.search(made.storage, query)[0], made.sampler.search(made.storage, query)[0]
    )


def test_repr_names_the_settings():
    assert repr(RetrievalSampler("euclidean", k=7)).startswith(
        "RetrievalSampler(metric='euclidean', dims=None, k=7, threshold=0.8"
    )


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("rows_on, query_on", [("cuda", "cpu"), ("cpu", "cuda"), ("cuda", "cuda")])
def test_devices(rows_on, query_on):
    storage = LazyTensorStorage(4, device=rows_on)
    storage.set(range(4), rows(LINE).to(rows_on))
    sampler = RetrievalSampler("euclidean", k=2, threshold=0.0)
    index, info = sampler.search(storage, torch.tensor([[1.9]], device=query_on))
    assert index.tolist() == [[2, 1]]
    assert index.device.type == info["valid"].device.type == query_on
