import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.retrieval.backends import build_index, grow_index
from torchrl_rad.retrieval.choice import choose
from torchrl_rad.retrieval.joint import JointIndex

from ..oracle import ranking

pytestmark = pytest.mark.usefixtures("compared_in")

BACKENDS = [("scan", "euclidean"), ("scan", "cosine"), ("auto", "cosine"), ("tree", "euclidean")]
both = pytest.mark.parametrize("backend, metric", BACKENDS)

coarse = st.integers(-2, 2).map(float)  # many ties
fine = st.floats(-(2.0**-23), 2.0**-23, width=32) | st.floats(-3, 3, width=32)


def joint(rows, border, metric, backend, k):
    parts = (build_index(part, metric, backend, k) for part in (rows[:border], rows[border:]))
    return JointIndex(rows, *parts)


def assert_exact(index, query, k):
    near, row = index.search(query, k)
    for i, state in enumerate(query.double().tolist()):
        expected = ranking(state, index.rows.double().tolist(), index.metric)[:k]
        assert list(zip(near[i].tolist(), row[i].tolist(), strict=True)) == expected


@both
@pytest.mark.parametrize("entries", [coarse, fine], ids=["coarse", "fine"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_equals_brute_force(backend, metric, entries, data):
    width = data.draw(st.integers(1, 3))
    state = st.lists(entries, min_size=width, max_size=width)
    rows = torch.tensor(data.draw(st.lists(state, min_size=2, max_size=60)))
    border = data.draw(st.integers(1, len(rows) - 1))
    k = data.draw(st.integers(1, len(rows)))
    query = torch.tensor(data.draw(st.lists(state, min_size=1, max_size=4)))
    assert_exact(joint(rows, border, metric, backend, k), query, k)


@both
@pytest.mark.parametrize("border", [1, 40, 1960, 1999])
def test_equals_brute_force_on_many_rows(backend, metric, border):
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(2000, 3, generator=generator)
    query = torch.randn(4, 3, generator=generator)
    for k in (1, 39, 41, 200, 2000):
        assert_exact(joint(rows, border, metric, backend, k), query, k)


@both
def test_the_best_by_rank_is_that_of_all(backend, metric):
    generator = torch.Generator().manual_seed(0)
    rows, rank = torch.randn(500, 3, generator=generator), torch.randperm(500, generator=generator)
    query, sure = torch.randn(50, 3, generator=generator), 0
    index = joint(rows, 450, metric, backend, 20)
    row, beyond_doubt = choose(index.candidates(query, 20), rank, 0.0, metric, 20)
    for i, state in enumerate(query.double().tolist()):
        near = ranking(state, rows.double().tolist(), metric)[:20]
        near = [place for similar, place in near if similar >= 0.0]
        if beyond_doubt[i]:
            sure += 1
            assert row[i] == max(near, key=lambda place: rank[place])
    assert sure > 40


def test_far_away_queries():
    rows = torch.randn(60, 2, generator=torch.Generator().manual_seed(0))
    query = torch.tensor([[1e30, 0.0], [1e200, 1e200], [0.0, 0.0]], dtype=torch.float64)
    assert_exact(joint(rows, 50, "euclidean", "tree", 5), query, 5)


def test_rows_behind_are_a_fifth_at_most():
    rows = torch.randn(1000, 2, generator=torch.Generator().manual_seed(0))
    index = build_index(rows[:400], "euclidean", "auto", 5)
    for count in range(410, 1001, 10):
        index = grow_index(index, rows[:count], "euclidean", "auto", 5)
        assert len(index.rows) == count
        if isinstance(index, JointIndex):
            assert 5 * len(index.second.rows) < count
            assert_exact(index, rows[count - 1 : count], 5)
