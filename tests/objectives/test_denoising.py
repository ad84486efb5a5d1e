import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.objectives import DenoisingLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")

DIM, HORIZON = 2, 13


def make_planner(seed=0, **kwargs):
    torch.manual_seed(seed)
    states = Normalizer(torch.tensor([1.0, -3.0]), torch.tensor([2.0, 0.5]))
    inverse = InverseDynamics(states, Normalizer.identity(DIM), 1, width=8)
    options = {"horizon": HORIZON, "jumps": (3, 1), "width": 16, "heads": 2, "blocks": 1}
    planner = DiffuserLitePlanner(states, inverse, **{**options, **kwargs})
    for parameter in planner.networks.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return planner


def make(seed=0, placement="shifted", process="flow", targets=True, relative=False, **kwargs):
    options = {"placement": placement, "process": process, "relative": relative}
    planner = make_planner(seed, targets=targets, **options)
    return DenoisingLoss(planner, **kwargs)


def windows(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return TensorDict(
        {"observation": torch.randn(*shape, HORIZON, DIM, generator=generator)}, shape
    )


def run(loss, td, seed=0):
    torch.manual_seed(seed)
    return loss(td)


class Stub(torch.nn.Module):
    """In place of the networks: predicts ``value`` where it is asked and keeps its inputs."""

    def __init__(self, value):
        super().__init__()
        self.value, self.calls = value, []

    def forward(self, level, sample, mask, time, free):
        self.calls.append((level, sample, mask, time))
        return torch.full_like(sample[:, free], self.value)


def stubbed(value=0.0, **kwargs):
    """A loss whose networks are a stub. Diffusion predicts the clean states: zeros below."""
    loss = make(process="diffusion", **kwargs)
    loss.__dict__["network"] = Stub(value)
    loss.network_params = _NoParams()
    loss.planner_normalizer = Normalizer.identity(DIM)
    return loss


class _NoParams(torch.nn.Module):
    def to_module(self, module):
        return torch.no_grad()


# the formula


@pytest.mark.parametrize("no_target", [0.0, 1.0])
def test_value_by_hand(no_target):
    # clean states are 0 and the prediction is 2: every unknown entry has the error 4
    loss = stubbed(2.0, no_target=no_target, next_weight=10.0)
    td = windows(40)
    td["observation"] = torch.zeros_like(td["observation"])
    loss.reduction = "none"
    out = run(loss, td)
    total = torch.zeros(40)
    for level, sample, mask, _ in loss.network.calls:
        tokens = loss.levels[level].tokens
        weight = torch.tensor([10.0 if token == 1 else 1.0 for token in range(tokens)])
        total += (4.0 * weight * ~mask.squeeze(-1)).mean(-1)
        # known entries are shown clean
        assert (sample[mask.expand_as(sample)] == 0).all()
    torch.testing.assert_close(out["loss_denoising"], total)
    if no_target == 1.0:
        # level 0 of 5 states: 1, 2, 3, 4 unknown; level 1 of 4 states: 1 and 2
        assert out["loss_denoising"].tolist() == pytest.approx([4 * 13 / 5 + 4 * 11 / 4] * 40)


def test_known_entries_do_not_enter_the_loss_nor_its_gradient():
    loss = make(no_target=0.0, reduction="none")
    seen = []

    def spy(module, args, kwargs, out):
        out.retain_grad()
        asked = torch.zeros_like(args[2])
        asked[:, kwargs["free"]] = True
        assert (args[2] | asked).all()  # no unknown entry is left out
        seen.append((args[2][:, kwargs["free"]], out))

    loss.network.register_forward_hook(spy, with_kwargs=True)
    run(loss, windows(30))["loss_denoising"].sum().backward()
    assert len(seen) == 2
    for mask, out in seen:
        known = mask.expand_as(out)
        assert (out.grad[known] == 0).all() and (out.grad[~known] != 0).all()


def test_noisy_states_follow_the_process():
    loss = make(no_target=1.0)
    seen = []
    loss.network.register_forward_hook(lambda module, args, out: seen.append(args))
    td = windows(2000)
    td["observation"] = torch.tensor([1.0, -3.0]).expand_as(td["observation"])  # 0 in their units
    run(loss, td)
    for _, sample, mask, time in seen:
        assert time.shape == (2000,) and 0 <= time.min() < 0.01 and 0.99 < time.max() < 1
        noise = (sample / time[:, None, None])[~mask.expand_as(sample)]  # x = t * noise
        assert abs(float(noise.mean())) < 0.05 and abs(float(noise.std()) - 1) < 0.05


def test_relative_networks_see_changes():
    loss, seen = make(no_target=1.0, relative=True), []
    for scale in loss.planner_changes:
        scale.deviation.copy_(torch.tensor([0.5, 0.25]))
    loss.network.register_forward_hook(lambda module, args, out: seen.append(args))
    td = windows(500)
    td["observation"] = torch.tensor([5.0, -3.5]).expand_as(td["observation"])  # stays
    run(loss, td)
    for _, sample, mask, time in seen:
        torch.testing.assert_close(sample[:, 0], torch.tensor([2.0, -1.0]).expand(500, 2))
        noise = (sample / time[:, None, None])[~mask.expand_as(sample)]  # of changes that are 0
        assert abs(float(noise.mean())) < 0.1 and abs(float(noise.std()) - 1) < 0.1


def test_some_levels_only():
    loss, td = make(only=[1]), windows(6)
    out = run(loss, td)
    assert sorted(out.keys()) == ["level_1", "loss_denoising"] and "level_0" not in loss.out_keys
    out["loss_denoising"].backward()
    for number, trained in enumerate((False, True)):
        for name, parameter in loss.network_params.named_parameters():
            if name.startswith(str(number)):
                assert (parameter.grad is not None) == trained
    with pytest.raises(ValueError, match="only is \\[2\\]; these plans have levels 0 to 1"):
        make(only=[2])


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_share_without_a_target(share):
    loss = make(no_target=share)
    torch.manual_seed(0)
    for number, known in ((0, 1), (1, 2)):  # the first state; on finer levels the last one too
        _, mask, _ = loss.pieces(number, torch.randn(3000, HORIZON, DIM))
        pinned = mask.squeeze(-1).sum(-1) > known
        if number == 0:
            assert float(pinned.float().mean()) == pytest.approx(1 - share, abs=0.03)
        if share == 1.0:
            assert not pinned.any()


def test_pseudo_targets_at_one_step():
    loss = make(no_target=0.0, pseudo_step=6)
    _, mask, _ = loss.pieces(0, torch.randn(300, HORIZON, DIM))
    assert mask.squeeze(-1).tolist() == [[True, False, True, False, False]] * 300
    _, mask, _ = loss.pieces(1, torch.randn(300, HORIZON, DIM))  # three steps long: at its end
    assert mask.squeeze(-1).tolist() == [[True, False, False, True]] * 300


@pytest.mark.parametrize("step", [0, HORIZON])
def test_bad_pseudo_step(step):
    with pytest.raises(ValueError, match=f"pseudo_step is {step}; expected 1 to 12, or None"):
        make(pseudo_step=step)


def test_planner_without_targets_is_trained_without():
    loss = make(targets=False, no_target=0.0)
    _, mask, _ = loss.pieces(0, torch.randn(300, HORIZON, DIM))
    assert mask.squeeze(-1).tolist() == [[True, False, False, False, False]] * 300


@pytest.mark.parametrize("level, jump, tokens", [(0, 3, 5), (1, 1, 4)])
def test_pieces_are_evenly_spaced_parts_of_a_window(level, jump, tokens):
    loss = make(no_target=0.0)
    rows = 100.0 * torch.arange(500)[:, None, None]
    steps = torch.arange(float(HORIZON))[None, :, None].expand(500, HORIZON, DIM)
    torch.manual_seed(0)
    clean, _, _ = loss.pieces(level, rows + steps)
    begin = (clean - rows)[:, :1]
    assert torch.equal(
        clean - rows - begin, (jump * torch.arange(tokens))[None, :, None] + 0 * clean
    )
    starts = set(range(HORIZON - jump * (tokens - 1)))
    assert set(begin.flatten().int().tolist()) == starts


# TorchRL's checklist


def test_reset_parameters_recursive():
    loss = make(delay=True)
    before = loss.network_params.clone()
    loss.reset_parameters_recursive()
    embed = ("0", "embed", "weight")
    assert not torch.equal(loss.network_params[embed], before[embed])


def test_accepted_keys():
    loss = make()
    assert loss.tensor_keys.observation == "observation" and loss.in_keys == ["observation"]
    loss.set_keys(observation=("deep", "state"))
    assert loss.in_keys == [("deep", "state")]
    loss.set_keys(observation=None)
    assert loss.in_keys == ["observation"]
    with pytest.raises(ValueError, match="reward"):
        loss.set_keys(reward="r")


def test_out_keys():
    loss = make()
    assert loss.out_keys == ["loss_denoising", "level_0", "level_1"]
    assert set(run(loss, windows(4)).keys()) == set(loss.out_keys)


def test_nested_key_gives_the_same_loss():
    td, loss = windows(6), make()
    plain = run(loss, td)["loss_denoising"]
    loss.set_keys(observation=("deep", "state"))
    nested = TensorDict({"deep": {"state": td["observation"]}}, [6])
    assert torch.equal(run(loss, nested)["loss_denoising"], plain)


@pytest.mark.parametrize("key", ["observation", ("deep", "state")])
def test_dispatch(key):
    td, loss = windows(6), make()
    loss.set_keys(observation=key)
    out = run(loss, TensorDict({}, [6]).set(key, td["observation"]))
    name = key if isinstance(key, str) else "_".join(key)
    torch.manual_seed(0)
    values = loss(**{name: td["observation"]})
    for out_key, value in zip(loss.out_keys, values, strict=True):
        assert torch.equal(out[out_key], value)
    loss.select_out_keys("loss_denoising")
    torch.manual_seed(0)
    assert torch.equal(loss(**{name: td["observation"]}), out["loss_denoising"])


@pytest.mark.parametrize("shape", [(6,), (2, 3)])
@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
def test_reduction(shape, reduction):
    td = windows(*shape)
    each = run(make(reduction="none"), td)["loss_denoising"]
    assert each.shape == shape
    out = run(make(reduction=reduction), td)
    expected = {"none": each, "sum": each.sum()}.get(reduction, each.mean())
    torch.testing.assert_close(out["loss_denoising"], expected)
    torch.testing.assert_close(out["level_0"] + out["level_1"], each.mean())
    assert not out["level_0"].requires_grad and out["loss_denoising"].requires_grad


@pytest.mark.parametrize("key", [("collector", "mask"), "shifted_valid"])
@pytest.mark.parametrize("form", ["windows", "steps", "steps_1"])
def test_masked_windows_do_not_count(key, form):
    td, counted = windows(6), torch.tensor([True, False, True, True, False, True])
    each = run(make(reduction="none"), td)["loss_denoising"].detach()
    mask = counted if form == "windows" else counted[:, None].repeat(1, HORIZON)
    if form != "windows":
        mask[:, 0] = True  # one step that is masked masks its window
    td[key] = mask if form != "steps_1" else mask[..., None]
    td["observation"][~counted] = torch.nan
    loss = make()
    out = run(loss, td)
    torch.testing.assert_close(out["loss_denoising"], each[counted].mean())
    torch.testing.assert_close(out["level_0"] + out["level_1"], each[counted].mean())
    out["loss_denoising"].backward()
    grads = [p.grad for p in loss.parameters()]
    assert all(g.isfinite().all() for g in grads) and any(g.any() for g in grads)
    none = run(make(reduction="none"), td)["loss_denoising"]
    assert (none[~counted] == 0).all() and torch.equal(none[counted], each[counted])


def test_mask_can_be_switched_off():
    td = windows(6)
    td["collector", "mask"] = torch.zeros(6, dtype=torch.bool)
    loss = make()
    loss.loss_mask_key = None
    assert torch.equal(run(loss, td)["loss_denoising"], run(make(), windows(6))["loss_denoising"])


def test_input_is_not_changed():
    td = windows(6)
    td["collector", "mask"] = torch.ones(6, dtype=torch.bool)
    before = td.clone()
    run(make(), td)
    assert set(td.keys(True, True)) == set(before.keys(True, True)) and (td == before).all()


@pytest.mark.parametrize("delay", [False, True])
def test_gradients_reach_the_networks_alone(delay):
    loss = make(delay=delay)
    run(loss, windows(32))["loss_denoising"].backward()
    for name, parameter in loss.named_parameters():
        assert name.startswith("network_params."), name
        assert parameter.grad is not None and parameter.grad.any(), name
    assert all(v.grad is None for _, v in loss.target_network_params.items(True, True))


def test_parameters_are_those_of_the_planner():
    planner = make_planner()
    loss = DenoisingLoss(planner)
    assert {id(p) for p in loss.parameters()} == {id(p) for p in planner.networks.parameters()}


def test_separate_levels():
    # each level's loss reaches its own network alone
    loss = make()
    with torch.random.fork_rng():
        with loss.network_params.to_module(loss.network):
            loss._level(1, torch.randn(8, HORIZON, DIM), None).sum().backward()
    for name, parameter in loss.named_parameters():
        used = ".1." in name
        assert (parameter.grad is not None and bool(parameter.grad.any())) == used, name


def test_same_seed_same_loss():
    loss, td = make(), windows(6)
    first = run(loss, td, seed=3)["loss_denoising"]
    assert torch.equal(run(loss, td, seed=3)["loss_denoising"], first)
    assert not torch.equal(run(loss, td, seed=4)["loss_denoising"], first)


@pytest.mark.parametrize("delay", [False, True])
def test_state_dict(delay):
    loss, other, td = make(0, delay=delay), make(1, delay=delay), windows(6)
    other.load_state_dict(loss.state_dict())
    assert torch.equal(run(other, td)["loss_denoising"], run(loss, td)["loss_denoising"])


def test_deepcopy():
    loss, td = make(delay=True), windows(6)
    other = copy.deepcopy(loss)
    assert torch.equal(run(other, td)["loss_denoising"], run(loss, td)["loss_denoising"])
    for parameter in other.parameters():
        parameter.data.zero_()
    assert not torch.equal(run(other, td)["loss_denoising"], run(loss, td)["loss_denoising"])


def test_double_precision():
    td, loss = windows(6), make(delay=True, no_target=1.0)
    loss.to(torch.float64)
    assert {p.dtype for p in loss.parameters()} == {torch.float64}
    assert {b.dtype for b in loss.planner_normalizer.buffers()} == {torch.float64}
    assert loss.target_network_params["0", "embed", "weight"].dtype == torch.float64
    out = run(loss, td.double())
    assert out["loss_denoising"].dtype == torch.float64
    out["loss_denoising"].backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters())


def test_ema_by_soft_update():
    planner = make_planner()
    loss = DenoisingLoss(planner, delay=True)
    updater, key = SoftUpdate(loss, eps=0.9), ("0", "embed", "weight")
    before = loss.target_network_params[key].clone()
    assert torch.equal(before, loss.network_params[key])
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    run(loss, windows(8))["loss_denoising"].backward()
    optimizer.step()
    updater.step()
    expected = 0.9 * before + 0.1 * loss.network_params[key]
    torch.testing.assert_close(loss.target_network_params[key], expected.detach())
    # planning with the mean weights, and with the trained ones again afterwards
    td = TensorDict({"observation": torch.zeros(3, DIM)}, [3])
    pins = [None, None]
    planner.noise = "seeded"
    with torch.no_grad():
        trained = planner.plan(td["observation"], pins)
        with loss.target_network_params.to_module(planner.networks):
            mean = planner.plan(td["observation"], pins)
        assert not torch.equal(mean, trained)
        assert torch.equal(planner.plan(td["observation"], pins), trained)


@pytest.mark.parametrize("process", ["flow", "diffusion"])
@pytest.mark.parametrize("placement", ["shifted", "next"])
def test_overfits_a_tiny_batch(process, placement):
    loss, td = make(process=process, placement=placement), windows(1)
    td["observation"] = td["observation"] + torch.arange(HORIZON)[:, None]
    td = td.expand(64).clone()
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    torch.manual_seed(0)
    losses = []
    for _ in range(150):
        optimizer.zero_grad()
        value = loss(td)["loss_denoising"]
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])


def test_torch_compile():
    loss, td = DenoisingLoss(make_planner(jumps=(1,))), windows(6)  # one level: shorter
    expected = run(loss, td)
    compiled = run(torch.compile(loss, backend="eager"), td)
    for key in loss.out_keys:
        torch.testing.assert_close(compiled[key], expected[key])
    torch._dynamo.reset()


def test_bfloat16_autocast_is_close():
    loss, td = make(), windows(64)
    exact = run(loss, td)["loss_denoising"]
    with torch.autocast("cpu", torch.bfloat16):
        value = run(loss, td)["loss_denoising"]
    value.backward()
    assert value.dtype == torch.float32
    torch.testing.assert_close(value, exact, rtol=0.02, atol=0.0)
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize("shape", [(4, HORIZON - 1, DIM), (DIM,)])
def test_windows_of_another_length(shape):
    td = TensorDict({"observation": torch.zeros(shape)}, shape[:1] if len(shape) > 1 else [])
    with pytest.raises(ValueError, match=r"expected windows \[\*B, 13, S\], the horizon that"):
        make()(td)


def test_windows_of_another_width():
    td = TensorDict({"observation": torch.zeros(4, HORIZON, 5)}, [4])
    with pytest.raises(ValueError, match=r"'observation' is \(4, 13, 5\); expected states of 2"):
        make()(td)


def test_missing_key():
    with pytest.raises(KeyError, match="'observation' is missing in the tensordict"):
        make()(TensorDict({"state": torch.zeros(4, HORIZON, DIM)}, [4]))


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_bad_share(share):
    with pytest.raises(ValueError, match=rf"no_target is {share}; expected a share in \[0, 1\]"):
        make(no_target=share)
