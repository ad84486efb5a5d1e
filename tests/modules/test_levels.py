import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_rad.modules.levels import (
    Level,
    decode_states,
    encode_states,
    level_changes,
    plan_levels,
    plan_times,
)
from torchrl_rad.modules.normalizer import Normalizer


def test_plan_levels_by_hand():
    assert plan_levels(129, (32, 8, 1)) == [(32, 5), (8, 5), (1, 9)]
    assert plan_levels(49, [16, 4, 1]) == [(16, 4), (4, 5), (1, 5)]
    assert plan_levels(9, (1,)) == [(1, 9)]
    assert plan_levels(2, (1,)) == [(1, 2)]
    assert [level.span for level in plan_levels(129, (32, 8, 1))] == [128, 32, 8]


@pytest.mark.parametrize(
    "horizon, jumps",
    [
        (128, (32, 8, 1)),  # 127 is no multiple of 32
        (129, (32, 5, 1)),
        (129, (32, 8)),
        (129, (32, 32, 1)),
        (129, (8, 32, 1)),
        (129, ()),
        (129, (32, 0, 1)),
        (129, (-32, 8, 1)),
        (129, (256, 1)),
    ],
)
def test_jumps_that_do_not_multiply_out(horizon, jumps):
    with pytest.raises(ValueError, match=rf"do not multiply out to horizon {horizon}: .* \(32, 8"):
        plan_levels(horizon, jumps)


def test_horizon_too_short():
    with pytest.raises(ValueError, match="horizon is 1; a plan has 2 states or more"):
        plan_levels(1, (1,))


@pytest.mark.parametrize(
    "horizon, jumps, expected",
    [
        (129, (32, 8, 1), [0, 1, 2, 3, 4, 5, 6, 7, 8, 16, 24, 32, 64, 96, 128]),
        (13, (3, 1), [0, 1, 2, 3, 6, 9, 12]),
        (5, (1,), [0, 1, 2, 3, 4]),
        (2, (1,), [0, 1]),
    ],
)
def test_plan_times_by_hand(horizon, jumps, expected):
    assert plan_times(plan_levels(horizon, jumps)).tolist() == expected


# changes from the current state

SCALE = Normalizer(torch.tensor([1.0, -2.0]), torch.tensor([2.0, 0.5]))
CHANGE = Normalizer(torch.zeros(2), torch.tensor([0.5, 4.0]))


def test_changes_in_units_by_hand():
    plan = torch.tensor([[3.0, -2.0], [4.0, 2.0], [3.0, -4.0]])
    expected = torch.tensor([[1.0, 0.0], [2.0, 1.0], [0.0, -0.5]])
    assert torch.equal(encode_states(plan, SCALE, CHANGE), expected)
    assert torch.equal(encode_states(plan, SCALE, None), SCALE(plan))


@given(seed=st.integers(0, 1000), change=st.sampled_from([None, CHANGE]))
def test_there_and_back(seed, change):
    plans = torch.randn(3, 4, 5, 2, generator=torch.Generator().manual_seed(seed))
    back = decode_states(encode_states(plans, SCALE, change), plans[..., :1, :], SCALE, change)
    torch.testing.assert_close(back, plans)


@given(
    seed=st.integers(0, 1000),
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=5),
    level=st.sampled_from([Level(1, 5), Level(3, 3), Level(8, 2)]),
)
def test_scale_of_changes_by_brute_force(seed, lengths, level):
    episode = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    states = torch.randn(len(episode), 2, generator=torch.Generator().manual_seed(seed))
    changes = [
        states[later] - states[row]
        for row in range(len(states))
        for later in range(row + level.jump, row + level.span + 1, level.jump)
        if later < len(states) and episode[later] == episode[row]
    ]
    found = level_changes(states, episode, level)
    expected = torch.stack(changes).square().mean(0).sqrt() if changes else torch.ones(2)
    torch.testing.assert_close(found.deviation, expected)
    assert torch.equal(found.mean, torch.zeros(2))
