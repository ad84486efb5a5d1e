import copy
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.step import StepEstimator
from torchrl_rad.objectives import StepEstimationLoss, draw_step_pairs

DIM, HORIZON = 2, 5
KEYS = ["observation", "target", "target_step"]


def make(seed=0, reduction=None, **kwargs):
    torch.manual_seed(seed)
    states = Normalizer(torch.ones(DIM), torch.full((DIM,), 2.0))
    estimator = StepEstimator(states, HORIZON, width=16, **kwargs)
    return StepEstimationLoss(estimator, reduction=reduction)


def pairs(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    state, target = torch.randn(2, *shape, DIM, generator=generator)
    step = torch.randint(1, HORIZON, (*shape, 1), generator=generator)
    return TensorDict({"observation": state, "target": target, "target_step": step}, shape)


def logits(loss, td):
    with torch.no_grad(), loss.estimator_params.to_module(loss.estimator):
        return loss.estimator.logits(td["observation"], td["target"])


# the pairs


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(1, 50), horizon=st.integers(2, 40), more=st.integers(0, 9),
    pairs=st.integers(1, 4), seed=st.integers(0, 1000),
)  # fmt: skip
def test_pairs_lie_inside_one_window(count, horizon, more, pairs, seed):
    rows = 1000.0 * torch.arange(count)[:, None]
    windows = (rows + torch.arange(horizon + more))[..., None]
    generator = torch.Generator().manual_seed(seed)
    drawn = draw_step_pairs(windows, generator, horizon=horizon, pairs=pairs)
    assert drawn.batch_size == (count * pairs,) and drawn["target_step"].dtype == torch.int64
    rows = rows.repeat_interleave(pairs, 0)
    begin, end = drawn["observation"] - rows, drawn["target"] - rows
    assert ((begin >= 0) & (end <= horizon + more - 1)).all()
    assert torch.equal(end - begin, drawn["target_step"].float())
    assert ((drawn["target_step"] >= 1) & (drawn["target_step"] <= horizon - 1)).all()


def test_steps_and_starts_are_uniform():
    windows = torch.arange(5.0)[None, :, None].expand(40_000, 5, 1)
    drawn = draw_step_pairs(windows, torch.Generator().manual_seed(0))
    step, begin = drawn["target_step"].squeeze(-1), drawn["observation"].squeeze(-1).long()
    for i in range(1, 5):
        assert abs(int((step == i).sum()) - 10_000) < 400  # 4.6 standard deviations
        room = 5 - i
        share = torch.bincount(begin[step == i], minlength=room) / int((step == i).sum())
        assert len(share) == room
        torch.testing.assert_close(share, torch.full((room,), 1 / room), atol=0.03, rtol=0)


def test_windows_shorter_than_the_horizon():
    with pytest.raises(ValueError, match="windows of 9 states hold no pairs up to 32 steps apart"):
        draw_step_pairs(torch.zeros(2, 9, 3), horizon=33)


def test_no_pairs():
    with pytest.raises(ValueError, match="pairs is 0; expected one or more"):
        draw_step_pairs(torch.zeros(2, 9, 3), pairs=0)


def test_pairs_follow_the_generator():
    windows = torch.randn(20, 9, 2)
    first, second = (
        draw_step_pairs(windows, torch.Generator().manual_seed(seed)) for seed in (1, 1)
    )
    assert (first == second).all()
    state = torch.get_rng_state()
    draw_step_pairs(windows, torch.Generator().manual_seed(1))
    assert torch.equal(torch.get_rng_state(), state)


# the formula


@pytest.mark.parametrize("activation", ["softmax", "sigmoid"])
def test_value_by_hand(activation):
    loss, td = make(reduction="none", activation=activation), pairs(6)
    out, scores = loss(td)["loss_step"], logits(loss, td).tolist()
    for row in range(6):
        true = int(td["target_step"][row]) - 1
        if activation == "softmax":
            expected = math.log(sum(map(math.exp, scores[row]))) - scores[row][true]
        else:
            chances = [1 / (1 + math.exp(-score)) for score in scores[row]]
            expected = -sum(
                math.log(chance if c == true else 1 - chance) for c, chance in enumerate(chances)
            )
        assert float(out[row]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("estimate", ["mode", "recorded"])
def test_error_in_steps(estimate):
    loss, td = make(estimate=estimate), pairs(6)
    wrong = (logits(loss, td).argmax(-1) + 1 - td["target_step"].squeeze(-1)).abs()
    torch.testing.assert_close(loss(td)["step_error"], wrong.float().mean())


# TorchRL's checklist


def test_reset_parameters_recursive():
    loss = make()
    before = loss.estimator_params.clone()
    loss.reset_parameters_recursive()
    assert not torch.equal(
        loss.estimator_params["net", "0", "weight"], before["net", "0", "weight"]
    )
    assert float(loss.estimator_params["normalizer", "deviation"][0]) == 2.0


def test_accepted_keys():
    loss = make()
    for name in KEYS:
        assert getattr(loss.tensor_keys, name) == name
        loss.set_keys(**{name: ("deep", name)})
        assert ("deep", name) in loss.in_keys and name not in loss.in_keys
        loss.set_keys(**{name: None})
        assert loss.in_keys == KEYS
    with pytest.raises(ValueError, match="reward"):
        loss.set_keys(reward="r")


def test_keys_of_the_estimator_do_not_matter():
    td = pairs(6)
    renamed = make(in_keys=["s", "g"], out_keys=[("o", "i")])
    assert torch.equal(renamed(td)["loss_step"], make()(td)["loss_step"])


def test_nested_keys_give_the_same_loss():
    td, loss = pairs(6), make()
    plain = loss(td)["loss_step"]
    nested = TensorDict({"deep": td.clone()}, [6])
    loss.set_keys(**{name: ("deep", name) for name in KEYS})
    assert torch.equal(loss(nested)["loss_step"], plain)


@pytest.mark.parametrize("nested", [False, True])
def test_dispatch(nested):
    td, loss = pairs(6), make()
    out = loss(td)
    if nested:
        loss.set_keys(**{name: ("deep", name) for name in KEYS})
    given = {f"deep_{name}" if nested else name: td[name] for name in KEYS}
    for key, value in zip(loss.out_keys, loss(**given), strict=True):
        assert torch.equal(out[key], value)
    loss.select_out_keys("loss_step")
    assert torch.equal(loss(**given), out["loss_step"])


@pytest.mark.parametrize("activation", ["softmax", "sigmoid"])
@pytest.mark.parametrize("shape", [(), (1,), (6,), (2, 3)])
@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
def test_reduction(activation, shape, reduction):
    td = pairs(*shape)
    each = make(reduction="none", activation=activation)(td)["loss_step"]
    assert each.shape == shape
    out = make(reduction=reduction, activation=activation)(td)
    expected = {"none": each, "sum": each.sum()}.get(reduction, each.mean())
    torch.testing.assert_close(out["loss_step"], expected)
    assert out["step_error"].shape == () and not out["step_error"].requires_grad


@pytest.mark.parametrize("activation", ["softmax", "sigmoid"])
@pytest.mark.parametrize("key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("last", [False, True])
def test_masked_pairs_do_not_count(activation, key, last):
    td, counted = pairs(6), torch.tensor([True, False, True, True, False, True])
    each = make(reduction="none", activation=activation)(td)["loss_step"].detach()
    td[key] = counted[:, None] if last else counted
    td["observation"][~counted] = torch.nan
    td["target"][1] = torch.inf
    td["target_step"][~counted] = -1000
    loss = make(activation=activation)
    out = loss(td)
    torch.testing.assert_close(out["loss_step"], each[counted].mean())
    errors = logits(loss, pairs(6)).argmax(-1) + 1 - pairs(6)["target_step"].squeeze(-1)
    torch.testing.assert_close(out["step_error"], errors[counted].abs().float().mean())
    out["loss_step"].backward()
    assert all(p.grad.isfinite().all() and p.grad.any() for p in loss.parameters())


def test_mask_can_be_switched_off():
    td, loss = pairs(6), make()
    td["collector", "mask"] = torch.zeros(6, dtype=torch.bool)
    loss.loss_mask_key = None
    assert torch.equal(loss(td)["loss_step"], make()(pairs(6))["loss_step"])


def test_input_is_not_changed():
    td = pairs(6)
    before = td.clone()
    make()(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True)) and (td == before).all()


def test_gradients_reach_the_estimator_alone():
    loss = make()
    loss(pairs(6))["loss_step"].backward()
    for name, parameter in loss.named_parameters():
        assert name.startswith("estimator_params.") and parameter.grad.any(), name
    assert {id(p) for p in loss.parameters()} == {id(p) for p in loss.estimator.parameters()}


def test_state_dict():
    loss, other, td = make(0), make(1), pairs(6)
    assert not torch.equal(other(td)["loss_step"], loss(td)["loss_step"])
    other.load_state_dict(loss.state_dict())
    assert torch.equal(other(td)["loss_step"], loss(td)["loss_step"])


def test_deepcopy():
    loss, td = make(), pairs(6)
    other = copy.deepcopy(loss)
    assert torch.equal(other(td)["loss_step"], loss(td)["loss_step"])
    for parameter in other.parameters():
        parameter.data.zero_()
    assert not torch.equal(other(td)["loss_step"], loss(td)["loss_step"])


def test_double_precision():
    loss, td = make(), pairs(6)
    single = loss(td)["loss_step"]
    double = loss.to(torch.float64)(td)["loss_step"]
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("activation", ["softmax", "sigmoid"])
def test_overfits_a_tiny_batch(activation):
    loss, td = make(activation=activation), pairs(8)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-2)
    losses = []
    for _ in range(150):
        optimizer.zero_grad()
        value = loss(td)["loss_step"]
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    assert losses[-1] < 0.1 * losses[0]
    # the trained estimator then gives the true steps
    assert torch.equal(loss.estimator(td.clone())["target_step"], td["target_step"])


def test_torch_compile():
    loss, td = make(), pairs(6)
    expected = loss(td)
    compiled = torch.compile(loss, backend="eager")(td)
    for key in loss.out_keys:
        torch.testing.assert_close(compiled[key], expected[key])
    torch._dynamo.reset()


def test_bfloat16_autocast_is_close():
    loss, td = make(), pairs(64)
    exact = loss(td)["loss_step"]
    with torch.autocast("cpu", torch.bfloat16):
        value = loss(td)["loss_step"]
    value.backward()
    torch.testing.assert_close(value.float(), exact, rtol=0.02, atol=0.0)
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize("key", KEYS)
def test_missing_key(key):
    with pytest.raises(KeyError, match=key):
        make()(pairs(4).exclude(key))


def test_wrong_width():
    td = pairs(4)
    td["target"] = torch.zeros(4, DIM + 1)
    with pytest.raises(ValueError, match=r"'target' is \(4, 3\); expected states of 2 entries"):
        make()(td)
