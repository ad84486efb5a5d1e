"""What is refused before it reaches a database; the messages are tested with the database."""

import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict

from torchrl_rad.data.checks import (
    check_finite,
    check_same_columns,
    check_steps,
    flat_steps,
    names,
)


def make_steps(count=3, **entries):
    following = TensorDict({"reward": torch.zeros(count, 1)}, [count])
    return TensorDict({"observation": torch.zeros(count, 2), "next": following, **entries}, [count])


def test_flat_steps_is_a_shallow_copy():
    steps = make_steps()
    flat = flat_steps(steps)
    flat["extra"] = torch.zeros(3)
    assert "extra" not in steps and flat["observation"] is steps["observation"]


def test_lazy_stack_is_made_dense():
    flat = flat_steps(LazyStackedTensorDict(*make_steps().unbind(0)))
    assert type(flat) is TensorDict and flat["observation"].shape == (3, 2)


@pytest.mark.parametrize("batch", [[], [2, 3]])
def test_not_flat(batch):
    with pytest.raises(ValueError, match="expected flat steps"):
        flat_steps(TensorDict({}, batch))


def test_non_tensor_state():
    with pytest.raises(KeyError, match="need the entry 'observation'; got .*next.reward"):
        check_steps(make_steps().set_non_tensor("observation", "high"), "observation")


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_states_of_any_floating_type(dtype):
    check_steps(make_steps(observation=torch.zeros(3, 2, dtype=dtype)), "observation")


def test_rewards_may_be_flat_whole_numbers():
    steps = make_steps()
    steps["next", "reward"] = torch.ones(3, dtype=torch.int64)
    check_steps(steps, "observation")


def test_finite_names_the_first_of_many():
    steps = make_steps(4)
    steps["observation"][2:, 1] = float("nan")
    episode, step = torch.tensor([5, 5, 6, 6]), torch.tensor([0, 1, 0, 1])
    with pytest.raises(ValueError, match=r"in 2 row\(s\), the first in episode 6 at step 0"):
        check_finite(steps, ("absent", "observation"), episode, step)
    check_finite(steps, ("absent", ("next", "reward")), episode, step)


def test_index_does_not_count_as_a_column():
    check_same_columns(make_steps(), make_steps(5, index=torch.arange(5)))


def test_names():
    assert names(make_steps()) == ["next.reward", "observation"]


if __name__ == "__main__":
    pytest.main([__file__])
