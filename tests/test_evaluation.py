"""One full episode of every row, and the figures made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, SerialEnv

from torchrl_rad.evaluation import (
    episode_results,
    evaluate,
    interval,
    measure_latency,
    summarise,
)


class Countdown(EnvBase):
    """An episode of ``length`` steps; step t pays t, so that a foreign step shows in the return."""

    def __init__(self, length: int):
        super().__init__()
        self.length, self.resets = length, 0
        self.observation_spec = Composite(observation=Unbounded((2,)))
        self.action_spec = Bounded(-1.0, 1.0, (1,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        self.time = 0
        self.resets += 1
        return TensorDict({"observation": self._state()})

    def _step(self, tensordict):
        self.time += 1
        ended = torch.tensor([self.time >= self.length])
        following = {"observation": self._state(), "reward": torch.tensor([float(self.time)])}
        return TensorDict({**following, "done": ended, "terminated": ended.clone()})

    def _state(self):
        return torch.tensor([float(self.length), float(self.time)])

    def _set_seed(self, seed):
        return seed


LENGTHS = [3, 7, 1, 5]
RETURNS = [6.0, 28.0, 1.0, 15.0]


def rows(lengths=LENGTHS):
    return SerialEnv(len(lengths), [lambda length=length: Countdown(length) for length in lengths])


def policy(tensordict):
    state = tensordict["observation"]
    return tensordict.update(
        {
            "action": torch.zeros(*state.shape[:-1], 1),
            "plan": torch.zeros(*state.shape[:-1], 9, 2),
            "target": state + 1,
            "found": state[..., 1:] % 2 == 0,  # at every second step
            "similarity": torch.where(state[..., 1:] % 2 == 0, 0.5, -torch.inf),
            "target_index": torch.zeros(*state.shape[:-1], 1, dtype=torch.int64),
            "target_step": torch.ones(*state.shape[:-1], 1, dtype=torch.int64),
        }
    )


@pytest.fixture(scope="module")
def steps():
    env = rows()
    return evaluate(env, policy, max_steps=20)


# acting


def test_each_row_counts_once(steps):
    results = episode_results(steps)
    assert results["return"].tolist() == RETURNS
    assert results["length"].tolist() == LENGTHS


def test_stops_when_the_last_row_has_ended(steps):
    assert steps.batch_size == torch.Size([4, 7])


def test_rows_that_have_ended_wait(steps):
    done = steps["next", "done"].squeeze(-1)
    expected = torch.arange(1, 8) >= torch.tensor(LENGTHS)[:, None]
    assert torch.equal(done, expected)


def test_no_row_begins_again():
    env = rows()
    evaluate(env, policy, max_steps=20)
    assert [row.resets for row in env._envs] == [1] * len(LENGTHS)


def test_time_limit():
    cut = evaluate(rows(), policy, max_steps=4)
    results = episode_results(cut)
    assert results["return"].tolist() == [6.0, 10.0, 1.0, 10.0]
    assert results["length"].tolist() == [3, 4, 1, 4]


def test_what_is_kept(steps):
    inner = {("next", "observation"), ("next", "reward"), ("next", "done")}
    read = {"observation", "target", "found", "similarity", "target_index", "target_step"}
    assert set(steps.keys(True, True)) == read | inner | {"action"}
    assert torch.equal(steps["observation"][1, :, 1], torch.arange(7.0))
    assert torch.equal(steps["next", "observation"][1, :, 1], torch.arange(1.0, 8.0))


def test_policy_that_retrieves_nothing():
    def plain(tensordict):
        return tensordict.set("action", torch.zeros(4, 1))

    kept = evaluate(rows(), plain, 20)
    assert set(kept.keys()) == {"observation", "action", "next"}
    assert "found" not in episode_results(kept)


def test_progress_is_told_of_each_step():
    calls = []
    evaluate(rows(), policy, 20, progress=lambda: calls.append(1))
    assert len(calls) == 7


def test_acts_without_gradients():
    seen = []

    def watching(tensordict):
        seen.append(torch.is_grad_enabled())
        return policy(tensordict)

    evaluate(rows([2, 2]), watching, 20)
    assert seen == [False, False]


# figures of an episode


def recorded(reward, done, **columns):
    reward = torch.tensor(reward, dtype=torch.float32).unsqueeze(-1)
    done = torch.tensor(done, dtype=torch.bool).unsqueeze(-1)
    extra = {key: torch.tensor(value).unsqueeze(-1) for key, value in columns.items()}
    return TensorDict({**extra, "next": {"reward": reward, "done": done}}, list(reward.shape[:2]))


def test_figures_by_hand():
    steps = recorded(
        [[0, 0, 1, 1, 0, 1], [0, 0, 0, 0, 5, 5], [0.0, -1, 0, 2, 0, 0]],
        [[0, 0, 0, 0, 0, 1], [0, 0, 0, 1, 1, 1], [0, 0, 0, 0, 0, 0]],
    )
    results = episode_results(steps)
    assert results["return"].tolist() == [3.0, 0.0, 1.0]
    assert results["length"].tolist() == [6.0, 4.0, 6.0]
    assert results["success"].tolist() == [1.0, 0.0, 1.0]
    np.testing.assert_array_equal(results["arrival"], [3.0, np.nan, 4.0])
    np.testing.assert_allclose(results["share"], [3 / 4, np.nan, 1 / 3])


def test_found_and_similarity_by_hand():
    steps = recorded(
        [[0.0] * 4, [0.0] * 4, [0.0] * 4],
        [[0, 0, 0, 1], [0, 1, 1, 1], [0, 0, 1, 1]],
        found=[[True, False, True, True], [True, False, True, True], [False] * 4],
        similarity=[[0.9, -math.inf, 0.6, 0.6], [0.8, 0.2, 1.0, 1.0], [-math.inf] * 4],
    )
    results = episode_results(steps)
    np.testing.assert_allclose(results["found"], [3 / 4, 1 / 2, 0.0])
    np.testing.assert_allclose(results["similarity"], [0.7, 0.5, np.nan], rtol=1e-6)


def test_long_sums_are_exact():
    steps = recorded([[0.1] * 3000], [[False] * 3000])
    expected = 3000 * float(np.float32(0.1))
    assert episode_results(steps)["return"][0] == pytest.approx(expected, rel=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_nothing_after_the_end_counts(data):
    length = data.draw(st.integers(1, 6))
    reward = data.draw(st.lists(st.sampled_from([0.0, 1.0, -2.0]), min_size=8, max_size=8))
    after = data.draw(st.lists(st.booleans(), min_size=8 - length, max_size=8 - length))
    done = [False] * (length - 1) + [True] + after
    whole = episode_results(recorded([reward], [done]))
    cut = episode_results(recorded([reward[:length]], [done[:length]]))
    for key, value in cut.items():
        np.testing.assert_array_equal(whole[key], value)
    assert whole["return"][0] == sum(reward[:length])


# means


@pytest.mark.parametrize("level", [0.95, 0.5, 0.99])
@pytest.mark.parametrize("count", [2, 5, 100])
def test_interval_against_scipy(level, count):
    values = np.random.default_rng(count).normal(3, 7, count)
    mean, half = interval(values, level)
    low, high = stats.t.interval(level, count - 1, values.mean(), stats.sem(values))
    assert (mean - half, mean + half) == pytest.approx((low, high))


def test_interval_by_hand():
    # mean 2, deviation 1, over sqrt 3, times t(2, 97.5 %) = 4.3027
    assert interval([1, 2, 3]) == pytest.approx((2.0, 4.3026527 / math.sqrt(3)))


def test_interval_skips_what_is_not_a_number():
    assert interval([1, math.nan, 2, math.inf, 3]) == interval([1, 2, 3])


@pytest.mark.parametrize("values, mean", [([5.0], 5.0), ([], math.nan), ([math.nan], math.nan)])
def test_interval_of_too_few(values, mean):
    found = interval(values)
    assert found[0] == mean or (math.isnan(mean) and math.isnan(found[0]))
    assert math.isnan(found[1])


def test_summary_by_hand():
    steps = recorded(
        [[0, 1, 1, 1], [0, 0, 0, 0], [0, 0, 0, 1.0]],
        [[0, 0, 0, 1]] * 3,
        found=[[True] * 4, [False] * 4, [True, True, False, False]],
        similarity=[[0.9] * 4, [-math.inf] * 4, [0.7] * 4],
    )
    row = summarise(episode_results(steps), lambda returns: 10 * returns - 5)
    # returns 3, 0, 1; scores 25, -5, 5: mean 25/3, deviation 15.2753
    half = 4.3026527 * 15.2752523 / math.sqrt(3)
    assert row.pop("similarity") == pytest.approx(0.8)  # of the two that had one
    assert row == pytest.approx(
        {
            "return": 4 / 3,
            "score": 25 / 3,
            "interval": half,
            "success": 2 / 3,
            "arrival": 3.0,  # of those that arrived: 2 and 4
            "share": 1.0,
            "found": 0.5,
            "episodes": 3,
        }
    )


def test_summary_of_a_policy_that_never_arrives():
    row = summarise(episode_results(recorded([[0.0, 0.0]] * 2, [[0, 1]] * 2)), lambda r: r)
    assert row["success"] == 0.0
    assert math.isnan(row["arrival"]) and math.isnan(row["share"])
    assert "found" not in row and "similarity" not in row


# time


class Recorder(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, observation):
        assert not torch.is_grad_enabled()
        self.seen.append(observation.clone())
        return observation + 1


class Renamed(TensorDictModule):
    pass


def test_latency():
    slow, fast = Recorder(), Recorder()
    first = TensorDictModule(slow, ["observation"], ["a"])
    second = Renamed(fast, ["a"], ["b"])
    states = torch.arange(3 * 4 * 1.0).reshape(3, 4, 1)
    latency = measure_latency(TensorDictSequential(first, second), states, rows=2, calls=7)
    assert set(latency) == {"TensorDictModule", "Renamed", "total"}
    for spent in latency.values():
        assert set(spent) == {"p50", "p95"}
        assert 0 < spent["p50"] <= spent["p95"] < math.inf
    # five calls to warm up, then seven: two rows, one step after the other, from the start again
    assert len(slow.seen) == len(fast.seen) == 12
    for call, state in enumerate(slow.seen):
        assert torch.equal(state, states[:2, call % 4])
    assert torch.equal(fast.seen[0], states[:2, 0] + 1)


def test_latency_counts_milliseconds(monkeypatch):
    clock = iter(range(10_000))
    monkeypatch.setattr("torchrl_rad.evaluation.time.perf_counter", lambda: next(clock) * 0.002)
    module = TensorDictModule(lambda x: x + 1, ["observation"], ["a"])
    latency = measure_latency(TensorDictSequential(module), torch.zeros(1, 1, 1), rows=1, calls=3)
    assert latency["total"] == pytest.approx({"p50": 2.0, "p95": 2.0})


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
