import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.replanning import PlanActions, with_replanning
from torchrl_rad.policy import build_policy

from ..walks import episodes

PLANNER = {
    "horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1, "steps": 1,
    "noise": "seeded",
}  # fmt: skip
ABOUT = {"state_dim": 3, "action_dim": 2, "planner": PLANNER, "target": None}


DIFFUSER = {
    "kind": "diffuser", "horizon": 8, "width": 8, "multiples": [1, 2], "steps": 1,
    "return_model": None, "candidates": 1, "noise": "seeded",
}  # fmt: skip
planners = pytest.mark.parametrize("planner", [PLANNER, DIFFUSER], ids=["lite", "diffuser"])


def make_policy(planner=PLANNER):
    torch.manual_seed(0)
    policy = build_policy({**ABOUT, "planner": planner})
    for parameter in policy[-1].networks.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return policy


def planned_actions(policy, state):
    """All actions of the plan for one state [1, S], from the planner alone."""
    planner = copy.copy(policy[-1])
    told = TensorDict({"observation": state}, [1])
    if planner.most_outputs == 3:
        planner.out_keys = ["plan", "action", "actions"]
        return planner(told)["actions"]
    plan = planner(told)["plan"]
    return planner.inverse_dynamics(plan[:, :-1], plan[:, 1:])


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


@planners
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), interval=st.integers(1, 4))
def test_each_row_plans_on_its_own_clock(planner, seed, interval):
    policy = make_policy(planner)
    generator = torch.Generator().manual_seed(seed)
    states = torch.randn(11, 3, 3, generator=generator)
    starts = torch.rand(11, 3, generator=generator) < 0.2
    starts[0] = True
    found = drive(with_replanning(policy, interval), states, starts)
    assert policy[-1].out_keys == ["plan", "action"]
    for row in range(3):
        since, actions = 0, None
        for step in range(11):
            if starts[step, row] or since == interval:
                since, actions = 0, planned_actions(policy, states[step, row : row + 1])
            expected = actions[0, since]
            torch.testing.assert_close(found[step, row], expected, atol=1e-5, rtol=1e-4)
            since += 1


@planners
def test_planning_at_each_step_is_the_policy(planner):
    policy, states = make_policy(planner), torch.randn(5, 2, 3)
    starts = torch.zeros(5, 2, dtype=torch.bool)
    starts[0] = True
    found = drive(with_replanning(policy, 1), states, starts)
    torch.testing.assert_close(found, drive(policy, states, starts))


@pytest.fixture
def database():
    """Two episodes of 20 steps along the first entry of the state."""
    steps = torch.arange(40)
    state = torch.stack([steps % 20, steps // 20, torch.zeros(40)], -1).float()
    sampler = RetrievalSampler("euclidean", k=4, threshold=0.1)
    database = ExpertDatabase(LazyTensorStorage(40), sampler=sampler)
    database.extend(episodes(state, [20, 20], rewards=(steps % 20 == 19).float()))
    return database


@planners
def test_what_was_retrieved_for_a_plan_is_written_as_long_as_it_lasts(planner, database):
    about = {"rule": "highest", "horizon": 4}
    torch.manual_seed(0)
    settings = {**ABOUT, "planner": planner, "target": about, "estimator": {"width": 8}}
    policy = build_policy(settings, database)
    states = torch.stack([torch.arange(6.0), torch.zeros(6), torch.zeros(6)], -1)
    states = torch.stack([states, states + 7.0], 1)  # [T, B, S]
    states[2:4, 0] = 1e6  # no neighbour there
    expected = torch.stack([policy(TensorDict({"observation": s}, [2])) for s in states])
    assert [bool(expected[step]["found"][0]) for step in (0, 3)] == [True, False]
    acting, td, found = with_replanning(policy, 3), TensorDict({}, [2]), []
    for step, state in enumerate(states):
        td["observation"], td["is_init"] = state, torch.full((2, 1), step == 0)
        td = acting(td)
        found.append(td.clone())
    for step in range(6):
        for key in (*policy[0].out_keys, *policy[1].out_keys):
            told = expected[step - step % 3][key]
            torch.testing.assert_close(found[step][key], told, equal_nan=True, rtol=0, atol=0)


@pytest.mark.parametrize("interval", [0, -1, 5])
def test_plans_that_do_not_reach_so_far(interval):
    with pytest.raises(ValueError, match=rf"interval is {interval}; expected 1 to 4"):
        with_replanning(make_policy(), interval)


def test_plans_of_a_diffuser_reach_their_horizon():
    with pytest.raises(ValueError, match="interval is 9; expected 1 to 8, the steps of a plan"):
        with_replanning(make_policy(DIFFUSER), 9)


def test_all_actions_of_a_plan_on_demand():
    planner = make_policy(DIFFUSER)[-1]
    planner.out_keys = ["plan", "action", "actions"]
    out = planner(TensorDict({"observation": torch.randn(2, 5, 3)}, [2, 5]))
    assert out["actions"].shape == (2, 5, 8, 2) and out["actions"].abs().max() <= planner.bound
    assert torch.equal(out["actions"][..., 0, :], out["action"])
    with pytest.raises(ValueError, match="expected one and two, in the order of the table"):
        build_policy({**ABOUT, "planner": {**PLANNER, "out_keys": ["plan", "action", "actions"]}})


@planners
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
def test_under_autocast_actions_are_float32_as_environments_take_them(planner, dtype):
    policy = with_replanning(make_policy(planner), 3)
    told = {"observation": torch.randn(2, 3), "is_init": torch.ones(2, 1, dtype=torch.bool)}
    with torch.autocast("cpu", dtype):
        out = policy(TensorDict(told, [2]))
    assert out["action"].dtype == torch.float32
