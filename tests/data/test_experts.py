"""Expert rules, alone and combined."""

import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.data import (
    Expert,
    episode_length,
    expert_from_config,
    first_hit_within,
    near_best_return,
    reaches_goal,
    return_at_least,
    subtasks_done,
    top_share_by_return,
)


def episode(*rewards):
    reward = torch.tensor(rewards, dtype=torch.float32)[:, None]
    return TensorDict({"next": {"reward": reward}}, [len(rewards)])


def test_episode_length():
    assert [episode_length(2)(e) for e in (episode(0), episode(0, 0), episode(0, 0, 0))] == [
        False,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("rewards", "expected"),
    [
        ((0, 0, 0, 0), False),  # never
        ((1, 0, 1, 1), False),  # the first hit is too early, later ones do not count
        ((0, 1, 0, 0), True),
        ((0, 0, 1, 1), True),
        ((0, 0, 0, 1), False),  # too late
        ((-1, 0.5, 0, 0), True),  # any positive reward is a hit
    ],
)
def test_first_hit_within(rewards, expected):
    assert first_hit_within(2, 3)(episode(*rewards)) is expected


def test_empty_range():
    with pytest.raises(ValueError, match=r"first_hit_within\(3, 2\) is empty"):
        first_hit_within(3, 2)


def test_reaches_goal():
    assert reaches_goal()(episode(0, 0, 1)) is True
    assert reaches_goal()(episode(0, -1, 0)) is False


def test_return_at_least():
    assert return_at_least(3)(episode(1, 0, 1, 1)) is True
    assert return_at_least(3)(episode(2, 0.9)) is False
    assert expert_from_config(return_at_least(3).config)(episode(3)) is True


def test_subtasks_done():
    assert subtasks_done(3)(episode(1, 3, 2)) is True
    assert subtasks_done(3)(episode(1, 2, 2)) is False


@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (0.25, [False, False, True, False]),
        (0.5, [True, False, True, True]),  # 5 and 5 are equal: kept together
        (1.0, [True] * 4),
        (0.01, [False, False, True, False]),  # at least one
    ],
)
def test_top_share_by_return(share, expected):
    episodes = [episode(5), episode(1, 1, 1), episode(3, 6), episode(2, 3)]
    assert top_share_by_return(share).select(episodes).tolist() == expected


@pytest.mark.parametrize("share", [0.0, -0.5, 1.1])
def test_share_out_of_range(share):
    with pytest.raises(ValueError, match=r"share is .*\(0, 1\]"):
        top_share_by_return(share)


@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (0.0, [False, False, True, False]),
        (0.4, [False, False, True, False]),  # 5.4 or more
        (0.5, [True, False, True, True]),  # 4.5 or more
        (0.7, [True, True, True, True]),
    ],
)
def test_near_best_return(share, expected):
    episodes = [episode(5), episode(1, 1, 1), episode(3, 6), episode(2, 3)]
    assert near_best_return(share).select(episodes).tolist() == expected


def test_near_the_best_of_negative_returns():
    episodes = [episode(-10), episode(-11), episode(-12)]
    assert near_best_return(0.1).select(episodes).tolist() == [True, True, False]


@pytest.mark.parametrize("share", [-0.1, 1.0, float("nan")])
def test_no_share_of_the_best(share):
    with pytest.raises(ValueError, match=r"share is .*\[0, 1\)"):
        near_best_return(share)


def test_a_share_compares_among_the_episodes_that_come_together():
    rule = top_share_by_return(0.5) & episode_length(2)
    episodes = [episode(9), episode(1, 1), episode(5, 5), episode(0, 0)]
    assert rule.select(episodes).tolist() == [False, False, True, False]
    assert (~top_share_by_return(0.5)).select(episodes).tolist() == [False, True, False, True]


RULES = st.recursive(
    st.one_of(
        st.integers(1, 4).map(episode_length),
        st.integers(1, 3).map(lambda low: first_hit_within(low, low + 1)),
        st.just(reaches_goal()),
        st.integers(1, 2).map(subtasks_done),
        st.just(top_share_by_return(0.4)),
        st.just(near_best_return(0.4)),
    ),
    lambda rules: st.one_of(
        st.tuples(rules, rules).map(lambda pair: pair[0] & pair[1]),
        st.tuples(rules, rules).map(lambda pair: pair[0] | pair[1]),
        rules.map(lambda rule: ~rule),
    ),
    max_leaves=5,
)
EPISODES = st.lists(
    st.lists(st.integers(0, 2), min_size=1, max_size=4), min_size=1, max_size=5
).map(lambda lists: [episode(*rewards) for rewards in lists])


@settings(max_examples=40, deadline=None)
@given(RULES, EPISODES)
def test_config_gives_the_same_rule(rule, episodes):
    again = expert_from_config(json.loads(json.dumps(rule.config)))
    assert repr(again) == repr(rule)
    assert torch.equal(again.select(episodes), rule.select(episodes))


@settings(max_examples=30, deadline=None)
@given(RULES, RULES, EPISODES)
def test_combinations_follow_logic(one, two, episodes):
    first, second = one.select(episodes), two.select(episodes)
    assert first.dtype == torch.bool and first.shape == (len(episodes),)
    assert torch.equal((one & two).select(episodes), first & second)
    assert torch.equal((one | two).select(episodes), first | second)
    assert torch.equal((~(~one & ~two)).select(episodes), first | second)


def test_combination_called_with_one_episode():
    rule = ~episode_length(2) | reaches_goal()
    assert [rule(episode(0, 0)), rule(episode(0, 1)), rule(episode(0))] == [False, True, True]


def test_names():
    rule = episode_length(1000) & ~(reaches_goal() | subtasks_done(3))
    assert repr(rule) == "(episode_length(1000) & ~(reaches_goal() | subtasks_done(3)))"
    assert repr(top_share_by_return(0.1)) == "top_share_by_return(0.1)"


def test_unknown_rule():
    with pytest.raises(KeyError, match="unknown expert rule 'luck'; known rules are.*reaches_goal"):
        expert_from_config({"rule": "luck", "args": []})


def test_rule_of_ones_own():
    rule = Expert({"rule": "first_pays", "args": []}, lambda e: e["next", "reward"][0, 0] > 0)
    assert rule(episode(1, 0)) is True
    assert (rule & episode_length(1)).select([episode(1), episode(0), episode(1, 1)]).tolist() == [
        True,
        False,
        False,
    ]


if __name__ == "__main__":
    pytest.main([__file__])
