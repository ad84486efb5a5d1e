import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.retrieval import ScanIndex, TreeIndex
from torchrl_rad.retrieval.choice import Candidates, choose
from torchrl_rad.retrieval.lists import ListIndex


def by_hand(score, error=1e-9, rank=(7, 0, 9, 5, 1), rows=(4, 0, 2), threshold=0.0, k=2):
    score = torch.tensor([score], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    found = Candidates(score, torch.tensor([rows]), error * one, 0 * one)
    row, sure = choose(found, torch.tensor(rank), threshold, "euclidean", k)
    return (row.item() if sure else None), sure.item()


def test_the_highest_rank_among_k():
    assert by_hand([-0.1, -0.2, -0.3]) == (0, True)  # row 2, of rank 9, comes third
    assert by_hand([-0.1, -0.2, -0.3], k=1) == (4, True)


def test_of_equals_the_most_similar():
    assert by_hand([-0.1, -0.2, -0.3], rank=[3, 0, 9, 0, 3]) == (4, True)


@pytest.mark.parametrize(
    "score, options",
    [
        ([-0.1, -0.2, -0.2], {}),  # which one is the second?
        ([-0.1, -0.2, -0.2001], {"error": 1e-3}),
        ([-0.1, -0.1, -0.3], {"rank": [3, 0, 9, 0, 3]}),  # which of these two is nearer?
        ([-0.1, -0.125, -0.3], {"threshold": 2 / 3}),  # -d^2 / 2 at the threshold: -0.125
        ([-0.2, -0.3, -0.4], {"threshold": 2 / 3}),  # none
        ([-0.1, -0.2], {"rows": (4, 0)}),  # k of five, and nothing about the others
    ],
)
def test_doubt(score, options):
    assert by_hand(score, **options) == (None, False)


def test_the_threshold():
    assert by_hand([-0.1, -0.13, -0.3], threshold=2 / 3) == (4, True)
    assert by_hand([-0.1, -0.12, -0.3], threshold=2 / 3) == (0, True)


coarse = st.integers(-2, 2).map(float)
fine = st.floats(-(2.0**-23), 2.0**-23, width=32) | st.floats(-3, 3, width=32)


@pytest.mark.parametrize("kind", ["scan", "lists", "tree"])
@pytest.mark.parametrize("values", [coarse, fine], ids=["coarse", "fine"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_what_is_sure_is_right(kind, values, data):
    width = data.draw(st.integers(1, 3))
    state = st.lists(values, min_size=width, max_size=width)
    rows = torch.tensor(data.draw(st.lists(state, min_size=2, max_size=25)))
    query = torch.tensor(data.draw(st.lists(state, min_size=1, max_size=4))).double()
    ranks = st.lists(st.integers(0, 4), min_size=len(rows), max_size=len(rows))
    rank = torch.tensor(data.draw(ranks))
    k = data.draw(st.integers(1, len(rows)))
    metric = "euclidean" if kind == "tree" else data.draw(st.sampled_from(["euclidean", "cosine"]))
    threshold = data.draw(st.sampled_from([0.0, 0.5, 0.8]))
    index = TreeIndex(rows) if kind == "tree" else ScanIndex(rows, metric)
    if kind == "lists":
        index = ListIndex(index)
    found = index.candidates(query, k)
    row, sure = choose(found, rank, threshold, metric, k)
    near, order = index.search(query, k)
    for i in range(len(query)):
        if sure[i]:
            valid = [(r, s) for r, s in zip(order[i].tolist(), near[i].tolist(), strict=True)]
            valid = [(r, s) for r, s in valid if s >= threshold]
            best = max(int(rank[r]) for r, _ in valid)
            assert row[i] == next(r for r, _ in valid if rank[r] == best)


def test_most_answers_are_sure():
    generator = torch.Generator().manual_seed(0)
    rows, query = (torch.randn(n, 6, generator=generator) for n in (5000, 64))
    rank = torch.randperm(5000, generator=generator)
    for index in (ScanIndex(rows, "euclidean"), ScanIndex(rows, "cosine"), TreeIndex(rows)):
        found = index.candidates(query, 50)
        _, sure = choose(found, rank, 0.1, index.metric, 50)
        assert sure.float().mean() > 0.9


@pytest.mark.parametrize("size", [1e160, 1e300])
def test_a_query_too_far_for_the_tree_is_doubtful(size):
    found = TreeIndex(torch.randn(9, 2)).candidates(
        torch.full((1, 2), size, dtype=torch.float64), 3
    )
    _, sure = choose(found, torch.arange(9), 0.0, "euclidean", 3)
    assert not sure.any()
