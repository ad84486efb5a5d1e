import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.data.regions import enters_region, without_region


def walks(places):
    """An episode for each list of x; y is 0, and a third entry is far away."""
    states = [torch.tensor([[x, 0.0, 99.0] for x in xs]) for xs in places]
    ids = torch.repeat_interleave(
        torch.arange(len(places)), torch.tensor([len(xs) for xs in places])
    )
    return TensorDict({"observation": torch.cat(states), "episode": ids}, [len(ids)])


def test_by_hand():
    data = walks([[0.0, 1.0], [2.0, 3.0, 4.0], [5.0]])
    squares = torch.tensor([[1.4, 0.2], [5.0, 0.0]])
    assert enters_region(data, squares, 0.5).tolist() == [True, False, True]
    assert without_region(data, squares, 0.5)["episode"].tolist() == [1, 1, 1]
    # on the edge counts as inside; x alone is not enough
    assert enters_region(data, torch.tensor([[3.5, 0.5]]), 0.5).tolist() == [False, True, False]
    assert not enters_region(data, torch.tensor([[3.0, 0.6]]), 0.5).any()


@given(
    st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=5), min_size=1, max_size=12),
    st.sets(st.integers(0, 9), min_size=1, max_size=4),
    st.floats(0, 1),
)
@settings(max_examples=60, deadline=None)
def test_share_that_stays(places, region, coverage):
    data = walks([list(map(float, xs)) for xs in places])
    centres = torch.tensor([[float(x), 0.0] for x in sorted(region)])
    enters = [bool(region & set(xs)) for xs in places]
    assert enters_region(data, centres, 0.4).tolist() == enters
    stays = round(coverage * sum(enters))
    if all(enters) and not stays:
        with pytest.raises(ValueError, match="none is left"):
            without_region(data, centres, 0.4, coverage)
        return
    left = set(without_region(data, centres, 0.4, coverage)["episode"].tolist())
    assert {i for i, inside in enumerate(enters) if not inside} <= left
    assert len(left) == len(places) - sum(enters) + stays


def test_no_share():
    with pytest.raises(ValueError, match="coverage is 2.0; expected a share"):
        without_region(walks([[0.0]]), torch.zeros(1, 2), 0.5, coverage=2.0)
