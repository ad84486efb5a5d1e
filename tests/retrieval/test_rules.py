import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, RetrievalTargetModule
from torchrl_rad.retrieval.choice import first_by_rank
from torchrl_rad.retrieval.rules import TolerantRule, followed_rule, highest_rule

from ..oracle import target_of

# two episodes: rows 0..4 and 5..7
VALUES = torch.tensor([1.0, 3.0, 2.0, 3.0, 0.0, 3.0, 2.5, 9.0])
REMAINING = torch.tensor([4, 3, 2, 1, 0, 2, 1, 0])


def apply(rule, rows, valid):
    """Target and place of each state by either kind of rule."""
    if isinstance(rule, TolerantRule):
        return rule(rows, valid)
    place = first_by_rank(rule.rank, rows, valid)
    return rule.target[rows.gather(-1, place)[:, 0]], place


def choose(rule, rows):
    """Target and place for one state with these neighbours, most similar first."""
    target, place = apply(rule, torch.tensor([rows]), torch.ones(1, len(rows), dtype=torch.bool))
    return target.item(), place.item()


@pytest.mark.parametrize(
    "rows, expected",
    [
        ([0], (1, 0)),  # rows 0..2: 3.0 in row 1
        ([2], (3, 0)),
        ([4], (4, 0)),  # the end of the episode: not row 5
        ([2, 0, 1], (1, 1)),  # rows 1 and 3 both pay 3.0: row 1 has more steps left; via row 0
        ([3, 6], (7, 1)),  # 9.0 in the other episode
        ([3, 5], (7, 1)),
    ],
)
def test_highest_by_hand(rows, expected):
    assert choose(highest_rule(VALUES, REMAINING, horizon=3), rows) == expected


@pytest.mark.parametrize(
    "least, rows, expected",
    [(1, [1], (3, 0)), (1, [4], (4, 0)), (2, [2], (4, 0)), (2, [0, 1], (3, 1)), (2, [6], (7, 0))],
)
def test_highest_with_a_smallest_offset(least, rows, expected):
    rule = highest_rule(VALUES, REMAINING, horizon=3, min_offset=least)
    assert choose(rule, rows) == expected


@pytest.mark.parametrize(
    "tolerance, rows, expected",
    [
        (1.0, [2], (2, 0)),  # 2.0 is near 3.0 and has more steps left
        (0.9, [2], (3, 0)),
        (2.0, [2, 0], (0, 1)),
        (6.0, [5], (5, 0)),  # 3.0 is near 9.0
        (5.9, [5], (7, 0)),
    ],
)
def test_highest_with_a_tolerance(tolerance, rows, expected):
    rule = highest_rule(VALUES, REMAINING, horizon=3, tolerance=tolerance)
    assert isinstance(rule, TolerantRule)
    assert choose(rule, rows) == expected


@pytest.mark.parametrize(
    "ahead, rows, expected",
    [
        (0, [0, 2], (2, 1)),
        (1, [0, 2], (3, 1)),  # row 2 pays more than row 0; the best of 2..3 is row 3
        (16, [0, 2], (3, 1)),
        (16, [3, 1, 5], (3, 0)),  # all pay 3.0: the most similar
        (16, [1], (1, 0)),  # row 3 pays as much, row 1 has more steps left
        (16, [0, 6], (7, 1)),
    ],
)
def test_followed_by_hand(ahead, rows, expected):
    assert choose(followed_rule(VALUES, REMAINING, ahead), rows) == expected


@pytest.mark.parametrize(
    "rule",
    [
        followed_rule(VALUES, REMAINING, 2),
        highest_rule(VALUES, REMAINING, 3),
        highest_rule(VALUES, REMAINING, 3, tolerance=1.0),
    ],
    ids=["followed", "highest", "tolerant"],
)
def test_places_that_hold_no_neighbour_do_not_count(rule):
    rows = torch.tensor([[0, 7], [2, 7]])
    target, place = apply(rule, rows, torch.tensor([[True, False], [True, False]]))
    assert target.tolist() == [choose(rule, [0])[0], choose(rule, [2])[0]]
    assert place.tolist() == [[0], [0]]
    # none at all: no error, and the first place
    assert apply(rule, rows, torch.zeros(2, 2, dtype=torch.bool))[1].tolist() == [[0], [0]]


def test_ranks_take_half_the_memory():
    assert followed_rule(VALUES, REMAINING, 2).rank.dtype == torch.int32
    assert highest_rule(VALUES, REMAINING, 3).rank.dtype == torch.int32


# the whole target rule, from the state on


@st.composite
def databases(draw):
    """A small database: several episodes, few different states and rewards, so that ties abound."""
    lengths = draw(st.lists(st.integers(1, 7), min_size=1, max_size=4))
    width = draw(st.integers(1, 2))
    state = st.lists(st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0]), min_size=width, max_size=width)
    count = sum(lengths)
    states = draw(st.lists(state, min_size=count, max_size=count))
    rewards = draw(st.lists(st.integers(-1, 1), min_size=count, max_size=count))
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    search = {
        "metric": draw(st.sampled_from(["euclidean", "cosine"])),
        "k": draw(st.sampled_from([1, 2, 5, 50])),
        "threshold": draw(st.sampled_from([0.0, 0.5, 2 / 3, 0.8, 1.0])),
        "dims": draw(st.sampled_from([None, [0]])),
    }
    database = ExpertDatabase(
        LazyTensorStorage(40),
        gamma=draw(st.sampled_from([0.0, 0.5, 0.9, 1.0])),
        sampler=RetrievalSampler(**search),
    )
    reward = torch.tensor(rewards, dtype=torch.float32)[:, None]
    following = TensorDict({"reward": reward, "done": done}, [count])
    database.extend(TensorDict({"observation": torch.tensor(states), "next": following}, [count]))
    query = draw(st.lists(state | st.just([2.0] * width), min_size=1, max_size=4))
    return database, search, torch.tensor(query)


def assert_equals_oracle(made, rule, **limits):
    database, search, query = made
    names = ["target", "found", "similarity", "target_return", "target_index", "target_offset"]
    horizon = limits.get("horizon", 20)
    module = RetrievalTargetModule(
        database, rule=rule, out_keys=names, **{**limits, "horizon": horizon}
    )
    out = module(TensorDict({"observation": query}, [len(query)]))
    columns = {name: value.tolist() for name, value in database[:].exclude("next").items()}
    for number, state in enumerate(query.tolist()):
        expected = target_of(state, columns, search, rule, **limits)
        got = {name: out[name][number].tolist() for name in names}
        expected["similarity"] = torch.tensor(expected["similarity"]).item()  # float32
        assert got.pop("target") == expected.pop("target")
        assert {name: value for name, (value,) in got.items()} == expected


@settings(max_examples=50, deadline=None)
@given(
    made=databases(),
    horizon=st.integers(2, 8),
    tolerance=st.sampled_from([0.0, 0.1, 0.5, 1.0, 2.0]),
    least=st.integers(0, 3),
)
def test_highest_equals_oracle(made, horizon, tolerance, least):
    least = min(least, horizon - 1)
    limits = {"horizon": horizon, "tolerance": tolerance, "min_offset": least}
    assert_equals_oracle(made, "highest", **limits)


@settings(max_examples=50, deadline=None)
@given(made=databases(), ahead=st.integers(0, 8))
def test_followed_equals_oracle(made, ahead):
    assert_equals_oracle(made, "followed", ahead=ahead)


@settings(max_examples=20, deadline=None)
@given(made=databases())
def test_ranks_agree_with_the_search_of_each_window(made):
    # a tolerance too small to matter takes the other way through the code
    database, _, query = made
    ranked = RetrievalTargetModule(database, horizon=4)
    searched = RetrievalTargetModule(database, horizon=4, tolerance=1e-12)
    batch = TensorDict({"observation": query}, [len(query)])
    one, other = ranked(batch.copy()), searched(batch.copy())
    assert all(torch.equal(one[name], other[name]) for name in ranked.out_keys)
