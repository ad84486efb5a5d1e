from collections import Counter

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.levels import plan_levels
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.placement import PLACEMENTS, TargetPlacement
from torchrl_rad.objectives import DenoisingLoss
from torchrl_rad.retrieval import RetrievalSampler

LEVELS = plan_levels(129, (32, 8, 1))


def place(name, step, level):
    """Token and time if the level pins the target, else None."""
    placement = TargetPlacement(name)(torch.tensor([step]), level, *LEVELS[level])
    return (int(placement.token), int(placement.time)) if placement.active else None


@pytest.mark.parametrize(
    "step, first, second, third",
    [
        (1, (1, 32), (1, 8), (1, 1)),
        (5, (1, 32), (1, 8), (5, 5)),
        (8, (1, 32), (1, 8), (8, 8)),
        (9, (1, 32), (1, 8), None),
        (12, (1, 32), (2, 16), None),  # half-way: the later one
        (20, (1, 32), (3, 24), None),
        (32, (1, 32), (4, 32), None),
        (33, (1, 32), None, None),
        (47, (1, 32), None, None),
        (48, (2, 64), None, None),
        (111, (3, 96), None, None),
        (112, (4, 128), None, None),
        (128, (4, 128), None, None),
    ],
)
def test_by_hand(step, first, second, third):
    assert [place("shifted", step, level) for level in range(3)] == [first, second, third]
    assert [place("shifted_first", step, level) for level in range(3)] == [first, None, None]
    # the same grid points, but the target as it is
    literal = [None if pin is None else (pin[0], step) for pin in (first, second, third)]
    assert [place("nearest", step, level) for level in range(3)] == literal


@pytest.mark.parametrize(
    "step, first, second, third",
    [
        (1, 1, 1, 1),
        (8, 1, 1, 8),
        (9, 1, 2, None),
        (17, 1, 3, None),
        (32, 1, 4, None),
        (33, 2, None, None),
        (97, 4, None, None),
        (128, 4, None, None),
    ],
)
def test_next_by_hand(step, first, second, third):
    expected = [None if token is None else (token, step) for token in (first, second, third)]
    assert [place("next", step, level) for level in range(3)] == expected


def test_every_step_of_a_first_level_is_placed_evenly_by_next():
    tokens = TargetPlacement("next")(torch.arange(1, 129), 0, 32, 5).token
    assert Counter(tokens.tolist()) == {1: 32, 2: 32, 3: 32, 4: 32}
    tokens = TargetPlacement("nearest")(torch.arange(1, 129), 0, 32, 5).token
    assert Counter(tokens.tolist()) == {1: 47, 2: 32, 3: 32, 4: 17}


@settings(max_examples=50, deadline=None)
@given(
    name=st.sampled_from(PLACEMENTS),
    level=st.integers(0, 2),
    jump=st.integers(1, 40),
    tokens=st.integers(2, 9),
    data=st.data(),
)
def test_against_a_search_over_the_grid(name, level, jump, tokens, data):
    span = jump * (tokens - 1)
    step = data.draw(st.integers(1, 2 * span))
    token, time, active = TargetPlacement(name)(torch.tensor([step]), level, jump, tokens)
    grid = range(jump, span + 1, jump)
    assert 1 <= int(token) <= tokens - 1
    assert bool(active) == (step <= span and not (name == "shifted_first" and level > 0))
    if step <= span:
        if name == "next":
            best = min(point for point in grid if point >= step)
        else:
            best = min(grid, key=lambda point: (abs(point - step), -point))
        assert int(token) * jump == best
    assert int(time) == (int(token) * jump if name.startswith("shifted") else step)


@pytest.mark.parametrize("name", PLACEMENTS)
def test_steps_outside_the_horizon(name):
    placement = TargetPlacement(name)(torch.tensor([-3, 0, 129, 10_000]), 0, 32, 5)
    assert placement.token.tolist() == [1, 1, 4, 4]
    assert placement.active.tolist() == [True, True, False, False]


def test_unknown_name():
    with pytest.raises(ValueError, match="placement is 'ceil'; expected one of .*shifted_first"):
        TargetPlacement("ceil")


class Recorder:
    """Stands before a placement and keeps the steps that it is asked about."""

    def __init__(self, placement):
        self.placement, self.step = placement, None

    def __call__(self, step, *level):
        self.step = step
        return self.placement(step, *level)


def one_episode(length):
    """A database of one episode whose row i holds the state [i, -i]."""
    states = torch.arange(float(length))[:, None] * torch.tensor([1.0, -1.0])
    done = torch.zeros(length, 1, dtype=torch.bool)
    done[-1] = True
    database = ExpertDatabase(LazyTensorStorage(length), sampler=RetrievalSampler("euclidean"))
    database.extend(
        TensorDict(
            {
                "observation": states,
                "next": {"reward": torch.zeros(length, 1), "done": done},
            },
            [length],
        )
    )
    return database


@pytest.mark.parametrize("name", PLACEMENTS)
@pytest.mark.parametrize("horizon, jumps", [(129, (32, 8, 1)), (49, (16, 4, 1)), (13, (3, 1))])
def test_training_places_as_planning_does(name, horizon, jumps):
    torch.manual_seed(0)
    states, database = Normalizer.identity(2), one_episode(horizon)
    planner = DiffuserLitePlanner(
        states,
        InverseDynamics(states, states, 1),
        horizon=horizon,
        jumps=jumps,
        width=8,
        heads=1,
        blocks=1,
        placement=name,
        database=database,
    )
    loss = DenoisingLoss(planner, no_target=0.0)
    loss.placement = Recorder(planner.placement)
    rows = 400
    windows = database[:]["observation"].expand(rows, horizon, 2)
    for number, level in enumerate(planner.levels):
        clean, mask, _ = loss.pieces(number, windows)
        begin, step = clean[:, 0, 0].long(), loss.placement.step
        assert set(step.tolist()) <= set(range(1, level.span + 1))
        assert int((begin + level.span).max()) < horizon
        # the same situation while acting: at row `begin`, with row `begin + step` as the target
        td = TensorDict(
            {
                "observation": windows[0, begin],
                "target": windows[0, begin + step],
                "found": torch.ones(rows, 1, dtype=torch.bool),
                "target_step": step[:, None],
                "target_index": (begin + step)[:, None],
            },
            [rows],
        )
        pin = planner._pins(td, rows)[number]
        here = torch.arange(level.tokens) == pin.token[:, None]
        known = (here & pin.active[:, None]) | (torch.arange(level.tokens) == 0)
        if number > 0:
            known[:, -1] = True
        assert torch.equal(mask.squeeze(-1), known)
        assert torch.equal(clean[here][pin.active], pin.state[pin.active])
        assert bool(pin.active.all()) == (name != "shifted_first" or number == 0)
