import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.replanning import PlanActions, with_replanning
from torchrl_rad.policy import build_policy

PLANNER = {
    "horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1, "steps": 1,
    "noise": "seeded",
}  # fmt: skip
ABOUT = {"state_dim": 3, "action_dim": 2, "planner": PLANNER, "target": None}


def make_policy():
    torch.manual_seed(0)
    policy = build_policy(ABOUT)
    for parameter in policy[-1].networks.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return policy


def drive(policy, states, starts):
    """Actions [T, B, A] along states [T, B, S]; what a policy keeps is carried on."""
    td, actions = TensorDict({}, states.shape[1:2]), []
    for state, start in zip(states, starts, strict=True):
        td["observation"], td["is_init"] = state, start[:, None]
        td = policy(td).exclude("plan")
        actions.append(td["action"].clone())
    return torch.stack(actions)


def test_actions_of_a_plan():
    torch.manual_seed(0)
    states = Normalizer.identity(3)
    inverse = InverseDynamics(states, states, action_dim=2)
    plan = torch.randn(4, 9, 3)
    actions = PlanActions(inverse, steps=5)(TensorDict({"plan": plan}, [4]))["action_chunk"]
    assert actions.shape == (4, 5, 2) and not actions.requires_grad
    for step in range(5):
        torch.testing.assert_close(actions[:, step], inverse(plan[:, step], plan[:, step + 1]))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), interval=st.integers(1, 4))
def test_each_row_plans_on_its_own_clock(seed, interval):
    policy = make_policy()
    generator = torch.Generator().manual_seed(seed)
    states = torch.randn(11, 3, 3, generator=generator)
    starts = torch.rand(11, 3, generator=generator) < 0.2
    starts[0] = True
    found = drive(with_replanning(policy, interval), states, starts)
    inverse = policy[-1].inverse_dynamics
    for row in range(3):
        since, plan = 0, None
        for step in range(11):
            if starts[step, row] or since == interval:
                told = TensorDict({"observation": states[step, row : row + 1]}, [1])
                since, plan = 0, policy(told)["plan"]
            expected = inverse(plan[:, since], plan[:, since + 1])[0]
            torch.testing.assert_close(found[step, row], expected, atol=1e-5, rtol=1e-4)
            since += 1


def test_planning_at_each_step_is_the_policy():
    policy, states = make_policy(), torch.randn(5, 2, 3)
    starts = torch.zeros(5, 2, dtype=torch.bool)
    starts[0] = True
    found = drive(with_replanning(policy, 1), states, starts)
    torch.testing.assert_close(found, drive(policy, states, starts))


@pytest.mark.parametrize("interval", [0, -1, 5])
def test_plans_that_do_not_reach_so_far(interval):
    with pytest.raises(ValueError, match=rf"interval is {interval}; expected 1 to 4"):
        with_replanning(make_policy(), interval)


def test_plans_of_a_diffuser():
    diffuser = {"kind": "diffuser", "horizon": 8, "width": 8, "multiples": [1, 2],
                "candidates": 1, "return_model": None}  # fmt: skip
    policy = build_policy({**ABOUT, "planner": diffuser})
    with pytest.raises(ValueError, match="plans of DiffuserPlanner are not acted on"):
        with_replanning(policy, 2)
