"""Episode bounds and returns."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.data import episode_lengths, return_to_go, step_and_remaining
from torchrl_rad.data.episodes import episode_ids

LENGTHS = st.lists(st.integers(1, 7), min_size=1, max_size=6)


def done_of(lengths):
    ends = torch.tensor(lengths).cumsum(0) - 1
    done = torch.zeros(sum(lengths), 1, dtype=torch.bool)
    done[ends] = True
    return done


def table(count, **entries):
    return TensorDict(entries, [count])


@settings(max_examples=30, deadline=None)
@given(LENGTHS)
def test_all_three_markings_agree(lengths):
    count = sum(lengths)
    ids = torch.arange(len(lengths)).flip(0).repeat_interleave(torch.tensor(lengths))
    following = TensorDict({"done": done_of(lengths)}, [count])
    by_done = table(count, next=following)
    by_collector = table(count, next=following, collector=TensorDict({"traj_ids": ids}, [count]))
    by_id = table(count, episode=ids)
    for steps in (by_done, by_collector, by_id):
        assert episode_lengths(steps).tolist() == lengths
    assert torch.equal(episode_ids(by_id, torch.tensor(lengths)), ids)
    assert torch.equal(episode_ids(by_collector, torch.tensor(lengths)), ids)
    counted = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    assert torch.equal(episode_ids(by_done, torch.tensor(lengths)), counted)


@settings(max_examples=30, deadline=None)
@given(LENGTHS)
def test_step_and_remaining(lengths):
    step, remaining = step_and_remaining(torch.tensor(lengths))
    assert step.tolist() == [i for n in lengths for i in range(n)]
    assert remaining.tolist() == [i for n in lengths for i in reversed(range(n))]
    assert step.dtype == remaining.dtype == torch.int64


@settings(max_examples=50, deadline=None)
@given(LENGTHS, st.floats(0, 1), st.randoms(use_true_random=False))
def test_return_to_go_is_the_sum_by_definition(lengths, gamma, random):
    reward = [random.uniform(-5, 5) for _ in range(sum(lengths))]
    expected, begin = [], 0
    for length in lengths:
        end = begin + length
        for i in range(begin, end):
            expected.append(sum(gamma ** (t - i) * reward[t] for t in range(i, end)))
        begin = end
    rewards = torch.tensor(reward, dtype=torch.float64)[:, None]
    value = return_to_go(rewards, torch.tensor(lengths), gamma)
    assert value.dtype == torch.float32 and value.shape == (sum(lengths),)
    torch.testing.assert_close(value, torch.tensor(expected, dtype=torch.float32))


def test_discount_of_zero_and_one():
    reward, lengths = torch.tensor([1.0, 2.0, 4.0, 8.0]), torch.tensor([3, 1])
    assert return_to_go(reward, lengths, 0.0).tolist() == [1, 2, 4, 8]
    assert return_to_go(reward, lengths, 1.0).tolist() == [7, 6, 4, 8]


def test_whole_number_rewards():
    assert return_to_go(torch.tensor([1, 1]), torch.tensor([2]), 0.5).tolist() == [1.5, 1]


@pytest.mark.parametrize("gamma", [-1e-9, 1.5])
def test_discount_out_of_range(gamma):
    with pytest.raises(ValueError, match=r"gamma is .*\[0, 1\]"):
        return_to_go(torch.ones(1), torch.ones(1, dtype=torch.int64), gamma)


def test_no_steps():
    assert episode_lengths(table(0)).tolist() == []
    assert return_to_go(torch.zeros(0), torch.zeros(0, dtype=torch.int64), 0.9).shape == (0,)


def test_nothing_to_go_by():
    with pytest.raises(KeyError, match="to tell episodes apart"):
        episode_lengths(table(2))


def test_done_nowhere():
    following = TensorDict({"done": torch.zeros(3, 1, dtype=torch.bool)}, [3])
    with pytest.raises(ValueError, match="begins at row 0 has no end.*its last row, 2;"):
        episode_lengths(table(3, next=following))


def test_cut_trajectory_of_a_collector():
    done = torch.tensor([[False], [False], [False], [True]])
    steps = table(
        4,
        next=TensorDict({"done": done}, [4]),
        collector=TensorDict({"traj_ids": torch.tensor([0, 0, 1, 1])}, [4]),
    )
    with pytest.raises(ValueError, match="begins at row 0 has no end.*its last row, 1;"):
        episode_lengths(steps)
    steps["episode"] = torch.tensor([0, 0, 1, 1])  # given on purpose: taken as it is
    assert episode_lengths(steps).tolist() == [2, 2]


def test_scattered_ids():
    with pytest.raises(ValueError, match="rows of episode 3 do not lie together"):
        episode_lengths(table(4, episode=torch.tensor([1, 3, 2, 3])))


def test_ids_that_are_no_whole_numbers():
    with pytest.raises(ValueError, match="'episode' must be one whole number a step"):
        episode_lengths(table(2, episode=torch.tensor([0.0, 0.5])))


if __name__ == "__main__":
    pytest.main([__file__])
