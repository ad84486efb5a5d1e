"""The same state vector from data and from the live environment."""

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import pytest

from torchrl_rad.envs import FixedGoalMaze, ObservationAdapter, maze_task


def test_entries_are_joined_in_the_order_asked_for():
    observation = {"a": np.array([1.0, 2.0]), "b": np.array([3.0])}
    assert ObservationAdapter(("b", "a"))(observation).tolist() == [3, 1, 2]
    assert ObservationAdapter(("a",))(observation).tolist() == [1, 2]


def test_recorded_episode_equals_its_steps():
    rng = np.random.default_rng(0)
    episode = {"observation": rng.normal(size=(6, 4)), "achieved_goal": rng.normal(size=(6, 2))}
    adapter = ObservationAdapter(("achieved_goal", "observation"))
    whole = adapter(episode)
    assert whole.shape == (6, 6) and whole.dtype == np.float32
    for t in range(6):
        live = adapter({name: value[t] for name, value in episode.items()})
        assert np.array_equal(live, whole[t])


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_plain_array_is_cast(dtype):
    state = ObservationAdapter()(np.arange(3, dtype=dtype))
    assert state.dtype == np.float32 and state.tolist() == [0, 1, 2]


def test_missing_entry():
    match = r"has entries \['observation'\], but \['achieved_goal'\] were asked for"
    with pytest.raises(KeyError, match=match):
        ObservationAdapter(("achieved_goal",))({"observation": np.zeros(2)})


def test_data_and_live_environment_agree():
    # the raw environment, as a recorder sees it, beside the one that a policy acts in
    gym.register_envs(gymnasium_robotics)
    raw = gym.make("PointMaze_UMaze-v3", max_episode_steps=300)
    live = FixedGoalMaze(maze_task("umaze"), reset_cell=(3, 1))
    state, _ = live.reset(seed=3)
    raw.reset(seed=3)
    raw.unwrapped.point_env.set_state(*np.split(state.astype(np.float64), 2))
    live.unwrapped.point_env.set_state(*np.split(state.astype(np.float64), 2))
    adapter, recorded, met = ObservationAdapter(), [], []
    for action in np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32):
        recorded.append(raw.step(action)[0])
        met.append(live.step(action)[0])
    batch = {key: np.stack([row[key] for row in recorded]) for key in recorded[0]}
    assert np.array_equal(adapter(batch), np.stack(met))
    assert adapter(batch).shape == (20, 4)


def test_repr():
    assert repr(ObservationAdapter(["a", "b"])) == "ObservationAdapter(('a', 'b'))"


if __name__ == "__main__":
    pytest.main([__file__])
