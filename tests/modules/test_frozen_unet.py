import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.modules.frozen_unet import (
    FrozenConv,
    FrozenConvBlock,
    FrozenDown,
    FrozenResidualBlock,
    FrozenReturnModel,
    FrozenUNet,
    FrozenUp,
    as_phases,
    as_steps,
    can_tile,
    mish_slope,
)
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel, PlainReturnModel
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.temporal_unet import ConvBlock, ResidualBlock, TemporalUNet

CLOSE = {"atol": 1e-4, "rtol": 1e-4}


def phases(x):
    return as_phases(x.permute(2, 0, 1).contiguous())


def back(x):
    return as_steps(x).permute(1, 2, 0)


def randomised(module):
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return module


def through_autograd(module, x, grad):
    x = x.clone().requires_grad_()
    return torch.autograd.grad(module(x), x, grad)[0]


@pytest.mark.parametrize("length, resolutions, fits", [(32, 4, True), (8, 2, True), (8, 3, False),
    (384, 4, True), (48, 4, False), (4, 1, True)])  # fmt: skip
def test_can_tile(length, resolutions, fits):
    assert can_tile(length, resolutions) == fits


@settings(max_examples=30, deadline=None)
@given(tiles=st.integers(1, 4), rows=st.integers(0, 3), seed=st.integers(0, 100))
def test_convolution(tiles, rows, seed):
    torch.manual_seed(seed)
    x, weight, bias = torch.randn(rows, 3, 4 * tiles), torch.randn(6, 3, 5), torch.randn(6)
    expected = F.conv1d(x, weight, bias, padding=2)
    torch.testing.assert_close(back(FrozenConv(weight, bias)(phases(x))), expected, **CLOSE)


def test_convolution_of_an_impulse_by_hand():
    x = torch.zeros(1, 1, 8)
    x[0, 0, 4] = 1.0
    weight = torch.tensor([[[1.0, 2.0, 3.0, 4.0, 5.0]]])
    out = back(FrozenConv(weight)(phases(x))).flatten()
    assert out.tolist() == pytest.approx([0, 0, 5, 4, 3, 2, 1, 0], abs=1e-5)


@pytest.mark.parametrize("length", [4, 12])
@pytest.mark.parametrize("before", [8, 3])
def test_blocks_and_their_gradients(length, before):
    torch.manual_seed(0)
    x, grad, codes = torch.randn(5, before, length), torch.randn(5, 8, length), torch.randn(2, 4)
    block, tape = randomised(ConvBlock(before, 8)), []
    frozen = FrozenConvBlock(block, gradients=True)
    torch.testing.assert_close(back(frozen(phases(x), tape)), block(x), **CLOSE)
    expected = through_autograd(block, x, grad)
    torch.testing.assert_close(back(frozen.gradient(phases(grad), tape)), expected, **CLOSE)
    block = randomised(ResidualBlock(before, 8, 4))
    with torch.no_grad():
        frozen = FrozenResidualBlock(block, codes, gradients=True)
    run = lambda x: block(x, codes[1:])  # noqa: E731
    out = frozen(phases(x), torch.tensor([1]), tape)
    torch.testing.assert_close(back(out), run(x), **CLOSE)
    expected = through_autograd(run, x, grad)
    torch.testing.assert_close(back(frozen.gradient(phases(grad), tape)), expected, **CLOSE)
    assert not tape


@pytest.mark.parametrize("length", [8, 24])
def test_halving_and_doubling(length):
    torch.manual_seed(0)
    x, grad = torch.randn(3, 6, length), torch.randn(3, 6, length // 2)
    down = torch.nn.Conv1d(6, 6, 3, 2, padding=1)
    up = torch.nn.ConvTranspose1d(6, 6, 4, 2, padding=1)
    torch.testing.assert_close(back(FrozenDown(down)(phases(x))), down(x), **CLOSE)
    expected = through_autograd(down, x, grad)
    torch.testing.assert_close(back(FrozenDown(down).gradient(phases(grad))), expected, **CLOSE)
    torch.testing.assert_close(back(FrozenUp(up)(phases(x))), up(x), **CLOSE)


def test_mish_slope():
    y = torch.tensor([-200.0, -30.0, -1.0, 0.0, 1.0, 15.0, 35.0, 200.0], requires_grad=True)
    (expected,) = torch.autograd.grad(F.mish(y).sum(), y)
    torch.testing.assert_close(mish_slope(y.detach()), expected, atol=1e-6, rtol=1e-5)


def test_activations_far_from_zero():
    # exp of them is infinite or 0
    block, x = ConvBlock(8, 8), torch.randn(2, 8, 4)
    torch.nn.init.constant_(block[1].weight, 200.0)
    out = FrozenConvBlock(block, gradients=False)(phases(x))
    assert out.isfinite().all()
    torch.testing.assert_close(back(out), block(x), atol=1e-2, rtol=1e-4)


@pytest.mark.parametrize("multiples", [(1, 2, 4, 8), (1, 4), (1,)])
@pytest.mark.parametrize("rows", [0, 1, 7])
@torch.no_grad()
def test_network(multiples, rows):
    torch.manual_seed(0)
    network = TemporalUNet(5, 8, multiples)
    x, mask = torch.randn(rows, 32, 5), torch.rand(rows, 32, 1) < 0.3
    frozen = FrozenUNet(network, [1.0, 0.4])
    for step, time in enumerate((1.0, 0.4)):
        expected = network(x, mask, torch.full((1,), time))
        out = frozen(x, frozen.prepare(mask), step, slice(None))
        torch.testing.assert_close(out, expected, **CLOSE)
        out = frozen(x, frozen.prepare(mask), step, slice(3, 9))
        torch.testing.assert_close(out, expected[:, 3:9], **CLOSE)


@pytest.mark.parametrize("multiples", [(1, 2, 4, 8), (1, 4), (1,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_return_model(multiples, dtype):
    torch.manual_seed(0)
    model = NoisyReturnModel(Normalizer.identity(3), 2, 32, 8, multiples).to(dtype)
    x, mask = torch.randn(6, 32, 5, dtype=dtype), torch.rand(6, 32, 1) < 0.3
    times = [1.0, 0.4, 0.0]
    frozen, plain = FrozenReturnModel(model, times), PlainReturnModel(model, times)
    for step in range(3):
        value, grad = frozen.value(x, mask, step), frozen.gradient(x, mask, step)
        assert value.dtype == grad.dtype == dtype and not grad.requires_grad
        torch.testing.assert_close(value, plain.value(x, mask, step).detach(), **CLOSE)
        torch.testing.assert_close(grad, plain.gradient(x, mask, step), atol=1e-5, rtol=1e-4)
