import pytest
import torch
from torch.nn import functional as F

from torchrl_rad.modules.temporal_unet import ConvBlock, ResidualBlock, TemporalUNet, TimeCode


def make(seed=0, entries=5, width=8, multiples=(1, 2, 4), **kwargs):
    torch.manual_seed(seed)
    return TemporalUNet(entries, width, multiples, **kwargs)


def inputs(rows=3, length=16, entries=5, channels=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(rows, length, entries, generator=generator)
    return x, torch.rand(rows, length, channels, generator=generator) < 0.3


# values


def test_conv_block_equals_its_formula():
    torch.manual_seed(0)
    block, x = ConvBlock(3, 16), torch.randn(2, 3, 8)
    for parameter in block.parameters():
        torch.nn.init.normal_(parameter)
    padded = F.pad(x, (2, 2))
    h = block[0].bias[:, None].expand(2, 16, 8).clone()
    for time in range(8):
        for tap in range(5):
            h[:, :, time] += padded[:, :, time + tap] @ block[0].weight[:, :, tap].T
    grouped = h.view(2, 8, -1)  # eight groups of two channels
    grouped = (grouped - grouped.mean(-1, keepdim=True)) / (
        grouped.var(-1, keepdim=True, correction=0) + 1e-5
    ).sqrt()
    h = grouped.view(2, 16, 8) * block[1].weight[:, None] + block[1].bias[:, None]
    expected = h * (1 + h.exp()).log().tanh()
    torch.testing.assert_close(block(x), expected, atol=1e-4, rtol=1e-4)


def test_residual_block_by_hand():
    # convolutions that give zeros, and a normalisation that keeps them: the shortcut is left
    block, x = ResidualBlock(8, 8, 4), torch.randn(2, 8, 6)
    for conv in (block.first, block.second):
        torch.nn.init.zeros_(conv[0].weight)
        torch.nn.init.zeros_(conv[0].bias)
    assert torch.equal(block(x, torch.randn(2, 4)), x)


def test_sizes_are_those_of_diffuser():
    # Diffuser's own for hopper has 3,956,302; the mask adds 5 taps and a shortcut, 32 channels each
    network = TemporalUNet(14)
    assert sum(p.numel() for p in network.parameters()) == 3_956_302 + 6 * 32
    network = TemporalUNet(6, 32, (1, 4, 8))
    assert sum(p.numel() for p in network.parameters()) == 3_682_118 + 6 * 32


# what is given


@pytest.mark.parametrize("length", [32, 64, 128, 256, 384])
@pytest.mark.parametrize("multiples", [(1, 2, 4, 8), (1, 4, 8), (1,)])
def test_lengths(length, multiples):
    network = make(multiples=multiples)
    x, mask = inputs(2, length)
    out = network(x, mask, torch.rand(2))
    assert out.shape == x.shape and out.isfinite().all()


@pytest.mark.parametrize("multiples", [(1, 2, 4, 8), (1, 4, 8)])
def test_the_shortest_length(multiples):
    length = 2 ** (len(multiples) - 1)
    x, mask = inputs(2, length)
    assert make(multiples=multiples)(x, mask, torch.rand(2)).shape == x.shape


def test_batch_of_one_equals_batch_of_many():
    network, (x, mask), time = make(), inputs(), torch.rand(3)
    out = network(x, mask, time)
    each = [network(x[i : i + 1], mask[i : i + 1], time[i : i + 1]) for i in range(3)]
    torch.testing.assert_close(torch.cat(each), out, atol=1e-5, rtol=1e-4)


def test_empty_batch():
    assert make()(*inputs(0), torch.rand(1)).shape == (0, 16, 5)


def test_one_time_holds_for_all_rows():
    network, (x, mask) = make(), inputs()
    together = network(x, mask, torch.full((1,), 0.3))
    torch.testing.assert_close(together, network(x, mask, torch.full((3,), 0.3)))
    assert not torch.allclose(together, network(x, mask, torch.full((1,), 0.9)), atol=1e-3)


def test_the_code_of_one_time_is_made_once():
    network, (x, mask), rows = make(), inputs(), []
    for module in network.modules():
        if isinstance(module, TimeCode | torch.nn.Linear):
            module.register_forward_hook(lambda module, args, out: rows.append(len(out)))
    network(x, mask, torch.full((1,), 0.3))
    assert set(rows) == {1}


@pytest.mark.parametrize("channels", [1, 2])
def test_is_told_which_entries_are_known(channels):
    network = make(mask_channels=channels)
    x, mask = inputs(channels=channels)
    out = network(x, mask, torch.rand(1))
    assert not torch.allclose(out, network(x, torch.zeros_like(mask), torch.rand(1)), atol=1e-3)


def test_every_step_sees_every_other():
    # at the lowest of three resolutions four steps of 16 are left
    network, (x, mask) = make(), inputs(1)
    x.requires_grad_()
    network(x, mask, torch.rand(1))[0, 0].sum().backward()
    assert (x.grad.abs().sum(-1) > 0).all()


def test_steps_asked_for():
    network, (x, mask), time = make(), inputs(), torch.rand(3)
    part = network(x, mask, time, free=slice(2, 7))
    assert torch.equal(part, network(x, mask, time)[:, 2:7])


def test_all_parameters_are_used_and_reset():
    network, (x, mask) = make(), inputs()
    network(x, mask, torch.rand(3)).square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in network.parameters())
    before = {name: p.clone() for name, p in network.named_parameters()}
    network.reset_parameters()
    for name, p in network.named_parameters():
        assert p.ndim < 2 or not torch.equal(p, before[name]), name


def test_double_precision():
    network, (x, mask), time = make(), inputs(), torch.rand(3)
    single = network(x, mask, time)
    double = network.double()(x.double(), mask, time)
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, atol=1e-4, rtol=1e-4)


# what cannot be


@pytest.mark.parametrize(
    "length, message",
    [
        (18, "18 steps cannot be halved 2 times, as the 3 resolutions .* use 16 or 20, or fewer"),
        (3, "a plan of 3 steps cannot be halved 2 times, .* use 4, or fewer multiples"),
        (265, "use 264 or 268"),
    ],
)
def test_lengths_that_cannot_be_halved(length, message):
    with pytest.raises(ValueError, match=message):
        make()(*inputs(length=length), torch.rand(1))


def test_wrong_shapes():
    x, mask = inputs()
    with pytest.raises(ValueError, match=r"are \(3, 16, 4\); expected \[B, L, 5\]"):
        make()(x[..., :4], mask, torch.rand(1))
    with pytest.raises(ValueError, match=r"the mask is \(3, 16, 5\); expected \(3, 16, 1\)"):
        make()(x, mask.expand_as(x), torch.rand(1))


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"width": 6}, r"width is 6 and multiples are \[1, 2, 4\]; expected .* divisible by 8"),
        ({"width": 2, "multiples": (4,)}, "width is 2"),
        ({"multiples": ()}, "multiples are empty"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)
