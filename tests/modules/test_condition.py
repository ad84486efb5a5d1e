"""The return that a plan is asked to have, and networks that are told it."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_rad import DenoisingLoss, DiffuserLitePlanner, InverseDynamics, Normalizer
from torchrl_rad.modules.condition import ReturnCondition
from torchrl_rad.modules.dit import DiT
from torchrl_rad.modules.frozen import FrozenDiT, PlainNetwork
from torchrl_rad.policy import build_policy, fit_scales, load_policy, save_policy, with_goals

HORIZON, JUMPS = 9, (4, 1)


def make_planner(condition=0.5, **options):
    states = Normalizer.identity(2)
    inverse = InverseDynamics(states, states, 1)
    options = {"width": 16, "heads": 2, "blocks": 1, "noise": "zero", **options}
    planner = DiffuserLitePlanner(states, inverse, HORIZON, JUMPS, condition=condition, **options)
    torch.manual_seed(0)
    for parameter in planner.networks.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return planner


def plan(planner):
    rows = {
        "observation": torch.ones(3, 2),
        "target": torch.zeros(3, 2),
        "found": torch.zeros(3, 1, dtype=torch.bool),
        "target_step": torch.ones(3, 1, dtype=torch.int64),
        "target_index": torch.full((3, 1), -1),
    }
    return planner(TensorDict(rows, [3]))["plan"]


# what is wanted


@given(st.lists(st.floats(-100, 100, width=32), min_size=1), st.floats(0, 1))
def test_the_wanted_return_is_one_of_the_recorded(returns, share):
    condition = ReturnCondition([share]).fit(torch.tensor(returns))
    wanted = float(condition.wanted)
    assert wanted in returns
    below = sum(value < wanted for value in returns) / len(returns)
    above = sum(value > wanted for value in returns) / len(returns)
    assert below <= share + 1 / len(returns) and above <= 1 - share + 1 / len(returns)


def test_values_by_hand():
    condition = ReturnCondition([0.75]).fit(torch.tensor([[0.0], [4.0], [0.0], [4.0], [2.0]]))
    assert float(condition.wanted) == 4.0  # the fourth of five
    assert float(condition.mean) == 2.0
    assert float(condition.deviation) == pytest.approx(3.2**0.5)
    assert condition(torch.tensor([2.0, 2.0 + 3.2**0.5])).tolist() == pytest.approx([0.0, 1.0])


def test_equal_returns_have_a_scale():
    condition = ReturnCondition([0.9, 0.1]).fit(torch.ones(4))
    assert condition().tolist() == [0.0, 0.0]


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_that_is_none(share):
    with pytest.raises(ValueError, match="share of returns below the wanted one is"):
        ReturnCondition([0.5, share])


@pytest.mark.parametrize("returns", [[], [1.0, float("nan")], [float("inf")]])
def test_returns_that_are_none(returns):
    with pytest.raises(ValueError, match="expected finite returns"):
        ReturnCondition([0.5]).fit(torch.tensor(returns))


# networks


def test_a_network_in_its_frozen_form_is_told_the_same():
    torch.manual_seed(0)
    network = DiT(3, tokens=5, width=16, heads=2, conditioned=True)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    x, mask = torch.randn(4, 5, 3), torch.rand(4, 5, 1) > 0.5
    told, other = torch.tensor([1.5]), torch.tensor([-1.0])
    with torch.no_grad():
        expected = network(x, mask, torch.tensor([0.5]), condition=told)
        for kind in (FrozenDiT, PlainNetwork):
            fixed = kind(network, [1.0, 0.5], None, told)
            predicted = fixed(x, fixed.prepare(mask), 1, slice(0, 5))
            assert torch.allclose(predicted, expected, atol=1e-5)
        changed = network(x, mask, torch.tensor([0.5]), condition=other)
    assert (changed - expected).abs().max() > 0.01


def test_rows_are_told_their_own():
    network = DiT(3, tokens=5, width=16, heads=2, conditioned=True)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    x, mask, time = torch.randn(2, 5, 3), torch.zeros(2, 5, 1).bool(), torch.rand(2)
    told = torch.tensor([0.3, -2.0])
    both = network(x, mask, time, condition=told)
    for row in range(2):
        part = slice(row, row + 1)
        alone = network(x[part], mask[part], time[part], condition=told[part])
        assert torch.allclose(both[part], alone, atol=1e-5)


# planners


def test_plans_depend_on_the_wanted_return_also_after_the_first():
    planner = make_planner()
    planner.condition.fit(torch.arange(5.0))
    before = plan(planner)
    planner.condition.shares = (1.0, 1.0)
    after = plan(planner)
    assert (after - before).abs().max() > 0.01
    planner.condition.shares = (0.5, 0.5)
    assert torch.allclose(plan(planner), before)


def test_levels_are_told_returns_of_their_own():
    planner = make_planner([0.5, 1.0])
    planner.condition.fit(torch.arange(5.0))
    assert planner.condition.wanted.tolist() == [2.0, 4.0]
    own, high = plan(planner), plan(make_planner_like(planner, 1.0))
    low = plan(make_planner_like(planner, 0.5))
    first = planner.plan_times % JUMPS[0] == 0
    assert torch.equal(own[:, first], low[:, first])
    assert (own - low)[:, ~first].abs().max() > 0.01
    assert (own - high)[:, first].abs().max() > 0.01


def make_planner_like(planner, condition):
    other = make_planner(condition)
    other.load_state_dict(planner.state_dict())
    return other


def test_as_many_shares_as_levels():
    with pytest.raises(ValueError, match=r"condition is \[0.5, 0.6, 0.7\]; .* the 2 levels"):
        make_planner([0.5, 0.6, 0.7])


def test_without_a_condition_there_are_no_weights_for_one():
    names = {name for name, _ in make_planner(condition=None).named_parameters()}
    assert not any("condition" in name for name in names)
    more = {name for name, _ in make_planner().named_parameters()} - names
    assert more and all(".condition." in name for name in more)


def windows(count=6):
    torch.manual_seed(1)
    states, values = torch.randn(count, HORIZON, 2), torch.randn(count, HORIZON)
    return TensorDict({"observation": states, "return_to_go": values}, [count])


def test_the_loss_tells_each_piece_the_return_where_it_begins():
    """The finer level's pieces begin anywhere in their window."""
    planner = make_planner()
    planner.condition.fit(torch.arange(10.0))
    loss, batch = DenoisingLoss(planner), windows()
    told = []
    for network in planner.networks:
        network.register_forward_pre_hook(
            lambda _, args, kwargs: told.append(kwargs["condition"]), with_kwargs=True
        )
    torch.manual_seed(2)
    loss(batch)
    torch.manual_seed(2)
    begin = loss.pieces(0, batch["observation"])[2]
    assert begin.tolist() == [0] * 6
    assert torch.equal(told[0], planner.condition(batch["return_to_go"][:, 0]))
    starts = planner.condition(batch["return_to_go"])  # [6, H]
    assert (told[1][:, None] == starts).any(1).all()
    assert not torch.equal(told[1], told[0])


def test_in_keys_of_the_loss():
    assert DenoisingLoss(make_planner()).in_keys == ["observation", "return_to_go"]
    assert DenoisingLoss(make_planner(condition=None)).in_keys == ["observation"]
    loss = DenoisingLoss(make_planner())
    loss.set_keys(value=("next", "value"))
    assert loss.in_keys == ["observation", ("next", "value")]


def test_returns_in_both_shapes_and_under_a_mask():
    loss, batch = DenoisingLoss(make_planner(), reduction="none"), windows()
    torch.manual_seed(3)
    flat = loss(batch)["loss_denoising"]
    batch["return_to_go"] = batch["return_to_go"][..., None]
    torch.manual_seed(3)
    assert torch.equal(loss(batch)["loss_denoising"], flat)
    batch["return_to_go"][0] = float("nan")
    batch["collector", "mask"] = torch.arange(6) > 0
    loss.reduction = "mean"
    out = loss(batch)["loss_denoising"]
    out.backward()
    assert out.isfinite()
    grads = [p.grad for p in loss.parameters() if p.grad is not None]
    assert grads and all(grad.isfinite().all() for grad in grads)


def test_missing_returns():
    batch = windows().exclude("return_to_go")
    with pytest.raises(KeyError, match="return_to_go.* is missing .* is told returns"):
        DenoisingLoss(make_planner())(batch)


# policies

DESCRIPTION = {
    "state_dim": 2,
    "action_dim": 1,
    "planner": {
        "horizon": HORIZON, "jumps": JUMPS, "width": 16, "heads": 2, "candidates": 1,
        "condition": 0.9,
    },
    "target": None,
}  # fmt: skip


def data():
    torch.manual_seed(0)
    states, episode = torch.randn(40, 2), torch.arange(40) // 20
    returns = torch.arange(40.0)
    return TensorDict(
        {
            "observation": states,
            "next": {"observation": states},
            "episode": episode,
            "return_to_go": returns,
        },
        [40],
    )


def test_the_wanted_return_is_fitted_and_saved(tmp_path):
    policy = build_policy(DESCRIPTION)
    fit_scales(policy, data())
    assert policy[-1].condition.wanted.tolist() == [35.0, 35.0]  # round(0.9 x 39)
    save_policy(tmp_path / "policy", policy, DESCRIPTION)
    again = load_policy(tmp_path / "policy")
    state = TensorDict({"observation": torch.randn(2, 2)}, [2])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(policy(state.clone())["plan"], again(state.clone())["plan"])
    assert again[-1].condition.wanted.tolist() == [35.0, 35.0]


def test_it_has_no_other_goals():
    parts = [torch.nn.Identity(), torch.nn.Identity(), make_planner()]
    with pytest.raises(ValueError, match="told returns, which are of the goal it was trained for"):
        with_goals(parts, None)
