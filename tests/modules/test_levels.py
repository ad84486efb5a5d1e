import pytest

from torchrl_rad.modules.levels import plan_levels, plan_times


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
