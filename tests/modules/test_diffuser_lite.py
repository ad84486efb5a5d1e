import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.placement import PLACEMENTS
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.retrieval import RetrievalSampler

DIM = 3
TARGET_KEYS = ["target", "found", "target_step", "target_index"]


def make(seed=0, horizon=13, jumps=(3, 1), **kwargs):
    """A small planner whose networks do something: the output layers of new ones are zero."""
    torch.manual_seed(seed)
    states = Normalizer(torch.tensor([1.0, -3.0, 0.1]), torch.tensor([2.0, 0.3, 7.0]))
    inverse = InverseDynamics(states, Normalizer.identity(DIM), 2, width=16)
    planner = DiffuserLitePlanner(
        states, inverse, horizon=horizon, jumps=jumps, width=16, heads=2, blocks=1, **kwargs
    )
    for parameter in planner.networks.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return planner


def batch(*shape, seed=0, horizon=13, share=0.6):
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


def at(planner, out, time):
    """The planned state [Q, S] at a time."""
    return out["plan"][..., planner.plan_times.tolist().index(time), :]


# the levels


def test_plan_times():
    times = make(horizon=129, jumps=(32, 8, 1)).plan_times.tolist()
    assert times == [0, 1, 2, 3, 4, 5, 6, 7, 8, 16, 24, 32, 64, 96, 128]


# what is known is in the plan


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    placement=st.sampled_from(PLACEMENTS),
    process=st.sampled_from(["flow", "diffusion"]),
    noise=st.sampled_from(["sample", "seeded", "zero"]),
    steps=st.integers(1, 3),
    levels=st.sampled_from([(13, (3, 1)), (129, (32, 8, 1)), (9, (1,)), (2, (1,))]),
)
def test_plans_hold_given_entries_exactly(seed, placement, process, noise, steps, levels):
    horizon, jumps = levels
    planner = make(
        seed,
        horizon,
        jumps,
        placement=placement,
        process=process,
        noise=noise,
        steps=steps,
    )
    out = planner(batch(8, seed=seed, horizon=horizon))
    assert out["plan"].shape == (8, len(planner.plan_times), DIM)
    assert out["plan"].dtype == torch.float32 and out["plan"].isfinite().all()
    assert torch.equal(at(planner, out, 0), out["observation"])
    for number, level in enumerate(planner.levels):
        place = planner.placement(out["target_step"].squeeze(-1), number, *level)
        pinned = (out["found"].squeeze(-1) & place.active).nonzero().squeeze(-1)
        for row in pinned.tolist():
            time = int(place.token[row]) * level.jump
            assert torch.equal(at(planner, out[row], time), out["target"][row])


def test_target_of_a_row_without_one_is_not_in_its_plan():
    planner = make(noise="seeded")
    td = batch(6, share=0.0)
    out = planner(td)
    assert not (out["plan"] == td["target"][:, None]).all(-1).any()


def test_action_is_inverse_dynamics_of_the_next_planned_state():
    planner = make()
    out = planner(batch(5))
    expected = planner.inverse_dynamics(out["observation"], at(planner, out, 1))
    torch.testing.assert_close(out["action"], expected)


def test_levels_refine_the_first_jump_of_the_one_above():
    planner, inputs = make(horizon=129, jumps=(32, 8, 1), noise="seeded"), []
    for network in planner.networks:
        network.register_forward_pre_hook(lambda module, args: inputs.append(args[:2]))
    out = planner(batch(4, horizon=129, share=0.0))
    first, second, third = inputs[:: planner.steps]
    assert [part[0].shape[1] for part in (first, second, third)] == [5, 5, 9]
    for (sample, mask), jump in ((second, 32), (third, 8)):
        end = planner.normalizer(at(planner, out, jump))
        assert torch.equal(sample[:, -1], end) and mask[:, [0, -1]].all()
        assert not mask[:, 1:-1].any()
    assert first[1].squeeze(-1).tolist() == [[True, False, False, False, False]] * 4


# rows are independent of each other


@pytest.mark.parametrize("noise", ["seeded", "zero"])
@pytest.mark.parametrize("candidates", [1, 3])
def test_mixed_batch_equals_separate_batches(noise, candidates):
    planner = make(
        noise=noise,
        candidates=candidates,
        return_model=ReturnModel(Normalizer.identity(DIM), 5, width=8),
    )
    td = batch(12)
    out, found = planner(td.copy()), td["found"].squeeze(-1)
    assert 2 <= int(found.sum()) <= 10
    for part in (found, ~found, torch.arange(12) == 3):
        alone = planner(td[part].copy())
        torch.testing.assert_close(alone["plan"], out["plan"][part], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(alone["action"], out["action"][part], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("noise", ["seeded", "zero"])
def test_rows_without_a_target_are_planned_as_by_a_mask_without_one(noise):
    planner, td = make(noise=noise), batch(12)
    plan, found = planner(td)["plan"], td["found"].squeeze(-1)
    without = planner.plan(td["observation"], [None, None])
    torch.testing.assert_close(plan[~found], without[~found], atol=1e-4, rtol=1e-4)
    assert ((plan[found] - without[found]).abs().amax((1, 2)) > 1e-3).all()


def test_rows_without_a_target_do_not_read_it():
    planner, td = make(noise="seeded"), batch(12)
    lost = ~td["found"].squeeze(-1)
    other = td.clone()
    other["target"][lost] = torch.nan
    other["target_step"][lost] = 10**9
    assert torch.equal(planner(other)["plan"], planner(td)["plan"])


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (0,)])
@pytest.mark.parametrize("targets", [True, False])
def test_batch_shapes(shape, targets):
    planner = make(noise="seeded", targets=targets)
    td = batch(*shape)
    out = planner(td.copy())
    assert out["plan"].shape == (*shape, len(planner.plan_times), DIM)
    assert out["action"].shape == (*shape, 2) and out.batch_size == shape
    if 0 not in shape:
        flat = planner(td.reshape(-1))["plan"]
        assert torch.equal(out["plan"].reshape(flat.shape), flat)


# noise and candidates


def test_noise_modes():
    td = batch(4)
    sampled = make(noise="sample")
    assert not torch.equal(sampled(td.copy())["plan"], sampled(td.copy())["plan"])
    torch.manual_seed(3)
    first = sampled(td.copy())["plan"]
    torch.manual_seed(3)
    assert torch.equal(sampled(td.copy())["plan"], first)
    for noise in ("seeded", "zero"):
        planner = make(noise=noise)
        state = torch.get_rng_state()
        assert torch.equal(planner(td.copy())["plan"], planner(td.copy())["plan"])
        assert torch.equal(torch.get_rng_state(), state)


def test_deterministic_exploration_uses_the_seeded_noise():
    td, planner = batch(4), make(noise="sample")
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        plan = planner(td.copy())["plan"]
        assert torch.equal(planner(td.copy())["plan"], plan)
    assert torch.equal(make(noise="seeded")(td.copy())["plan"], plan)
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(planner(td.copy())["plan"], plan)


def test_temperature_scales_the_noise():
    td = batch(4)
    zero = make(noise="zero")(td.copy())["plan"]
    assert torch.equal(make(noise="sample", temperature=0.0)(td.copy())["plan"], zero)
    assert torch.equal(make(noise="seeded", temperature=0.0)(td.copy())["plan"], zero)
    td["found"] = torch.zeros(4, 1, dtype=torch.bool)
    plans = []
    for temperature in (1.0, 2.0):  # untrained networks of a flow leave the noise as it is
        planner = make(noise="seeded", temperature=temperature)
        for network in planner.networks:
            network.reset_parameters()
        plans.append(planner.normalizer(at(planner, planner(td.copy()), 6)))
    torch.testing.assert_close(plans[1], 2.0 * plans[0])
    torch.testing.assert_close(plans[0][0], plans[0][3])


def test_a_temperature_for_each_level():
    planner = make(temperature=[1.0, 0.0], noise="sample")
    for network in planner.networks:
        network.reset_parameters()
    out = planner(batch(3, share=0.0))
    mean = planner.normalizer.mean.expand(3, DIM)  # what zero noise is left as
    torch.testing.assert_close(at(planner, out, 1), mean)
    torch.testing.assert_close(at(planner, out, 2), mean)
    assert ((at(planner, out, 6) - mean).abs() > 1e-3).all()
    with pytest.raises(ValueError, match="one for each of the 2 levels"):
        make(temperature=[1.0, 0.0, 0.0])


# changes from the current state


def make_relative(**kwargs):
    planner = make(relative=True, **kwargs)
    for number, scale in enumerate(planner.changes):
        scale.deviation.copy_(torch.tensor([1.0, 2.0, 4.0]) * (number + 1))
    return planner


@pytest.mark.parametrize("noise", ["zero", "seeded"])
def test_untrained_relative_planner_by_hand(noise):
    planner = make_relative(noise=noise)
    for network in planner.networks:
        network.reset_parameters()
    td = batch(4, share=0.0)
    out = planner(td)
    # the first level's noise, in units of its changes, around the current state
    drawn = torch.randn(1, 5, DIM, generator=torch.Generator().manual_seed(0))[0, 2]
    drawn = drawn if noise == "seeded" else torch.zeros(DIM)
    expected = td["observation"] + drawn * torch.tensor([1.0, 2.0, 4.0])
    torch.testing.assert_close(at(planner, out, 6), expected)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), placement=st.sampled_from(PLACEMENTS))
def test_relative_plans_hold_what_is_known(seed, placement):
    planner, td = make_relative(placement=placement), batch(5, seed=seed)
    out = planner(td.copy())
    assert torch.equal(out["plan"][:, 0], td["observation"])
    place = planner.placement(td["target_step"].squeeze(-1), 0, *planner.levels[0])
    for row in range(5):
        if td["found"][row]:
            time = int(place.token[row]) * planner.levels[0].jump
            time = planner.plan_times.tolist().index(time)
            assert torch.equal(out["plan"][row, time], td["target"][row])


def test_relative_networks_see_changes():
    planner, seen = make_relative(steps=1), []
    planner.networks[0].register_forward_hook(lambda module, args, out: seen.append(args[0]))
    td = batch(3, share=1.0)
    td["target_step"] = torch.full((3, 1), 3)
    planner(td)
    now = planner.normalizer(td["observation"])
    change = (td["target"] - td["observation"]) / torch.tensor([1.0, 2.0, 4.0])
    torch.testing.assert_close(seen[0][:, 0], now)
    torch.testing.assert_close(seen[0][:, 1], change)


class LastState(torch.nn.Module):
    """Prefers plans that end far along the first dimension; keeps what it was shown."""

    def forward(self, plans):
        self.plans = plans
        return plans[..., -1, 0]


@pytest.mark.parametrize("noise", ["sample", "seeded"])
def test_the_best_candidate_is_kept(noise):
    model = LastState()
    planner = make(noise=noise, candidates=16, return_model=model)
    out = planner(batch(6))
    plans = model.plans
    assert plans.shape == (6, 16, 5, DIM)
    best = plans[torch.arange(6), plans[:, :, -1, 0].argmax(-1)]
    for token in range(1, 5):  # the states of the first level are in the plan
        assert torch.equal(at(planner, out, 3 * token), best[:, token])
    assert (plans[..., -1, 0].std(1) > 0)[~out["found"].squeeze(-1)].all()
    # every candidate holds what is known
    assert torch.equal(plans[:, :, 0], out["observation"][:, None].expand(6, 16, DIM))


# the shifted target


def database(length=20, episodes=2):
    """Episodes of ``length`` rows; row i of episode e holds [100 e + i, 0, 0]."""
    step = torch.arange(float(length)).repeat(episodes)
    episode = torch.arange(episodes).repeat_interleave(length)
    states = torch.zeros(length * episodes, DIM)
    states[:, 0] = 100 * episode + step
    rows = ExpertDatabase(LazyTensorStorage(1000), sampler=RetrievalSampler("euclidean"))
    rows.extend(
        TensorDict(
            {
                "observation": states,
                "episode": episode,
                "next": {
                    "reward": torch.zeros(len(states), 1),
                    "done": (step == length - 1)[:, None],
                },
            },
            [len(states)],
        )
    )
    return rows


def query(index, step, rows):
    td = batch(len(index), share=2.0)
    td["target_index"] = torch.tensor(index)[:, None]
    td["target_step"] = torch.tensor(step)[:, None]
    td["target"] = rows[:]["observation"][torch.tensor(index)]
    return td


def test_shifted_target_by_hand():
    rows = database()
    planner = make(placement="shifted", database=rows)
    # tokens of the first level are 3 steps apart. Step 5 is nearest to 6, step 4 to 3; the target
    # is row 10 of the first episode, the last or the first of the second
    out = planner(query([10, 39, 20, 38, 10], [5, 5, 4, 11, 12], rows))
    assert at(planner, out, 6)[:2, 0].tolist() == [11.0, 119.0]  # one later; cut at the end
    assert float(at(planner, out, 3)[2, 0]) == 100.0  # one earlier: cut at the episode's begin
    assert float(at(planner, out, 12)[3, 0]) == 119.0  # one later is the last row
    assert float(at(planner, out, 12)[4, 0]) == 10.0  # on the grid as it is
    # in the finer level, whose grid is every step, step 2 is on the grid: the target itself
    out = planner(query([10], [2], rows))
    assert (float(at(planner, out, 2)[0, 0]), float(at(planner, out, 3)[0, 0])) == (10.0, 11.0)


@pytest.mark.parametrize("placement", ["nearest", "next"])
def test_unshifted_target_is_the_target_itself(placement):
    rows = database()
    planner = make(placement=placement, database=rows)
    td = query([10], [5], rows)
    td["target"] += 0.5  # not what the database holds
    assert torch.equal(at(planner, planner(td), 6), td["target"])


@pytest.mark.parametrize("rows", [None, ExpertDatabase(LazyTensorStorage(5))])
def test_without_a_database_the_target_stands_in(rows):
    planner = make(placement="shifted", database=rows)
    td = query([10], [5], database())
    assert torch.equal(at(planner, planner(td), 6), td["target"])


def test_without_an_index_the_target_stands_in():
    rows = database()
    planner = make(placement="shifted", database=rows)
    td = query([10], [5], rows)
    td["target_index"] = torch.full_like(td["target_index"], -1)
    assert torch.equal(at(planner, planner(td.copy()), 6), td["target"])
    assert torch.equal(at(planner, planner(td.exclude("target_index")), 6), td["target"])


def test_steps_outside_the_horizon():
    planner, td = make(noise="seeded"), batch(3, share=2.0)
    td["target_step"] = torch.tensor([[13], [0], [-4]])
    plan = planner(td.copy())["plan"]
    without = planner.plan(td["observation"], [None, None])
    # beyond the horizon: planned without; below 1: at the first grid point
    torch.testing.assert_close(plan[0], without[0], atol=1e-4, rtol=1e-4)
    assert torch.equal(plan[1:, 1], td["target"][1:])


# keys


def test_renamed_and_nested_keys():
    td = batch(4)
    names = [("a", "s"), ("a", "t"), ("b", "f"), "i", "row"]
    keys = ["observation", *TARGET_KEYS]
    nested = TensorDict({}, [4])
    for name, key in zip(names, keys, strict=True):
        nested[name] = td[key]
    planner = make(noise="seeded", in_keys=names, out_keys=[("o", "p"), ("o", "u")])
    planner(nested)
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
    td = policy(batch(3).select("observation"))
    assert td["action"].shape == (3, 2)


@pytest.mark.parametrize("key", ["observation", "target", "found", "target_step"])
def test_missing_key(key):
    with pytest.raises(KeyError, match=f"'{key}' is missing in the tensordict"):
        make()(batch(3).exclude(key))


@pytest.mark.parametrize("key", ["observation", "target"])
@pytest.mark.parametrize(
    "value, message",
    [
        (torch.zeros(3, DIM + 1), r"is \(3, 4\); expected states of 3 entries"),
        (torch.zeros(3, DIM, dtype=torch.int64), "is torch.int64 on cpu; expected floating point"),
        (torch.zeros(3, DIM, device="meta"), "is torch.float32 on meta; expected floating point"),
    ],
)
def test_wrong_states(key, value, message):
    td = batch(3)
    td[key] = value
    with pytest.raises(ValueError, match=f"'{key}' {message}"):
        make()(td)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("process", ["flow", "diffusion"])
def test_nan_in_the_observation_gives_a_finite_action(bad, process):
    planner, td = make(process=process, noise="seeded"), batch(4)
    clean = planner(td.copy())["plan"]
    td["observation"][1, 0] = bad
    td["found"][1] = False
    out = planner(td)
    assert out["action"].isfinite().all() and out["plan"].isfinite().all()
    assert torch.equal(out["plan"][[0, 2, 3]], clean[[0, 2, 3]])
    assert float(at(planner, out, 0)[1, 0]) == 0.0


def test_no_gradient_is_kept():
    out = make()(batch(3))
    assert not out["plan"].requires_grad and not out["action"].requires_grad


# saving


def test_state_dict_round_trip():
    saved, other = make(0, noise="seeded"), make(1, noise="seeded")
    td = batch(4)
    assert not torch.equal(saved(td.copy())["plan"], other(td.copy())["plan"])
    other.load_state_dict(saved.state_dict())
    assert torch.equal(saved(td.copy())["plan"], other(td.copy())["plan"])


def test_database_is_shared_and_no_part_of_the_weights():
    rows = database()
    planner = make(database=rows)
    assert copy.deepcopy(planner).database is rows
    assert planner.state_dict().keys() == make().state_dict().keys()


def test_double_precision():
    td = batch(4)
    single = make(noise="zero")(td.copy())["plan"]
    double = make(noise="zero").double()(td.copy())["plan"]
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"steps": 0}, "steps is 0; a plan needs at least one inference step"),
        ({"temperature": -0.1}, "temperature is -0.1; it must not be negative"),
        ({"candidates": 0}, "candidates is 0: expected 1, or more and a return_model"),
        ({"candidates": 4}, "candidates is 4: expected 1, or more and a return_model"),
        ({"noise": "none"}, "noise is 'none'; expected 'sample', 'seeded' or 'zero'"),
        ({"process": "ddpm"}, "process is 'ddpm'; expected one of"),
        ({"placement": "ceil"}, "placement is 'ceil'; expected one of"),
        ({"in_keys": ["observation"]}, "in_keys are .* expected five and two"),
        ({"out_keys": ["plan"]}, "out_keys .* expected five and two"),
        ({"targets": False, "in_keys": ["a", "b"]}, "expected one and two"),
        ({"jumps": (5, 1)}, "do not multiply out to horizon 13"),
        (
            {"return_model": ReturnModel(Normalizer.identity(DIM), 4)},
            "the return model sees 4 states; the first level of these plans has 5",
        ),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)
