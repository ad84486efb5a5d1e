"""V by implicit Q-learning: on chains whose values are known."""

import torch
from tensordict import TensorDict
from torchrl.objectives import IQLLoss

from torchrl_rad import Normalizer, Objective
from torchrl_rad.objectives.value import make_value_loss, state_values

GAMMA, LAST = 0.9, 4


def chain(forward):
    """States 1 to 3 on a line from 0 to 4; both ends are ends, and 4 pays."""
    place = torch.arange(1, LAST).float()[:, None]
    step = torch.ones_like(place) if forward else -torch.ones_like(place)
    after = place + step
    end, reward = (after == 0) | (after == LAST), (after == LAST).float()
    return TensorDict(
        {
            "observation": place,
            "action": step * 0.9,
            "next": {"observation": after, "reward": reward, "done": end, "terminated": end},
        },
        [LAST - 1],
    )


def learn(steps, expectile=0.97, updates=400):
    torch.manual_seed(0)
    normalizer = Normalizer.of(steps["observation"])
    loss = make_value_loss(normalizer, 1, GAMMA, expectile, width=32)
    objective = Objective(loss, lambda batch: batch, lr=1e-2, steps=updates, ema=0.95)
    for _ in range(updates):
        objective.update(steps)
    return loss


def test_value_is_the_discounted_way_to_the_reward():
    loss = learn(torch.cat([chain(True), chain(False)]))
    assert isinstance(loss, IQLLoss)
    value = state_values(loss, chain(True)["observation"])
    expected = GAMMA ** torch.arange(LAST - 2, -1, -1).float()
    assert (value - expected).abs().max() < 0.1
    assert (value.diff() > 0).all()


def test_what_was_never_reached_is_worth_nothing():
    value = state_values(learn(chain(False)), chain(False)["observation"])
    assert value.abs().max() < 0.05


def test_many_states_are_asked_in_parts(monkeypatch):
    loss = make_value_loss(Normalizer.identity(2), 1)
    states = torch.randn(10, 2)
    whole = state_values(loss, states)
    monkeypatch.setattr("torchrl_rad.objectives.value.ROWS", 3)
    assert torch.allclose(state_values(loss, states), whole, atol=1e-6) and whole.shape == (10,)
    assert not whole.requires_grad
