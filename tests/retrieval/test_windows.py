import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.retrieval.windows import WindowMax


def test_by_hand():
    table = WindowMax(torch.tensor([5.0, 1.0, 4.0, 4.0, 2.0]))
    low, high = torch.tensor([0, 1, 1, 4, 2]), torch.tensor([0, 1, 4, 4, 3])
    assert table.max(low, high).tolist() == [5.0, 1.0, 4.0, 2.0, 4.0]
    # the best of rows 1..4 is first met in row 2; within 2 of it as well; within 3 in row 1
    one, four, best = torch.tensor(1), torch.tensor(4), torch.tensor(4.0)
    assert [int(table.first(one, four, best, t)) for t in (0.0, 2.0, 3.0)] == [2, 2, 1]
    assert int(table.first(one, four, torch.tensor(9.0), 0.0)) == 5  # none: high + 1


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_brute_force(data):
    values = data.draw(st.lists(st.integers(-3, 3), min_size=1, max_size=40))
    longest = data.draw(st.integers(1, len(values)))
    table = WindowMax(torch.tensor(values, dtype=torch.float32), longest)
    windows = [
        (low, high)
        for low in range(len(values))
        for high in range(low, min(low + longest, len(values)))
    ]
    low, high = torch.tensor(windows).T
    best = [max(values[a : b + 1]) for a, b in windows]
    assert table.max(low, high).tolist() == best
    tolerance = data.draw(st.sampled_from([0.0, 1.0, 2.5]))
    wanted = data.draw(st.integers(0, 2))  # above the best: perhaps no row is near it
    first = table.first(low, high, torch.tensor(best) + wanted, tolerance)
    assert first.tolist() == [
        next((j for j in range(a, b + 1) if top + wanted - values[j] <= tolerance), b + 1)
        for (a, b), top in zip(windows, best, strict=True)
    ]


def test_shapes_follow_the_arguments():
    table = WindowMax(torch.arange(6.0))
    low = torch.tensor([[0, 1, 2], [3, 4, 5]])
    assert table.max(low, low).shape == (2, 3)
    assert table.first(low, low, table.max(low, low), 0.0).tolist() == low.tolist()


@pytest.mark.parametrize("tolerance, expected", [(0.1, 1), (0.09, 1), (0.11, 0)])
def test_difference_is_not_rounded(tolerance, expected):
    # float32(1.1) - 1 is 0.100000024: more than 0.1
    table = WindowMax(torch.tensor([1.0, 1.1]))
    first = table.first(torch.tensor(0), torch.tensor(1), torch.tensor(1.1), tolerance)
    assert int(first) == expected
