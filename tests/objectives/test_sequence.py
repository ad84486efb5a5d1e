import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_rad.modules.diffuser import DiffuserPlanner
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.objectives import SequenceDenoisingLoss, SequenceGuidanceLoss, plan_return
from torchrl_rad.objectives.sequence import draw_pins
from torchrl_rad.training import Objective

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")

DIM, ACTIONS, HORIZON = 2, 1, 8
SEQUENCE = {"observation": "observation", "action": "action"}
RETURNS = {"reward": ("next", "reward"), "value": "return_to_go"}
KEYS = {SequenceDenoisingLoss: SEQUENCE, SequenceGuidanceLoss: {**SEQUENCE, **RETURNS}}
LOSSES = list(KEYS)
MAIN = {SequenceDenoisingLoss: "loss_denoising", SequenceGuidanceLoss: "loss_guidance"}
FIRST = {
    SequenceDenoisingLoss: ("network_params", ("0", "head", "weight")),
    SequenceGuidanceLoss: ("return_model_params", ("mix", "weight")),
}


def make_planner(seed=0, **kwargs):
    torch.manual_seed(seed)
    states = Normalizer(torch.tensor([1.0, -3.0]), torch.tensor([2.0, 0.5]))
    model = NoisyReturnModel(states, ACTIONS, HORIZON, 8, (1, 2))
    model.fit_scale(torch.tensor([1.0, 5.0]))
    options = {"width": 8, "multiples": (1, 2), "return_model": model}
    return DiffuserPlanner(states, ACTIONS, HORIZON, **{**options, **kwargs})


def make(kind, seed=0, planner=None, **kwargs):
    return kind(planner or make_planner(seed), **kwargs)


def windows(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*size):
        return torch.randn(*shape, HORIZON, *size, generator=generator)

    entries = {"observation": draw(DIM), "action": draw(ACTIONS), "return_to_go": draw()}
    return TensorDict({**entries, "next": {"reward": draw(1)}}, shape)


def run(loss, td, seed=0):
    torch.manual_seed(seed)
    return loss(td)


# pins


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_pins(share):
    torch.manual_seed(0)
    mask = draw_pins(7000, HORIZON, share, torch.device("cpu")).squeeze(-1)
    assert mask[:, 0].all()
    pinned = mask[:, 1:].float()
    assert set(pinned.sum(-1).tolist()) == {0.0: {1.0}, 0.3: {0.0, 1.0}, 1.0: {0.0}}[share]
    # uniform over 1 to H - 1
    assert pinned.mean(0).tolist() == pytest.approx([(1 - share) / 7] * 7, abs=0.02)


class Stub(torch.nn.Module):
    """In place of the networks: predicts ``value`` and keeps its inputs."""

    def __init__(self, value):
        super().__init__()
        self.value, self.calls = value, []

    def forward(self, level, sample, mask, time):
        self.calls.append((sample, mask, time))
        return torch.full_like(sample, self.value)


class _NoParams(torch.nn.Module):
    def to_module(self, module):
        return torch.no_grad()


@pytest.mark.parametrize("no_target", [0.0, 1.0])
def test_denoising_by_hand(no_target):
    # clean entries are 0 and the prediction is 2: every unknown entry has the error 4
    loss = make(SequenceDenoisingLoss, no_target=no_target, action_weight=10.0, reduction="none")
    loss.__dict__["network"], loss.network_params = Stub(2.0), _NoParams()
    td = windows(40)
    td["observation"] = torch.tensor([1.0, -3.0]).expand_as(td["observation"])
    td["action"] = torch.zeros_like(td["action"])
    out = run(loss, td)
    ((sample, mask, time),) = loss.network.calls
    known = 1 if no_target else 2
    # 8 states of 2 entries, some known; 8 actions, the first of which counts ten times
    total = 4 * ((HORIZON - known) * DIM + HORIZON * ACTIONS + 9 * ACTIONS)
    assert out["loss_denoising"].tolist() == pytest.approx([total / (HORIZON * 3)] * 40)
    assert float(out["state_error"]) == pytest.approx(4 * (HORIZON - known) / HORIZON)
    assert float(out["action_error"]) == pytest.approx(4.0)
    assert (sample[..., :DIM][mask.expand(40, HORIZON, DIM)] == 0).all()
    assert (sample[..., DIM:] != 0).all() and (sample[..., :DIM][~mask.squeeze(-1)] != 0).all()
    assert mask.sum((1, 2)).tolist() == [known] * 40 and time.shape == (40,)


def test_noise_follows_the_process():
    loss, td, seen = make(SequenceDenoisingLoss, no_target=1.0), windows(2000), []
    loss.network.register_forward_hook(lambda module, args, out: seen.append(args))
    td["observation"] = torch.tensor([1.0, -3.0]).expand_as(td["observation"])  # 0 in their units
    td["action"] = torch.full_like(td["action"], 0.5)
    run(loss, td)
    ((_, sample, _, time),) = seen
    assert 0 <= time.min() < 0.01 and 0.99 < time.max() < 1
    alpha, sigma = loss.process.alpha_sigma(time[:, None])
    late = time > 0.05
    for noise in (sample[:, 1:, 0] / sigma, (sample[..., -1] - 0.5 * alpha) / sigma):
        noise = noise[late]
        assert abs(float(noise.mean())) < 0.03 and abs(float(noise.std()) - 1) < 0.03


def test_known_states_do_not_enter_the_gradient():
    loss, seen = make(SequenceDenoisingLoss, no_target=0.0, reduction="none"), []

    def spy(module, args, out):
        out.retain_grad()
        seen.append((args[2], out))

    loss.network.register_forward_hook(spy)
    run(loss, windows(30))["loss_denoising"].sum().backward()
    ((mask, out),) = seen
    known = torch.cat([mask.expand(30, HORIZON, DIM), torch.zeros(30, HORIZON, 1).bool()], -1)
    assert (out.grad[known] == 0).all() and (out.grad[~known] != 0).all()


def test_guidance_by_hand():
    loss, td = make(SequenceGuidanceLoss, gamma=0.9, reduction="none"), windows(5)
    seen, standardised = [], loss.return_model.standardised

    def spy(*args):
        seen.append((*args, standardised(*args).detach()))
        return standardised(*args)

    loss.return_model.standardised = spy
    out = run(loss, td)
    ((sample, mask, _, predicted),) = seen
    reward, value = td["next", "reward"].squeeze(-1), td["return_to_go"]
    for row in range(5):
        target = float(plan_return(reward[row], value[row, -1], 0.9))
        # the mean of the returns 1 and 5 is 3, their deviation 2
        expected = (float(predicted[row].detach()) - (target - 3.0) / 2.0) ** 2
        assert float(out["loss_guidance"][row].detach()) == pytest.approx(
            expected, rel=1e-4, abs=1e-5
        )
    torch.testing.assert_close(out["return_error"], 2 * out["loss_guidance"].sqrt().mean().detach())
    # known states are shown clean, in their units
    clean = (td["observation"] - torch.tensor([1.0, -3.0])) / torch.tensor([2.0, 0.5])
    known = mask.expand_as(clean)
    torch.testing.assert_close(sample[..., :DIM][known], clean[known])
    assert not torch.isclose(sample[..., :DIM], clean)[~known].any()


@pytest.mark.parametrize("kind", LOSSES)
def test_planner_without_targets_is_trained_without(kind):
    planner, seen = make_planner(targets=False), []
    loss = make(kind, planner=planner, no_target=0.0)
    name = "network" if kind is SequenceDenoisingLoss else "return_model"
    parts = {"network": planner.networks[0].encoder, "return_model": planner.return_model.encoder}
    parts[name].register_forward_pre_hook(lambda module, args: seen.append(args[0][:, -1]))
    run(loss, windows(300))
    assert seen[0].tolist() == [[1.0, *[0.0] * (HORIZON - 1)]] * 300  # the mask's channel


# TorchRL's checklist


@pytest.mark.parametrize("kind", LOSSES)
def test_reset_parameters_recursive(kind):
    loss, (name, key) = make(kind), FIRST[kind]
    before = getattr(loss, name).clone()
    loss.reset_parameters_recursive()
    assert not torch.equal(getattr(loss, name)[key], before[key])
    if kind is SequenceGuidanceLoss:
        assert float(loss.return_model_params["deviation"]) == 2.0


@pytest.mark.parametrize("kind", LOSSES)
def test_accepted_keys(kind):
    loss, defaults = make(kind), KEYS[kind]
    for name, default in defaults.items():
        assert getattr(loss.tensor_keys, name) == default
        loss.set_keys(**{name: ("deep", name)})
        assert ("deep", name) in loss.in_keys and default not in loss.in_keys
        loss.set_keys(**{name: None})
        assert loss.in_keys == list(defaults.values())
    with pytest.raises(ValueError, match="state"):
        loss.set_keys(state="s")


@pytest.mark.parametrize("kind", LOSSES)
def test_nested_keys_and_dispatch_give_the_same_loss(kind):
    td, loss = windows(5), make(kind)
    out = run(loss, td)
    assert list(out.keys()) == loss.out_keys
    given = {"_".join(k) if isinstance(k, tuple) else k: td[k] for k in loss.in_keys}
    torch.manual_seed(0)
    for key, value in zip(loss.out_keys, loss(**given), strict=True):
        assert torch.equal(out[key], value)
    loss.select_out_keys(MAIN[kind])
    torch.manual_seed(0)
    assert torch.equal(loss(**given), out[MAIN[kind]])
    nested, loss = TensorDict({}, [5]), make(kind)
    for name, default in KEYS[kind].items():
        nested["deep", name] = td[default]
        loss.set_keys(**{name: ("deep", name)})
    assert torch.equal(run(loss, nested)[MAIN[kind]], out[MAIN[kind]])


@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("shape", [(), (6,), (2, 3)])
@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
def test_reduction(kind, shape, reduction):
    td, main = windows(*shape), MAIN[kind]
    each = run(make(kind, reduction="none"), td)[main]
    assert each.shape == shape
    out = run(make(kind, reduction=reduction), td)
    expected = {"none": each, "sum": each.sum()}.get(reduction, each.mean())
    torch.testing.assert_close(out[main], expected)
    for key in set(out.keys()) - {main}:
        assert out[key].shape == () and not out[key].requires_grad


@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("steps", [False, True])
def test_masked_windows_do_not_count(kind, key, steps):
    td, counted = windows(6), torch.tensor([True, False, True, True, False, True])
    main = MAIN[kind]
    each = run(make(kind, reduction="none"), td)[main].detach()
    td[key] = counted[:, None].repeat(1, HORIZON) if steps else counted
    for name in KEYS[kind].values():
        td[name][~counted] = torch.nan
    loss = make(kind)
    out = run(loss, td)
    torch.testing.assert_close(out[main], each[counted].mean())
    assert all(value.isfinite() for value in out.values())
    out[main].backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters())
    none = run(make(kind, reduction="none"), td)[main]
    torch.testing.assert_close(none, each.where(counted, 0.0))


@pytest.mark.parametrize("kind", LOSSES)
def test_input_is_not_changed(kind):
    td = windows(6)
    before = td.clone()
    run(make(kind), td)
    assert set(td.keys(True, True)) == set(before.keys(True, True)) and (td == before).all()


@pytest.mark.parametrize("kind", LOSSES)
def test_gradients_reach_what_is_trained_alone(kind):
    planner = make_planner()
    loss = make(kind, planner=planner)
    run(loss, windows(32))[MAIN[kind]].backward()
    module = planner.networks if kind is SequenceDenoisingLoss else planner.return_model
    assert {id(p) for p in loss.parameters()} == {id(p) for p in module.parameters()}
    for name, parameter in planner.named_parameters():
        used = name.startswith("networks" if kind is SequenceDenoisingLoss else "return_model")
        assert (parameter.grad is not None and bool(parameter.grad.any())) == used, name


@pytest.mark.parametrize("kind", LOSSES)
def test_state_dict_and_deepcopy(kind):
    loss, other, td = make(kind), make(kind, 1), windows(6)
    value = run(loss, td)[MAIN[kind]]
    assert not torch.equal(run(other, td)[MAIN[kind]], value)
    other.load_state_dict(loss.state_dict())
    assert torch.equal(run(other, td)[MAIN[kind]], value)
    other = copy.deepcopy(loss)
    assert torch.equal(run(other, td)[MAIN[kind]], value)
    for parameter in other.parameters():
        parameter.data.zero_()
    assert torch.equal(run(loss, td)[MAIN[kind]], value)


@pytest.mark.parametrize("kind", LOSSES)
def test_double_precision(kind):
    loss = make(kind).to(torch.float64)
    value = run(loss, windows(6).double())[MAIN[kind]]
    assert value.dtype == torch.float64
    value.backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize("kind", LOSSES)
def test_bfloat16_autocast_is_close(kind):
    loss, td = make(kind), windows(64)
    exact = run(loss, td)[MAIN[kind]]
    with torch.autocast("cpu", torch.bfloat16):
        value = run(loss, td)[MAIN[kind]]
    value.backward()
    torch.testing.assert_close(value.float(), exact, rtol=0.05, atol=0.0)
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize("kind", LOSSES)
def test_torch_compile(kind):
    loss, td = make(kind), windows(6)
    expected = run(loss, td)
    compiled = run(torch.compile(loss, backend="eager"), td)
    for key in loss.out_keys:
        torch.testing.assert_close(compiled[key], expected[key])
    torch._dynamo.reset()


def test_ema_by_soft_update():
    planner = make_planner()
    loss, key = make(SequenceDenoisingLoss, planner=planner, delay=True), ("0", "head", "weight")
    updater, before = SoftUpdate(loss, eps=0.9), loss.target_network_params[key].clone()
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    run(loss, windows(8))["loss_denoising"].backward()
    optimizer.step()
    updater.step()
    expected = 0.9 * before + 0.1 * loss.network_params[key]
    torch.testing.assert_close(loss.target_network_params[key], expected.detach())


# what cannot be


@pytest.mark.parametrize("kind", LOSSES)
def test_missing_key(kind):
    for key in KEYS[kind].values():
        with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
            make(kind)(windows(4).exclude(key))


@pytest.mark.parametrize("kind", LOSSES)
def test_windows_that_do_not_fit(kind):
    loss = make(kind)
    with pytest.raises(ValueError, match=r"expected windows \[\*B, 8, S\], the horizon that"):
        loss(windows(4).apply(lambda x: x[:, :7]))
    td = windows(4)
    td["action"] = torch.zeros(4, HORIZON, 2)
    with pytest.raises(ValueError, match=r"'action' is \(4, 8, 2\); expected \(4, 8, 1\)"):
        loss(td)
    td["observation"] = torch.zeros(4, HORIZON, 5)
    with pytest.raises(ValueError, match=r"'observation' is \(4, 8, 5\); expected states of 2"):
        loss(td)


@pytest.mark.parametrize("kind", LOSSES)
def test_bad_arguments(kind):
    with pytest.raises(ValueError, match=r"no_target is 1.5; expected a share in \[0, 1\]"):
        make(kind, no_target=1.5)
    if kind is SequenceGuidanceLoss:
        with pytest.raises(ValueError, match="this planner has no return model to train"):
            make(kind, planner=make_planner(return_model=None))


# training


def linear_windows(count, generator):
    """A point on a line with velocity; the action is its acceleration."""
    state = torch.stack([torch.zeros(count), torch.randn(count, generator=generator)], -1)
    action = torch.rand(count, HORIZON, 1, generator=generator) * 2 - 1
    states, rewards = [], []
    for step in range(HORIZON):
        states.append(state)
        rewards.append(action[:, step])  # what pays is to accelerate
        velocity = state[:, 1:] + action[:, step]
        state = torch.cat([state[:, :1] + velocity, velocity], -1)
    entries = {"observation": torch.stack(states, 1), "action": action}
    entries["return_to_go"] = torch.zeros(count, HORIZON)
    return TensorDict({**entries, "next": {"reward": torch.stack(rewards, 1)}}, [count])


def inconsistency(planner, td):
    """How far planned positions are from where the planned velocity leads, the targets included."""
    plan = planner(td.copy())["plan"]
    assert torch.equal(plan[:, 6], td["target"])
    return (plan[:, :-1, 0] + plan[:, 1:, 1] - plan[:, 1:, 0]).square().mean().sqrt()


def test_training_on_linear_dynamics():
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    data = linear_windows(2000, generator)
    states = Normalizer.of(data["observation"].flatten(0, 1))
    model = NoisyReturnModel(states, 1, HORIZON, 8, (1, 2)).fit_scale(
        data["next", "reward"].sum((1, 2))
    )
    planner = DiffuserPlanner(
        states, 1, HORIZON, 16, (1, 2), return_model=model, noise="seeded", guide_scale=0.0
    )
    fresh = linear_windows(50, generator)
    td = TensorDict({"observation": fresh["observation"][:, 0]}, [50])
    td["target"], td["target_step"] = fresh["observation"][:, 6], torch.full((50, 1), 6)
    td["found"] = torch.ones(50, 1, dtype=torch.bool)
    untrained = inconsistency(planner, td)
    objectives = [
        Objective(SequenceDenoisingLoss(planner), lambda w: w, lr=3e-3, steps=250, warmup=10),
        Objective(SequenceGuidanceLoss(planner), lambda w: w, lr=3e-3, steps=250, warmup=10),
    ]
    losses = []
    for _ in range(250):
        drawn = data[torch.randint(2000, (64,))]
        losses.append([objective.update(drawn) for objective in objectives])
    for number, name in enumerate(("loss_denoising", "loss_guidance")):
        values = [float(out[number][name]) for out in losses]
        assert sum(values[-20:]) < 0.6 * sum(values[:20]), name
    # plans pass through the target, and move there as the data do
    assert inconsistency(planner, td) < 0.5 * untrained
    # guided plans accelerate more
    plain = planner.plan(td["observation"], [None])[..., -1].mean()
    planner.guide_scale = 2.0
    assert float(planner.plan(td["observation"], [None])[..., -1].mean()) > float(plain) + 0.05
