"""Windows of consecutive steps, always inside one episode."""

import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorStorage

from torchrl_rad.data import Window, WindowSampler, window_buffer

LENGTHS = st.lists(st.integers(1, 9), min_size=1, max_size=6)


def make_steps(lengths, first_id=0):
    ids = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths)) + first_id
    return TensorDict({"row": torch.arange(len(ids)), "episode": ids}, [len(ids)])


@settings(max_examples=50, deadline=None)
@given(LENGTHS, st.integers(1, 9))
def test_starts_are_all_the_valid_ones(lengths, length):
    expected, begin = [], 0
    for n in lengths:
        expected += list(range(begin, begin + max(0, n - length + 1)))
        begin += n
    sampler, storage = WindowSampler(length), TensorStorage(make_steps(lengths))
    if expected:
        assert sampler.starts(storage).tolist() == expected
    else:
        with pytest.raises(ValueError, match=f"no episode has {length} steps"):
            sampler.starts(storage)


@settings(max_examples=30, deadline=None)
@given(LENGTHS.filter(lambda lengths: max(lengths) >= 3), st.integers(1, 3), st.integers(1, 20))
def test_windows_stay_inside_one_episode(lengths, length, batch):
    windows = window_buffer(make_steps(lengths), length, batch).sample().reshape(-1, length)
    assert windows.batch_size == (batch, length)
    assert (windows["episode"] == windows["episode"][:, :1]).all()
    rows = windows["row"]
    assert torch.equal(rows, rows[:, :1] + torch.arange(length))


def test_uniform_over_valid_starts():
    # of 17 rows, windows of 4 can begin at 7 + 0 + 1 of them
    steps = make_steps([10, 3, 4])
    buffer = window_buffer(steps, 4, 8000, torch.Generator().manual_seed(0))
    starts = buffer.sample().reshape(-1, 4)["row"][:, 0]
    counts = starts.bincount(minlength=17).double()
    valid = [0, 1, 2, 3, 4, 5, 6, 13]
    assert counts.nonzero().flatten().tolist() == valid
    # 24.3: chi-square with 7 degrees of freedom, one in a thousand
    assert ((counts[valid] - 1000).square() / 1000).sum() < 24.3


def test_same_seed_same_windows():
    steps = make_steps([10, 30])
    draws = [
        window_buffer(steps, 4, 16, torch.Generator().manual_seed(seed)).sample()["row"]
        for seed in (5, 5, 6)
    ]
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])


def test_too_short_episodes():
    buffer = window_buffer(make_steps([3, 5]), 6, 2)
    with pytest.raises(ValueError, match=r"no episode has 6 steps \(the longest has 5\).*horizon"):
        buffer.sample()


def test_error_comes_again():
    sampler, storage = WindowSampler(6), TensorStorage(make_steps([3, 5]))
    for _ in range(2):
        with pytest.raises(ValueError, match="no episode has 6 steps"):
            sampler.sample(storage, 2)


@pytest.mark.parametrize("length", [0, -3])
def test_length_below_one(length):
    with pytest.raises(ValueError, match=f"length is {length}; a window has at least one row"):
        WindowSampler(length)


def test_steps_are_not_copied():
    steps = make_steps([4])
    buffer = window_buffer(steps, 2, 8)
    steps["row"] += 100
    assert (buffer.sample()["row"] >= 100).all()


def test_growing_buffer_offers_new_windows():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20),
        sampler=WindowSampler(3),
        sample_unit=Window(3),
        batch_size=200,
    )
    buffer.extend(make_steps([3]))
    assert set(buffer.sample().reshape(-1, 3)["episode"][:, 0].tolist()) == {0}
    buffer.extend(make_steps([2, 4], first_id=1))
    assert set(buffer.sample().reshape(-1, 3)["episode"][:, 0].tolist()) == {0, 2}
    buffer.empty()
    buffer.extend(make_steps([5], first_id=7))
    assert set(buffer.sample().reshape(-1, 3)["episode"][:, 0].tolist()) == {7}


def test_unit_repeats_what_is_known_of_an_anchor():
    index, info = Window(2).expand(torch.tensor([3, 7]), {"weight": torch.tensor([0.5, 1.0])}, None)
    assert index.tolist() == [3, 4, 7, 8]
    assert info["weight"].tolist() == [0.5, 0.5, 1.0, 1.0]


def test_sampler_is_saved_and_pickled_without_its_cache(tmp_path):
    sampler = WindowSampler(3)
    sampler.starts(TensorStorage(make_steps([5000])))
    assert len(pickle.dumps(sampler)) < 2000
    assert pickle.loads(pickle.dumps(sampler)).length == 3
    sampler.dumps(tmp_path / "new" / "folder")
    other = WindowSampler(9)
    other.loads(tmp_path / "new" / "folder")
    assert other.starts(TensorStorage(make_steps([4]))).tolist() == [0, 1]
    other.load_state_dict({"length": 4})
    assert other.starts(TensorStorage(make_steps([4]))).tolist() == [0]


if __name__ == "__main__":
    pytest.main([__file__])
