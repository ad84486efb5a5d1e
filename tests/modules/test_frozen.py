import copy
import pickle
from contextlib import nullcontext

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from torch import nn

from torchrl_rad import DiffuserLitePlanner, InverseDynamics, Normalizer
from torchrl_rad.modules.dit import DiT
from torchrl_rad.modules.frozen import (
    FrozenCache,
    FrozenDiT,
    FrozenLinear,
    PlainNetwork,
    step_network,
)

TIMES = [1.0, 0.6, 0.1]


def trained(tokens=6, seed=0, **options):
    """A network whose output is not zero."""
    torch.manual_seed(seed)
    network = DiT(3, tokens, **{"width": 32, "heads": 4, "blocks": 2, **options})
    with torch.no_grad():
        for parameter in network.parameters():
            if not parameter.any():
                parameter.normal_(0.0, 0.1)
    return network


def inputs(rows=5, tokens=6):
    torch.manual_seed(1)
    return torch.randn(rows, tokens, 3), torch.rand(rows, tokens, 1) < 0.4


@pytest.mark.parametrize("options", [{}, {"mask_channel": False}, {"blocks": 1}, {"blocks": 3}])
@pytest.mark.parametrize("free", [slice(0, 6), slice(1, 6), slice(1, 5), slice(2, 3)])
@pytest.mark.parametrize("rows", [0, 1, 5])
def test_frozen_is_the_network(options, free, rows):
    network, (x, mask) = trained(**options), inputs(rows)
    frozen, plain = FrozenDiT(network, TIMES), PlainNetwork(network, TIMES)
    for step in range(len(TIMES)):
        with torch.no_grad():
            expected = plain(x, plain.prepare(mask), step, free)
            got = frozen(x, frozen.prepare(mask), step, free)
        torch.testing.assert_close(got, expected, atol=1e-5, rtol=1e-5)
        assert expected.shape == (rows, free.stop - free.start, 3)
        assert rows == 0 or expected.abs().mean() > 0.1  # there is something to compare


@pytest.mark.parametrize("dtype, part", [(torch.bfloat16, 64), (torch.float16, 512)])
def test_lower_precision_is_near(dtype, part):
    network, (x, mask) = trained(width=320, heads=10), inputs(50)
    exact, lower = FrozenDiT(network, TIMES), FrozenDiT(network, TIMES, dtype)
    free = slice(1, 6)
    expected = exact(x, exact.prepare(mask), 0, free)
    got = lower(x, lower.prepare(mask), 0, free)
    assert got.dtype == torch.float32
    # factors of 8 bits: a part in 256 of what is added to the residual stream; of 11 bits, in 2048
    assert 0 < (got - expected).abs().max() < expected.abs().max() / part


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("gelu", [False, True])
@pytest.mark.parametrize("rows", [1, 7, 64])
def test_linear(dtype, gelu, rows):
    torch.manual_seed(0)
    layer, x = nn.Linear(40, 24), torch.randn(rows, 40)
    frozen = FrozenLinear(layer.weight, layer.bias, dtype)
    expected = layer(x)
    if gelu:
        expected = nn.functional.gelu(expected)
    got = frozen(x, gelu=gelu)
    if dtype is not torch.float16:  # of which only weights may be
        assert got.dtype == dtype
    tolerance = {torch.bfloat16: 0.03, torch.float16: 0.004}.get(dtype, 1e-5)
    torch.testing.assert_close(got.float(), expected.detach(), atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_linear_without_packing(monkeypatch, dtype):
    """Where the CPU has no such product, or its operator goes away."""
    monkeypatch.setattr("torchrl_rad.modules.frozen.can_pack", lambda dtype: False)
    layer, x = nn.Linear(40, 24), torch.randn(7, 40)
    got = FrozenLinear(layer.weight, layer.bias, dtype)(x, gelu=True)
    assert got.dtype == dtype
    expected = nn.functional.gelu(layer(x))
    torch.testing.assert_close(got.float(), expected.detach(), atol=0.03, rtol=0.03)


# the cache of what was made from weights


def fused_step(network):
    for parameter in network.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.AdamW(network.parameters(), lr=0.1, fused=True).step()


def average(network):
    for parameter in network.parameters():
        parameter.data.lerp_(torch.ones_like(parameter), 0.1)  # as SoftUpdate does


def load(network):
    network.load_state_dict(trained(seed=3).state_dict())


def one_entry(network):
    with torch.no_grad():
        network.blocks[0].qkv.weight[5, 7] += 1.0


def other_storage(network):
    network.head.weight.data = network.head.weight.data.clone()


def other_module(network):
    network.blocks[1].out = nn.Linear(32, 32)


def other_parameter(network):
    network.head.weight = nn.Parameter(network.head.weight.detach().clone())


@pytest.mark.parametrize(
    "change", [fused_step, average, load, one_entry, other_storage, other_module, other_parameter]
)
def test_changed_weights_are_noticed(change):
    cache, network, made = FrozenCache(), trained(), []
    for _ in range(3):
        cache.get(network, "key", lambda: made.append(None))
    assert len(made) == 1
    change(network)
    for _ in range(3):
        cache.get(network, "key", lambda: made.append(None))
    assert len(made) == 2


def test_keys_are_kept_apart():
    cache, network = FrozenCache(), trained()
    assert [cache.get(network, key, lambda key=key: key + 1) for key in (1, 2, 1)] == [2, 3, 2]
    assert cache.get(network, 1, lambda: "anew") == 2


def test_a_module_without_weights():
    cache, module = FrozenCache(), nn.ReLU()
    assert [cache.get(module, 0, lambda value=value: value) for value in (1, 2)] == [1, 1]


def test_functional_weights_are_noticed_and_go_again():
    cache, network = FrozenCache(), trained()
    other = TensorDictParams(TensorDict.from_module(trained(seed=5)).data.clone())
    made = [cache.get(network, 0, lambda: float(network.head.bias.sum()))]
    with other.to_module(network):
        made.append(cache.get(network, 0, lambda: float(network.head.bias.sum())))
    made.append(cache.get(network, 0, lambda: float(network.head.bias.sum())))
    assert made[0] != made[1] and made[0] == made[2]


def test_copies_are_empty():
    cache, network = FrozenCache(), trained()
    cache.get(network, 0, lambda: FrozenDiT(network, TIMES, torch.bfloat16))
    for other in (copy.deepcopy(cache), pickle.loads(pickle.dumps(cache))):
        assert other.made == {} and other.get(network, 0, lambda: 7) == 7


# in a planner


def make_planner(process="flow"):
    states = Normalizer.identity(3)
    torch.manual_seed(0)
    planner = DiffuserLitePlanner(
        states, InverseDynamics(states, states, 2), horizon=13, jumps=(4, 1), width=32, heads=4,
        noise="seeded", targets=False, process=process,
    )  # fmt: skip
    for number, level in enumerate(planner.levels):
        planner.networks[number].load_state_dict(trained(level.tokens).state_dict())
    return planner


@pytest.mark.parametrize("process", ["flow", "diffusion"])
@pytest.mark.parametrize("lower", [False, True], ids=["fp32", "autocast"])
def test_plans_are_those_of_the_plain_network(process, lower):
    planner, td = make_planner(process), TensorDict({"observation": torch.randn(7, 3)}, [7])
    context = torch.autocast("cpu", torch.bfloat16) if lower else nullcontext()
    with context:
        frozen = planner(td.copy())
        calls = [n.register_forward_hook(lambda *_: None) for n in planner.networks]
        plain = planner(td.copy())
    for hook in calls:
        hook.remove()
    tolerance = 0.05 if lower else 1e-5
    for key in ("plan", "action"):
        assert frozen[key].dtype == torch.float32
        torch.testing.assert_close(frozen[key], plain[key], atol=tolerance, rtol=tolerance)


def test_a_hooked_network_is_called():
    planner, seen = make_planner(), []
    td = TensorDict({"observation": torch.randn(2, 3)}, [2])
    planner(td.copy())
    handle = planner.networks[1].register_forward_hook(lambda *_: seen.append(None))
    planner(td.copy())
    assert len(seen) == planner.steps
    handle.remove()
    planner(td.copy())
    assert len(seen) == planner.steps


def test_a_network_of_another_kind():
    class Zero(nn.Module):
        def forward(self, x, mask, time):
            assert time.shape == (1,) and mask.dtype == torch.bool
            return torch.zeros_like(x)

    assert isinstance(step_network(Zero(), TIMES), PlainNetwork)
    planner, td = make_planner(), TensorDict({"observation": torch.randn(2, 3)}, [2])
    before = planner(td.copy())["plan"]
    planner.networks[0] = Zero()
    assert not torch.equal(planner(td.copy())["plan"], before)


def test_planner_with_packed_weights_is_copied_and_pickled():
    planner, td = make_planner(), TensorDict({"observation": torch.randn(2, 3)}, [2])
    with torch.autocast("cpu", torch.bfloat16):
        plan = planner(td.copy())["plan"]
        for other in (copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))):
            assert torch.equal(other(td.copy())["plan"], plan)


def test_no_blocks():
    with pytest.raises(ValueError, match="blocks is 0; expected 1 or more"):
        DiT(3, 6, blocks=0)
