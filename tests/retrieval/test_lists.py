from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.retrieval import ScanIndex, lists, search
from torchrl_rad.retrieval.lists import LONGEST_PAUSE, ListIndex

from ..oracle import ranking

pytestmark = pytest.mark.usefixtures("compared_in")

METRICS = ["euclidean", "cosine"]


@pytest.fixture
def small_lists(monkeypatch):
    """Lists also of few rows."""
    monkeypatch.setattr(lists, "SHARE", 2)
    monkeypatch.setattr(lists, "ENOUGH", 2)


def walks(episodes=20, length=50, width=5, step=0.05, seed=0):
    generator = torch.Generator().manual_seed(seed)
    states = step * torch.randn(episodes, length, width, generator=generator)
    states[:, 0] = 2 * torch.rand(episodes, width, generator=generator) - 1
    return states.cumsum(1)


def assert_equal(index, query, k):
    """As a scan finds them, which tests/retrieval/test_search.py holds against brute force."""
    near, row = index.search(query, k)
    expected_near, expected_row = ScanIndex(index.rows, index.metric).search(query, k)
    assert torch.equal(near, expected_near) and torch.equal(row, expected_row)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("k", [1, 7, 40])
@pytest.mark.parametrize("batch", [1, 4])
def test_rollouts(small_lists, metric, k, batch):
    states = walks()
    index = ListIndex(ScanIndex(states.flatten(0, 1), metric))
    for step in range(states.shape[1]):
        assert_equal(index, states[:batch, step] + 0.01, k)
    # most answers came from lists: each query that has none costs a search, or two
    assert index.searches < states.shape[1] * batch / 2


# few values: many ties and duplicates; fine: distances that differ in the last bits only
coarse = st.integers(-2, 2).map(float)
fine = st.floats(-(2.0**-23), 2.0**-23, width=32) | st.floats(-3, 3, width=32)
large = st.floats(-(2.0**40), 2.0**40, width=32)
huge = st.floats(width=32, allow_nan=False, allow_infinity=False)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize(
    "values", [coarse, fine, large, huge], ids=["coarse", "fine", "large", "huge"]
)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_sequence_of_queries(metric, values, data):
    """Steps of any size, some of them none, over rows with ties, against brute force."""
    width = data.draw(st.integers(1, 3))
    state = st.lists(values, min_size=width, max_size=width)
    rows = torch.tensor(data.draw(st.lists(state, min_size=8, max_size=30)))
    k = data.draw(st.integers(1, 3))
    batch = data.draw(st.integers(1, 2))
    index = ListIndex(ScanIndex(rows, metric))
    query = torch.tensor([data.draw(state) for _ in range(batch)], dtype=torch.float64)
    short = mock.patch.multiple(lists, SHARE=1, ENOUGH=2)
    with short, mock.patch.object(search, "SPARE", 0):
        for _ in range(6):
            near, row = index.search(query, k)
            for q, n, r in zip(query.tolist(), near.tolist(), row.tolist(), strict=True):
                best = ranking(q, rows.tolist(), metric)[:k]
                assert r == [i for _, i in best] and n == [s for s, _ in best]
            scale = data.draw(st.sampled_from([0.0, 1e-9, 1e-3, 1.0]))
            move = torch.tensor([data.draw(state) for _ in range(batch)], dtype=torch.float64)
            query = (query + scale * move).clamp(-3e38, 3e38)


@pytest.mark.parametrize("metric", METRICS)
def test_a_row_just_outside_the_list(small_lists, metric):
    """What comes nearest next lies right behind the last entry of a list."""
    angle = torch.linspace(0, 3, 64, dtype=torch.float64)
    rows = torch.stack([angle.cos(), angle.sin()], -1).float()
    index = ListIndex(ScanIndex(rows, metric))
    for turn in torch.linspace(0, 3, 300, dtype=torch.float64):
        assert_equal(index, torch.stack([turn.cos(), turn.sin()])[None], 3)


def test_searches_are_counted(small_lists):
    rows = torch.arange(100.0)[:, None]
    index = ListIndex(ScanIndex(rows, "euclidean"))
    for state in (50.0, 52.0, 55.0, 58.0, 60.0):
        index.search(torch.tensor([[state]]), 3)
    assert index.searches == 1  # 50 rows, 25 on either side
    index.search(torch.tensor([[80.0]]), 3)
    assert index.searches == 2 and index.pause == 0
    index.search(torch.tensor([[84.0]]), 3)
    assert index.searches == 2
    index.search(torch.tensor([[40.0]]), 3)
    assert index.searches == 3 and index.pause == 1  # that list lasted for two searches only


def test_useless_lists_are_not_made_for_some_time(small_lists):
    rows = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    index = ListIndex(ScanIndex(rows, "euclidean"))
    made = []
    index._made = lambda *args, make=index._made: made.append(None) or make(*args)
    far = torch.eye(3)
    for jump in range(400):
        assert_equal(index, 3 * far[jump % 3, None] * (-1) ** jump, 5)
    assert len(made) < 16 and index.pause == LONGEST_PAUSE
    for _ in range(2 * LONGEST_PAUSE):
        assert_equal(index, torch.zeros(1, 3), 5)
    assert len(made) < 18 and index.lists.served.item() > 1  # a new one, and it serves


def test_another_batch_size_starts_anew(small_lists):
    states = walks()
    index = ListIndex(ScanIndex(states.flatten(0, 1), "euclidean"))
    for batch in (1, 3, 3, 1, 2, 0, 3):
        assert_equal(index, states[:batch, 20], 5)


def test_zero_queries_and_rows(small_lists):
    rows = torch.cat([torch.zeros(30, 2), torch.randn(34, 2)])
    index = ListIndex(ScanIndex(rows, "cosine"))
    for query in ([1.0, 0.0], [0.0, 0.0], [0.0, 1.0]):
        assert_equal(index, torch.tensor([query]), 4)


def test_lists_stay_small():
    index = ListIndex(ScanIndex(torch.randn(100_000, 20), "euclidean"))
    for batch in (1, 10):
        index.search(torch.zeros(batch, 20), 5)
        assert index.lists.place.numel() <= lists.LIST_ENTRIES
        assert index.lists.row.shape[1] <= 100_000 // lists.SHARE
