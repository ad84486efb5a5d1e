import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_rad.modules.diffuser import DiffuserPlanner
from torchrl_rad.modules.frozen import PlainNetwork
from torchrl_rad.modules.frozen_unet import FrozenReturnModel, FrozenUNet
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel, PlainReturnModel
from torchrl_rad.modules.normalizer import Normalizer

DIM, ACTIONS, HORIZON = 3, 2, 8
CLOSE = {"atol": 1e-4, "rtol": 1e-4}


def make(seed=0, horizon=HORIZON, guided=False, **kwargs):
    torch.manual_seed(seed)
    states = Normalizer(torch.tensor([1.0, -3.0, 0.1]), torch.tensor([2.0, 0.3, 7.0]))
    options = {"width": 8, "multiples": (1, 2), "steps": 3, **kwargs}
    if guided or options.get("candidates", 1) > 1:
        model = NoisyReturnModel(states, ACTIONS, horizon, 8, options["multiples"])
        options = {"return_model": model, "guide_stop": 1, **options}
    return DiffuserPlanner(states, ACTIONS, horizon, **options)


def batch(*shape, seed=0, horizon=HORIZON, share=0.6):
    generator = torch.Generator().manual_seed(seed)
    state, target = 5 * torch.randn(2, *shape, DIM, generator=generator)
    return TensorDict(
        {
            "observation": state,
            "target": target,
            "found": torch.rand(*shape, 1, generator=generator) < share,
            "target_step": torch.randint(1, horizon, (*shape, 1), generator=generator),
            "target_index": torch.full((*shape, 1), -1),
        },
        shape,
    )


# what is known is in the plan


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    sampler=st.sampled_from(["ancestral", "ddim"]),
    noise=st.sampled_from(["sample", "seeded", "zero"]),
    steps=st.integers(1, 3),
    guided=st.booleans(),
    candidates=st.sampled_from([1, 3]),
    horizon=st.sampled_from([2, 8, 32]),
)
def test_plans_hold_given_states_exactly(seed, sampler, noise, steps, guided, candidates, horizon):
    planner = make(
        seed, horizon, guided, sampler=sampler, noise=noise, steps=steps, candidates=candidates
    )
    out = planner(batch(8, seed=seed, horizon=horizon))
    assert out["plan"].shape == (8, horizon, DIM) and out["plan"].dtype == torch.float32
    assert out["plan"].isfinite().all()
    assert torch.equal(out["plan"][:, 0], out["observation"])
    for row in range(8):
        step = int(out["target_step"][row])
        holds = torch.equal(out["plan"][row, step], out["target"][row])
        assert holds == bool(out["found"][row])
    assert out["action"].shape == (8, ACTIONS) and (out["action"].abs() <= 1).all()


def test_network_sees_known_states_clean_and_is_told():
    planner, seen = make(), []
    planner.networks[0].register_forward_pre_hook(lambda module, args: seen.append(args))
    td = planner(batch(6))
    found, step = td["found"].squeeze(-1), td["target_step"].squeeze(-1)
    expected = torch.zeros(6, HORIZON, dtype=torch.bool)
    expected[:, 0] = True
    expected[found, step[found]] = True
    assert len(seen) == 3
    for sample, mask, _ in seen:
        assert torch.equal(mask.squeeze(-1), expected)
        assert torch.equal(sample[:, 0, :DIM], planner.normalizer(td["observation"]))
        target = planner.normalizer(td["target"][found])
        assert torch.equal(sample[found, step[found], :DIM], target)
        # actions are free, also beside known states
        assert (sample[:, 0, DIM:].std(0) > 0).all()
    assert [float(time) for _, _, time in seen] == pytest.approx([1.0, 2 / 3, 1 / 3])


@pytest.mark.parametrize("bound", [0.1, 1.0])
def test_action_is_the_first_one_of_the_plan_within_bounds(bound):
    planner, td = make(noise="seeded", bound=bound), batch(50, share=0.0)
    plan = planner.plan(td["observation"], [None])
    out = planner(td)
    torch.testing.assert_close(out["action"], plan[:, 0, DIM:].clamp(-bound, bound))
    torch.testing.assert_close(out["plan"], plan[..., :DIM])
    assert bool((plan[:, 0, DIM:].abs() > bound).any()) == (bound == 0.1)


def test_plan_times():
    assert make().plan_times.tolist() == list(range(HORIZON))


@pytest.mark.parametrize("horizon", [32, 64, 128, 256, 384])
def test_horizons(horizon):
    planner = make(horizon=horizon, guided=True, multiples=(1, 2, 4, 8), steps=2)
    assert planner(batch(2, horizon=horizon))["plan"].shape == (2, horizon, DIM)


def test_steps_outside_the_horizon():
    planner, td = make(noise="seeded"), batch(3, share=2.0)
    td["target_step"] = torch.tensor([[HORIZON], [0], [-4]])
    plan = planner(td.copy())["plan"]
    without = planner.plan(td["observation"], [None])[..., :DIM]
    # beyond the horizon: planned without; below 1: the next state
    torch.testing.assert_close(plan[0], without[0], **CLOSE)
    assert torch.equal(plan[1:, 1], td["target"][1:])


# rows are independent of each other


@pytest.mark.parametrize("noise", ["seeded", "zero"])
@pytest.mark.parametrize("candidates", [1, 3])
def test_mixed_batch_equals_separate_batches(noise, candidates):
    planner, td = make(noise=noise, candidates=candidates, guided=True), batch(12)
    out, found = planner(td.copy()), td["found"].squeeze(-1)
    assert 2 <= int(found.sum()) <= 10
    for part in (found, ~found, torch.arange(12) == 3):
        alone = planner(td[part].copy())
        torch.testing.assert_close(alone["plan"], out["plan"][part], **CLOSE)
        torch.testing.assert_close(alone["action"], out["action"][part], **CLOSE)


def test_rows_without_a_target_do_not_read_it():
    planner, td = make(noise="seeded", guided=True), batch(12)
    lost = ~td["found"].squeeze(-1)
    other = td.clone()
    other["target"][lost] = torch.nan
    other["target_step"][lost] = 10**9
    assert torch.equal(planner(other)["plan"], planner(td.copy())["plan"])
    without = planner.plan(td["observation"], [None])[..., :DIM]
    torch.testing.assert_close(planner(td)["plan"][lost], without[lost], **CLOSE)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,)])
@pytest.mark.parametrize("targets", [True, False])
def test_batch_shapes(shape, targets):
    planner = make(noise="seeded", targets=targets, candidates=2)
    td = batch(*shape)
    out = planner(td.copy())
    assert out["plan"].shape == (*shape, HORIZON, DIM)
    assert out["action"].shape == (*shape, ACTIONS) and out.batch_size == shape
    if 0 not in shape:
        flat = planner(td.reshape(-1))["plan"]
        assert torch.equal(out["plan"].reshape(flat.shape), flat)


# noise


@pytest.mark.parametrize("sampler", ["ancestral", "ddim"])
def test_noise_modes(sampler):
    td, sampled = batch(4), make(noise="sample", sampler=sampler)
    assert not torch.equal(sampled(td.copy())["plan"], sampled(td.copy())["plan"])
    for noise in ("seeded", "zero"):
        planner = make(noise=noise, sampler=sampler)
        state = torch.get_rng_state()
        assert torch.equal(planner(td.copy())["plan"], planner(td.copy())["plan"])
        assert torch.equal(torch.get_rng_state(), state)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        plan = sampled(td.copy())["plan"]
    assert torch.equal(make(noise="seeded", sampler=sampler)(td)["plan"], plan)


def test_temperature_scales_the_initial_noise_alone():
    td, zero = batch(4), make(noise="zero")
    cold = make(noise="sample", temperature=0.0)
    assert not torch.equal(cold(td.copy())["plan"], zero(td.copy())["plan"])
    cold = make(noise="sample", temperature=0.0, sampler="ddim")
    zero = make(noise="zero", sampler="ddim")
    assert torch.equal(cold(td.copy())["plan"], zero(td.copy())["plan"])


def test_both_samplers_use_the_same_weights():
    ancestral, ddim = make(sampler="ancestral"), make(1, sampler="ddim", steps=2)
    ddim.load_state_dict(ancestral.state_dict())
    assert ddim(batch(3))["plan"].isfinite().all()


# the return model


class FirstAction(torch.nn.Module):
    """Prefers a large first action; keeps what it was shown."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def standardised(self, plans, mask, time):
        self.calls.append((plans.detach().clone(), float(time)))
        return plans[:, 0, DIM]


@pytest.mark.parametrize("noise", ["sample", "seeded"])
def test_the_best_candidate_is_kept(noise):
    model = FirstAction()
    planner = make(noise=noise, candidates=16, return_model=model, guide_scale=0.0, bound=100.0)
    out = planner(batch(6))
    ((plans, time),) = model.calls
    plans = plans.unflatten(0, (6, 16))
    best = plans[torch.arange(6), plans[:, :, 0, DIM].argmax(-1)]
    assert time == 0.0  # finished plans are compared
    torch.testing.assert_close(out["plan"], planner.normalizer.inverse(best[..., :DIM]))
    assert torch.equal(out["action"], best[:, 0, DIM:])
    assert (plans[:, :, 0, DIM].std(1) > 0).all()
    start = planner.normalizer(out["observation"])[:, None].expand(6, 16, DIM)
    assert torch.equal(plans[:, :, 0, :DIM], start)


def test_guidance_by_hand():
    # the gradient of the first action is 1 there and 0 elsewhere
    model, seen = FirstAction(), []
    planner = make(return_model=model, guide_scale=0.5, guide_steps=2, guide_stop=1, steps=4)
    planner.networks[0].register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    planner(batch(3))
    assert [time for _, time in model.calls] == [1.0, 1.0, 0.75, 0.75, 0.5, 0.5]
    for step, (time, following) in enumerate([(1.0, 0.75), (0.75, 0.5), (0.5, 0.25)]):
        scale = 0.5 * planner.process.variance(time, following)
        (before, _), (between, _) = model.calls[2 * step : 2 * step + 2]
        shift = torch.zeros_like(before)
        shift[:, 0, DIM] = scale
        torch.testing.assert_close(between - before, shift, atol=1e-6, rtol=0)
        torch.testing.assert_close(seen[step] - before, 2 * shift, atol=1e-6, rtol=0)


@pytest.mark.parametrize("sampler", ["ancestral", "ddim"])
def test_guided_plans_have_a_larger_return(sampler):
    td, options = batch(20), {"guided": True, "noise": "seeded", "steps": 6, "sampler": sampler}
    returns = []
    for scale in (0.0, 30.0):
        planner, plans = make(guide_scale=scale, **options), []
        planner.networks[0].register_forward_hook(lambda m, args, out: plans.append(args[:2]))  # noqa: B023
        planner(td.copy())
        time = torch.full((1,), 1 / 3)
        returns.append(planner.return_model.standardised(*plans[4], time).mean())
    assert returns[1] > returns[0] + 0.05


@pytest.mark.parametrize("options", [{"guide_scale": 0.0}, {"guide_steps": 0}, {"guide_stop": 3}])
def test_unguided(options):
    td, plain = batch(3), make(noise="seeded")
    planner = make(guided=True, noise="seeded", **options)
    planner.load_state_dict(plain.state_dict(), strict=False)
    assert torch.equal(planner(td.copy())["plan"], plain(td)["plan"])


def test_no_gradient_is_kept():
    planner = make(guided=True, candidates=2)
    out = planner(batch(3))
    assert not out["plan"].requires_grad and not out["action"].requires_grad
    assert all(p.grad is None for p in planner.parameters())


def test_in_inference_mode():
    planner, td = make(guided=True, noise="seeded"), batch(3)
    with torch.inference_mode():
        plan = planner(td.copy())["plan"].clone()
    torch.testing.assert_close(plan, planner(td)["plan"])


@pytest.mark.parametrize("horizon", [8, 16])
@pytest.mark.parametrize("dtype", [None, torch.float16, torch.bfloat16])
def test_frozen_networks_plan_as_the_networks_do(horizon, dtype):
    options = {"guided": True, "candidates": 4, "noise": "seeded", "guide_scale": 5.0, "steps": 5}
    planner, td = make(horizon=horizon, **options), batch(6, horizon=horizon)
    with torch.autocast("cpu", dtype, enabled=dtype is not None):
        frozen = planner(td.copy())
    assert type(planner._step_networks(torch.device("cpu"))[0]) is FrozenUNet
    assert type(planner._returns(torch.device("cpu"))) is FrozenReturnModel
    for module in (planner.networks[0], planner.return_model):
        module.register_forward_hook(lambda module, args, out: None)  # calls are watched
    assert type(planner._step_networks(torch.device("cpu"))[0]) is PlainNetwork
    assert type(planner._returns(torch.device("cpu"))) is PlainReturnModel
    plain = planner(td)
    torch.testing.assert_close(frozen["plan"], plain["plan"], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(frozen["action"], plain["action"], atol=1e-3, rtol=1e-3)


# compiled networks


class Graphs:
    """A backend that runs what it is given, and counts."""

    def __init__(self):
        self.count = 0

    def __call__(self, graph, inputs):
        self.count += 1
        return graph.forward


@pytest.fixture
def graphs():
    torch._dynamo.reset()
    yield Graphs()
    torch._dynamo.reset()


def test_compiled_networks_plan_as_they_do(graphs):
    options = {"guided": True, "multiples": (1,), "noise": "seeded", "guide_scale": 5.0, "steps": 5}
    planner, compiled = make(**options), make(**options)
    compiled.load_state_dict(planner.state_dict())
    compiled.compile(backend=graphs, fullgraph=True)
    # one graph for all steps of the U-Net, and one of the gradient
    for rows, made in [(6, 2), (6, 2), (5, 4), (6, 4)]:
        td = batch(rows)
        torch.testing.assert_close(compiled(td.copy())["plan"], planner(td)["plan"])
        assert graphs.count == made


def test_compiled_networks_follow_the_weights(graphs):
    planner, td = make(multiples=(1,), noise="seeded"), batch(3)
    planner.compile(backend=graphs)
    before = planner(td.copy())["plan"]
    made = graphs.count
    with torch.no_grad():
        planner.networks[0].head.bias += 1.0
    assert not torch.allclose(planner(td.copy())["plan"], before)
    assert graphs.count == made
    copied = copy.deepcopy(planner)
    assert torch.equal(copied(td.copy())["plan"], planner(td)["plan"])
    assert graphs.count == made


def test_only_frozen_networks_are_compiled():
    with pytest.raises(RuntimeError, match=r"horizon \(12\) is a multiple of 4 \* 2 \*\*"):
        make(horizon=12).compile()
    planner = make()
    planner.networks[0].register_forward_hook(lambda module, args, out: None)
    with pytest.raises(RuntimeError, match="without hooks"):
        planner.compile()


# keys


def test_renamed_and_nested_keys():
    td, nested = batch(4), TensorDict({}, [4])
    names = [("a", "s"), ("a", "t"), ("b", "f"), "i"]
    for name, key in zip(names, td.keys(), strict=False):
        nested[name] = td[key]
    make(noise="seeded", in_keys=names, out_keys=[("o", "p"), ("o", "u")])(nested)
    plain = make(noise="seeded")(td)
    assert torch.equal(nested["o", "p"], plain["plan"])
    assert torch.equal(nested["o", "u"], plain["action"])


@pytest.mark.parametrize("targets", [True, False])
def test_dispatch(targets):
    planner, td = make(noise="seeded", targets=targets), batch(4)
    plan, action = planner(**{key: td[key] for key in planner.in_keys})
    out = planner(td)
    assert torch.equal(plan, out["plan"]) and torch.equal(action, out["action"])


def test_in_a_sequence_the_backbone_needs_the_observation_alone():
    policy = TensorDictSequential(make(targets=False))
    assert policy.in_keys == ["observation"] and policy.out_keys == ["plan", "action"]
    assert policy(batch(3).select("observation"))["action"].shape == (3, ACTIONS)


@pytest.mark.parametrize("key", ["observation", "target", "found", "target_step"])
def test_missing_key(key):
    with pytest.raises(KeyError, match=f"'{key}' is missing in the tensordict"):
        make()(batch(3).exclude(key))


def test_the_index_may_be_missing():
    planner, td = make(noise="seeded"), batch(3)
    assert torch.equal(planner(td.exclude("target_index"))["plan"], planner(td)["plan"])


@pytest.mark.parametrize("key", ["observation", "target"])
def test_wrong_states(key):
    td = batch(3)
    td[key] = torch.zeros(3, DIM + 1)
    with pytest.raises(ValueError, match=rf"'{key}' is \(3, 4\); expected states of 3 entries"):
        make()(td)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_nan_in_the_observation_gives_a_finite_action(bad):
    planner, td = make(noise="seeded", guided=True, candidates=2), batch(4)
    clean = planner(td.copy())["plan"]
    td["observation"][1, 0] = bad
    td["found"][1] = False
    out = planner(td)
    assert out["action"].isfinite().all() and out["plan"].isfinite().all()
    torch.testing.assert_close(out["plan"][[0, 2, 3]], clean[[0, 2, 3]], **CLOSE)
    assert float(out["plan"][1, 0, 0]) == 0.0


# saving


def test_state_dict_round_trip():
    options = {"noise": "seeded", "candidates": 2}
    saved, other = make(0, **options), make(1, **options)
    td = batch(4)
    assert not torch.equal(saved(td.copy())["plan"], other(td.copy())["plan"])
    other.load_state_dict(saved.state_dict())
    assert torch.equal(saved(td.copy())["plan"], other(td.copy())["plan"])


def test_new_weights_are_planned_with():
    planner, td = make(noise="seeded", guided=True), batch(4)
    before = planner(td.copy())["plan"]
    for module in (planner.networks[0], planner.return_model):
        same = planner(td.copy())["plan"]
        module.load_state_dict({k: v * 1.5 for k, v in module.state_dict().items()})
        assert not torch.equal(planner(td.copy())["plan"], same)
    copied = copy.deepcopy(planner)
    assert torch.equal(copied(td.copy())["plan"], planner(td.copy())["plan"])
    assert not torch.equal(planner(td.copy())["plan"], before)


def test_double_precision():
    td = batch(4)
    options = {"noise": "zero", "candidates": 2, "sampler": "ddim"}
    single, double = make(**options)(td.copy())["plan"], make(**options).double()(td)["plan"]
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, atol=1e-2, rtol=1e-3)


def test_bfloat16_autocast_is_close():
    planner, td = make(noise="seeded", guided=True), batch(4)
    exact = planner(td.copy())["plan"]
    planner.networks[0].register_forward_hook(lambda module, args, out: None)  # called as it is
    with torch.autocast("cpu", torch.bfloat16):
        near = planner(td)["plan"]
    assert near.dtype == torch.float32
    assert not torch.equal(near, exact)
    assert float((near - exact).abs().mean() / exact.abs().mean()) < 0.05


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"steps": 0}, "steps is 0; a plan needs at least one inference step"),
        ({"temperature": -0.1}, "temperature is -0.1; it must not be negative"),
        ({"candidates": 4, "return_model": None}, "candidates is 4: expected 1, or more and a"),
        ({"noise": "none"}, "noise is 'none'; expected 'sample', 'seeded' or 'zero'"),
        ({"sampler": "flow"}, r"sampler is 'flow'; expected one of \['ancestral', 'ddim'\]"),
        ({"guide_scale": -1.0}, "guide_scale, guide_steps and guide_stop are -1.0, 2 and 2"),
        ({"in_keys": ["observation"]}, "in_keys are .* expected five and two"),
        ({"targets": False, "in_keys": ["a", "b"]}, "expected one and two"),
        ({"horizon": 9}, "a plan of 9 steps cannot be halved 1 times, .* use 8 or 10"),
        (
            {"return_model": NoisyReturnModel(Normalizer.identity(DIM), 1, 16, 8, (1, 2))},
            "the return model sees 16 steps of 4 entries; these plans have 8 of 5",
        ),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)
