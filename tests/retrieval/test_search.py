from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.retrieval import ScanIndex, TreeIndex, search, similarity
from torchrl_rad.retrieval.backends import build_index
from torchrl_rad.retrieval.lists import ListIndex

from ..oracle import ranking

pytestmark = pytest.mark.usefixtures("compared_in")

BACKENDS = [("scan", "euclidean"), ("scan", "cosine"), ("tree", "euclidean")]
both = pytest.mark.parametrize("backend, metric", BACKENDS)

# coarse: many ties and duplicates; fine: distances that differ in the last bits only
coarse = st.integers(-2, 2).map(float)
fine = st.floats(-(2.0**-23), 2.0**-23, width=32) | st.floats(-3, 3, width=32)
large = st.floats(-(2.0**40), 2.0**40, width=32)


def expected(query, rows, metric, k):
    ranked = [ranking(q, rows.tolist(), metric)[:k] for q in query.double().tolist()]
    similar = torch.tensor([[s for s, _ in r] for r in ranked], dtype=torch.float64)
    return similar, torch.tensor([[i for _, i in r] for r in ranked])


def assert_exact(index, query, rows, metric, k):
    near, found = index.search(query, k)
    similar, order = expected(query, rows, metric, k)
    assert found.tolist() == order.tolist()
    assert near.dtype == torch.float64 and near.tolist() == similar.tolist()


@both
@pytest.mark.parametrize("values", [coarse, fine, large], ids=["coarse", "fine", "large"])
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_equals_brute_force(backend, metric, values, data):
    width = data.draw(st.integers(1, 3))
    state = st.lists(values, min_size=width, max_size=width)
    rows = torch.tensor(data.draw(st.lists(state, min_size=1, max_size=25)))
    query = torch.tensor(data.draw(st.lists(state, min_size=1, max_size=4)))
    k = data.draw(st.integers(1, len(rows)))
    with mock.patch.object(search, "SPARE", data.draw(st.sampled_from([0, 1, 32]))):
        assert_exact(build_index(rows, metric, backend, k), query, rows, metric, k)


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("entries", [1, 7, 20, 64])
def test_chunk_borders(metric, entries, monkeypatch):
    monkeypatch.setattr(search, "SCAN_ENTRIES", entries)
    monkeypatch.setattr(search, "SPARE", 1)
    rows = torch.randint(-2, 3, (33, 2), generator=torch.Generator().manual_seed(1)).float()
    query = torch.tensor([[0.5, 0.5], [1.0, 0.0], [-2.0, 2.0]])
    for k in (1, 2, 5, 33):
        assert_exact(ScanIndex(rows, metric), query, rows, metric, k)


def test_ties_across_chunks_keep_the_lower_rows(monkeypatch):
    monkeypatch.setattr(search, "SCAN_ENTRIES", 3)
    monkeypatch.setattr(search, "SPARE", 1)
    rows = torch.ones(10, 1)
    assert ScanIndex(rows, "euclidean").search(torch.zeros(1, 1), 4)[1].tolist() == [[0, 1, 2, 3]]


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("far", [0.0, 1e4], ids=["centred", "far from zero"])
@pytest.mark.parametrize("precision", ["highest", "medium"])
def test_scan_of_many_dims(metric, far, precision, monkeypatch):
    # what float32 cannot tell apart: rows differ in digits that their products do not hold
    monkeypatch.setattr(search, "SCAN_ENTRIES", 500)
    generator = torch.Generator().manual_seed(0)
    rows = far + torch.randn(300, 17, generator=generator)
    rows = torch.cat([rows, rows + 1e-3 * torch.randn(300, 17, generator=generator)])
    query = rows[:3] + 0.1
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        with torch.autocast("cpu", torch.bfloat16):
            assert_exact(ScanIndex(rows, metric), query, rows, metric, 40)
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_scan_beyond_the_range_of_float32(metric, scale):
    generator = torch.Generator().manual_seed(0)
    rows = scale * torch.randn(200, 3, generator=generator)
    rows[7] = 0.0
    for query in (rows[:2] * 1.1, torch.zeros(1, 3), torch.full((1, 3), 1e30)):
        assert_exact(ScanIndex(rows, metric), query, rows, metric, 5)
        one = torch.randn(200, 3, generator=generator)
        assert_exact(ScanIndex(one, metric), query, one, metric, 5)


def test_scan_copies_no_rows(monkeypatch):
    monkeypatch.setattr(search, "FEW_ENTRIES", 0)
    rows = torch.randn(20, 3)
    for metric in ("euclidean", "cosine"):
        assert ScanIndex(rows, metric).factors.data_ptr() == rows.data_ptr()


def test_scan_looks_at_few_rows_twice(monkeypatch):
    # the proof holds for rows in general position, and cannot where rows beyond the spare ones tie
    second, above = [], ScanIndex._above
    monkeypatch.setattr(ScanIndex, "_above", lambda *args: second.append(1) or above(*args))
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(5000, 29, generator=generator)
    for metric in ("euclidean", "cosine"):
        ScanIndex(rows, metric).search(rows[:8] + 0.01, 50)
        assert len(second) == 0
        ScanIndex(rows[:1].expand(5000, 29), metric).search(rows[:8] + 0.01, 50)
        assert len(second) == 8
        second.clear()


def test_tree_ties_at_the_last_place():
    # eight rows at distance 1; the three lowest are kept, and row 8, which is nearer
    circle = [[1, 0], [0, 1], [-1, 0], [0, -1]]
    rows = torch.tensor(circle + circle + [[0.0, 0.5]])
    assert TreeIndex(rows).search(torch.zeros(1, 2), 4)[1].tolist() == [[8, 0, 1, 2]]


def test_tree_ties_of_many_duplicates():
    rows = torch.zeros(3000, 2)
    found = TreeIndex(rows).search(torch.full((2, 2), 0.1), 100)[1]
    assert found.tolist() == [list(range(100))] * 2


def test_distances_lost_in_the_similarity_are_ties():
    # 1 + 1e-20 is 1: all are equally similar, so that the lower rows win
    rows = torch.tensor([[3e-20], [2e-20], [1e-20], [0.0]])
    for index in (TreeIndex(rows), ScanIndex(rows, "euclidean")):
        near, found = index.search(torch.zeros(1, 1), 2)
        assert near.tolist() == [[1.0, 1.0]] and found.tolist() == [[0, 1]]


def test_too_far_for_a_distance():
    rows = torch.tensor([[0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    query = torch.full((1, 2), 1e300, dtype=torch.float64)
    for index in (TreeIndex(rows), ScanIndex(rows, "euclidean")):
        near, found = index.search(query, 2)
        assert near.tolist() == [[0.0, 0.0]] and found.tolist() == [[0, 1]]


@both
def test_one_row(backend, metric):
    index = build_index(torch.tensor([[3.0, 4.0]]), metric, backend, 1)
    near, found = index.search(torch.tensor([[3.0, 4.0], [6.0, 8.0]]), 1)
    assert found.tolist() == [[0], [0]]
    assert near.tolist() == ([[1.0], [1.0]] if metric == "cosine" else [[1.0], [1 / 6]])


@both
def test_batch_of_one_equals_batch_of_many(backend, metric):
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(500, 3, generator=generator)
    query = torch.randn(37, 3, generator=generator)
    index = build_index(rows, metric, backend, 50)
    near, found = index.search(query, 50)
    for number in range(len(query)):
        alone, place = index.search(query[number : number + 1], 50)
        assert torch.equal(alone[0], near[number]) and torch.equal(place[0], found[number])


def test_scan_equals_tree_on_wide_rows():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(300, 9, generator=generator)
    query = torch.randn(5, 9, generator=generator)
    scan, tree = ScanIndex(rows, "euclidean").search(query, 20), TreeIndex(rows).search(query, 20)
    assert torch.equal(scan[0], tree[0]) and torch.equal(scan[1], tree[1])


def test_similarity_by_hand():
    rows = torch.tensor([[3.0, 4.0], [0.0, 0.0], [-3.0, -4.0], [4.0, -3.0]])
    cosine = similarity(torch.tensor([6.0, 8.0]), rows, "cosine")
    assert cosine.tolist() == [1.0, -torch.inf, -1.0, 0.0]
    assert similarity(torch.zeros(2), rows, "cosine").tolist() == [-torch.inf] * 4
    near = similarity(torch.zeros(2), rows, "euclidean")
    assert near.tolist() == [1 / 6, 1.0, 1 / 6, 1 / 6]
    # the thresholds of the paper as distances: 0.8 is 0.25
    assert similarity(torch.zeros(1), torch.tensor([0.25]), "euclidean").item() == 0.8


def test_zero_vectors_come_last_for_cosine():
    rows = torch.tensor([[0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]])
    near, found = ScanIndex(rows, "cosine").search(torch.tensor([[2.0, 0.0]]), 3)
    assert found.tolist() == [[2, 1, 0]] and near.tolist() == [[1.0, -1.0, -torch.inf]]


def test_auto_takes_the_tree_for_few_dims_only():
    assert isinstance(build_index(torch.zeros(4, 3), "euclidean", "auto", 1), TreeIndex)
    assert isinstance(build_index(torch.zeros(4, 4), "euclidean", "auto", 1), ListIndex)
    assert isinstance(build_index(torch.zeros(4, 2), "cosine", "auto", 1), ListIndex)
    assert isinstance(build_index(torch.zeros(4, 4), "euclidean", "scan", 1), ScanIndex)
    assert isinstance(build_index(torch.zeros(4, 9), "euclidean", "tree", 1), TreeIndex)


def test_tree_needs_a_euclidean_metric():
    with pytest.raises(ValueError, match="backend='tree' needs metric='euclidean'.*'cosine'"):
        build_index(torch.zeros(4, 2), "cosine", "tree", 1)


def test_tree_needs_the_cpu():
    with pytest.raises(ValueError, match="rows on the CPU.*on meta.*backend='scan'"):
        build_index(torch.zeros(4, 2, device="meta"), "euclidean", "tree", 1)


def test_rows_are_not_changed():
    rows = torch.randn(20, 2)
    before = rows.clone()
    TreeIndex(rows).search(torch.zeros(1, 2), 3)
    ScanIndex(rows, "cosine").search(torch.ones(1, 2), 3)
    np.testing.assert_array_equal(rows, before)
