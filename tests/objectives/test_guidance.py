import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.objectives import ReturnGuidanceLoss, plan_return

DIM, HORIZON, JUMP = 2, 9, 4
DEFAULTS = {"observation": "observation", "reward": ("next", "reward"), "value": "return_to_go"}


def make(seed=0, **kwargs):
    torch.manual_seed(seed)
    model = ReturnModel(Normalizer(torch.ones(DIM), torch.full((DIM,), 2.0)), 3, width=16)
    model.fit_scale(torch.tensor([1.0, 5.0]))
    return ReturnGuidanceLoss(model, **{"jump": JUMP, "gamma": 0.9, **kwargs})


def windows(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.randn(*shape, HORIZON, DIM, generator=generator),
            "next": {"reward": torch.randn(*shape, HORIZON, 1, generator=generator)},
            "return_to_go": torch.randn(*shape, HORIZON, generator=generator),
        },
        shape,
    )


# C(tau)


def test_plan_return_by_hand():
    # 1 + 0.5 * 2 + 0.25 * 3, and 0.5^3 V for the last state, whose own reward is not counted
    reward = torch.tensor([[1.0, 2.0, 3.0, 1000.0]])
    assert float(plan_return(reward, torch.tensor([8.0]), 0.5)) == 1 + 1 + 0.75 + 1


@pytest.mark.parametrize("gamma", [0.0, 1.0])
def test_plan_return_at_the_ends_of_gamma(gamma):
    value = plan_return(torch.tensor([1.0, 2.0, 3.0]), torch.tensor(8.0), gamma)
    assert float(value) == {0.0: 1.0, 1.0: 1 + 2 + 8}[gamma]


@settings(max_examples=30, deadline=None)
@given(
    length=st.integers(2, 30),
    episode=st.integers(1, 30),
    gamma=st.floats(0.5, 1.0),
    seed=st.integers(0, 100),
)
def test_with_the_true_value_it_is_the_return_of_the_whole_episode(length, episode, gamma, seed):
    rewards = torch.randn(length + episode, generator=torch.Generator().manual_seed(seed))
    to_go = torch.zeros(length + episode + 1, dtype=torch.float64)
    for step in reversed(range(length + episode)):
        to_go[step] = rewards[step] + gamma * to_go[step + 1]
    got = plan_return(rewards[:length], to_go[length - 1].float(), gamma)
    assert float(got) == pytest.approx(float(to_go[0]), abs=1e-4, rel=1e-4)


def test_value_by_hand():
    loss, td = make(reduction="none"), windows(5)
    out = loss(td)
    model = loss.return_model
    reward, value = td["next", "reward"].squeeze(-1), td["return_to_go"]
    for row in range(5):
        target = sum(0.9**t * float(reward[row, t]) for t in range(HORIZON - 1))
        target += 0.9 ** (HORIZON - 1) * float(value[row, -1])
        with loss.return_model_params.to_module(model):
            predicted = float(model(td["observation"][row, [0, 4, 8]]))
        # the deviation of the returns 1 and 5 is 2
        expected = ((predicted - target) / 2.0) ** 2
        assert float(out["loss_guidance"][row]) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_error_is_in_units_of_return():
    out = make(reduction="none")(windows(5))
    expected = 2.0 * out["loss_guidance"].sqrt().mean()
    torch.testing.assert_close(out["return_error"], expected.detach())


def test_values_may_have_a_last_dimension():
    td = windows(5)
    flat = make()(td)["loss_guidance"]
    td["return_to_go"] = td["return_to_go"][..., None]
    assert torch.equal(make()(td)["loss_guidance"], flat)


# TorchRL's checklist


def test_reset_parameters_recursive():
    loss = make()
    before = loss.return_model_params.clone()
    loss.reset_parameters_recursive()
    assert not torch.equal(
        loss.return_model_params["net", "0", "weight"], before["net", "0", "weight"]
    )
    assert float(loss.return_model_params["deviation"]) == 2.0


def test_accepted_keys():
    loss = make()
    for name, default in DEFAULTS.items():
        assert getattr(loss.tensor_keys, name) == default
        loss.set_keys(**{name: ("deep", name)})
        assert ("deep", name) in loss.in_keys and default not in loss.in_keys
        loss.set_keys(**{name: None})
        assert loss.in_keys == list(DEFAULTS.values())
    with pytest.raises(ValueError, match="action"):
        loss.set_keys(action="a")


def test_nested_keys_give_the_same_loss():
    td, loss = windows(5), make()
    plain = loss(td)["loss_guidance"]
    nested = TensorDict({}, [5])
    for name, default in DEFAULTS.items():
        nested["deep", name] = td[default]
        loss.set_keys(**{name: ("deep", name)})
    assert torch.equal(loss(nested)["loss_guidance"], plain)


def test_dispatch():
    td, loss = windows(5), make()
    out = loss(td)
    given = {
        "observation": td["observation"],
        "next_reward": td["next", "reward"],
        "return_to_go": td["return_to_go"],
    }
    for key, value in zip(loss.out_keys, loss(**given), strict=True):
        assert torch.equal(out[key], value)
    loss.select_out_keys("loss_guidance")
    assert torch.equal(loss(**given), out["loss_guidance"])


@pytest.mark.parametrize("shape", [(), (6,), (2, 3)])
@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
def test_reduction(shape, reduction):
    td = windows(*shape)
    each = make(reduction="none")(td)["loss_guidance"]
    assert each.shape == shape
    out = make(reduction=reduction)(td)
    expected = {"none": each, "sum": each.sum()}.get(reduction, each.mean())
    torch.testing.assert_close(out["loss_guidance"], expected)
    assert out["return_error"].shape == () and not out["return_error"].requires_grad


@pytest.mark.parametrize("key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("steps", [False, True])
def test_masked_windows_do_not_count(key, steps):
    td, counted = windows(6), torch.tensor([True, False, True, True, False, True])
    each = make(reduction="none")(td)["loss_guidance"].detach()
    td[key] = counted[:, None].repeat(1, HORIZON) if steps else counted
    for name in DEFAULTS.values():
        td[name][~counted] = torch.nan
    loss = make()
    out = loss(td)
    torch.testing.assert_close(out["loss_guidance"], each[counted].mean())
    torch.testing.assert_close(out["return_error"], 2.0 * each[counted].sqrt().mean())
    out["loss_guidance"].backward()
    assert all(p.grad.isfinite().all() and p.grad.any() for p in loss.parameters())


def test_mask_can_be_switched_off():
    td, loss = windows(6), make()
    td["collector", "mask"] = torch.zeros(6, dtype=torch.bool)
    loss.loss_mask_key = None
    assert torch.equal(loss(td)["loss_guidance"], make()(windows(6))["loss_guidance"])


def test_input_is_not_changed():
    td = windows(6)
    before = td.clone()
    make()(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True)) and (td == before).all()


def test_gradients_reach_the_return_model_alone():
    loss = make()
    loss(windows(6))["loss_guidance"].backward()
    for name, parameter in loss.named_parameters():
        assert name.startswith("return_model_params.") and parameter.grad.any(), name
    assert {id(p) for p in loss.parameters()} == {id(p) for p in loss.return_model.parameters()}


def test_state_dict_holds_the_scale():
    loss, other = make(0), make(1)
    other.return_model_params["mean"].data.fill_(50.0)
    td = windows(6)
    assert not torch.equal(other(td)["loss_guidance"], loss(td)["loss_guidance"])
    other.load_state_dict(loss.state_dict())
    assert torch.equal(other(td)["loss_guidance"], loss(td)["loss_guidance"])


def test_deepcopy():
    loss, td = make(), windows(6)
    other = copy.deepcopy(loss)
    assert torch.equal(other(td)["loss_guidance"], loss(td)["loss_guidance"])
    for parameter in other.parameters():
        parameter.data.zero_()
    assert not torch.equal(other(td)["loss_guidance"], loss(td)["loss_guidance"])


def test_double_precision():
    loss, td = make(), windows(6)
    single = loss(td)["loss_guidance"]
    double = loss.to(torch.float64)(td.double())["loss_guidance"]
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, rtol=1e-5, atol=1e-6)


def test_overfits_a_tiny_batch():
    loss, td = make(), windows(8)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    losses = []
    for _ in range(150):
        optimizer.zero_grad()
        value = loss(td)["loss_guidance"]
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    assert losses[-1] < 0.01 * losses[0]


def test_torch_compile():
    loss, td = make(), windows(6)
    expected = loss(td)
    compiled = torch.compile(loss, backend="eager")(td)
    for key in loss.out_keys:
        torch.testing.assert_close(compiled[key], expected[key])
    torch._dynamo.reset()


def test_bfloat16_autocast_is_close():
    loss, td = make(), windows(64)
    exact = loss(td)["loss_guidance"]
    with torch.autocast("cpu", torch.bfloat16):
        value = loss(td)["loss_guidance"]
    value.backward()
    torch.testing.assert_close(value.float(), exact, rtol=0.02, atol=0.0)
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize("name", list(DEFAULTS))
def test_missing_key(name):
    key = DEFAULTS[name]
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
        make()(windows(4).exclude(key))


def test_windows_that_do_not_fit_the_model():
    with pytest.raises(
        ValueError, match=r"expected windows \[\*B, 9, S\]: 3 states, 4 steps apart"
    ):
        make()(windows(4).apply(lambda x: x[:, :8]))


@pytest.mark.parametrize("jump", [0, -1])
def test_bad_jump(jump):
    with pytest.raises(ValueError, match=f"jump is {jump}; expected 1 or more"):
        make(jump=jump)
