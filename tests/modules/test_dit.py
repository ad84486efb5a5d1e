import pytest
import torch

from torchrl_rad.modules.dit import DiT, sinusoids


def make(seed=0, **kwargs):
    """A small DiT whose zero layers have been filled: everything takes part in the output."""
    torch.manual_seed(seed)
    network = DiT(state_dim=3, tokens=5, width=32, heads=4, **kwargs)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return network


def batch(rows=6, seed=1):
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(rows, 5, 1, generator=generator) < 0.4
    return torch.randn(rows, 5, 3, generator=generator), mask, torch.rand(rows, generator=generator)


def test_sinusoids_by_hand():
    codes = sinusoids(torch.tensor([0.0, 2.0]), 4)
    assert codes[0].tolist() == [0.0, 0.0, 1.0, 1.0]
    expected = torch.cat([torch.tensor([2.0, 2e-4]).sin(), torch.tensor([2.0, 2e-4]).cos()])
    torch.testing.assert_close(codes[1], expected)


def test_output_is_zero_at_initialisation():
    network = DiT(state_dim=3, tokens=5, width=32)
    out = network(*batch())
    assert out.shape == (6, 5, 3)
    assert torch.equal(out, torch.zeros_like(out))


def test_size_of_the_default_network():
    # per level: in 5W + W, time 2(W^2 + W), blocks of qkv 3(W^2 + W), out W^2 + W, MLP 8W^2 + 5W,
    # modulation 6(W^2 + W), final modulation 2(W^2 + W), head 4W + 4
    width = 256
    square = width**2 + width
    block = 3 * square + square + 8 * width**2 + 5 * width + 6 * square
    expected = 6 * width + 2 * square + 2 * block + 2 * square + 4 * width + 4
    assert sum(p.numel() for p in DiT(state_dim=4, tokens=5).parameters()) == expected


def test_batch_of_one_equals_batch_of_many():
    network = make()
    x, mask, time = batch()
    together = network(x, mask, time)
    for row in range(len(x)):
        part = slice(row, row + 1)
        torch.testing.assert_close(together[part], network(x[part], mask[part], time[part]))


def test_empty_batch():
    assert make()(*batch(0)).shape == (0, 5, 3)


def test_one_time_for_all_rows_equals_that_time_in_each():
    network = make()
    x, mask, _ = batch()
    shared = network(x, mask, torch.full((1,), 0.3))
    torch.testing.assert_close(shared, network(x, mask, torch.full((6,), 0.3)))


def test_one_time_is_conditioned_on_once():
    network, seen = make(), []
    network.time.register_forward_hook(lambda module, args, out: seen.append(out.shape))
    for block in network.blocks:
        block.modulation.register_forward_hook(lambda module, args, out: seen.append(out.shape))
    x, mask, _ = batch()
    network(x, mask, torch.full((1,), 0.3))
    assert seen == [(1, 32), (1, 6 * 32), (1, 6 * 32)]


@pytest.mark.parametrize("argument", ["x", "mask", "time"])
def test_output_depends_on(argument):
    network = make()
    given = dict(zip(("x", "mask", "time"), batch(), strict=True))
    changed = {**given, argument: ~given["mask"] if argument == "mask" else given[argument] + 0.5}
    assert (network(**given) - network(**changed)).abs().amax((1, 2)).min() > 1e-4


def test_without_a_mask_channel_the_mask_is_not_read():
    network = make(mask_channel=False)
    assert network.embed.in_features == 3 and make().embed.in_features == 4
    x, mask, time = batch()
    assert torch.equal(network(x, mask, time), network(x, ~mask, time))


def test_tokens_are_told_apart():
    network = make()
    x, mask, time = torch.ones(1, 5, 3), torch.zeros(1, 5, 1, dtype=torch.bool), torch.rand(1)
    out = network(x, mask, time)[0]
    assert (out[1:] - out[:-1]).abs().amax(-1).min() > 1e-4


def test_attention_reaches_every_token():
    network = make()
    x, mask, time = batch(1)
    x.requires_grad_()
    network(x, mask, time)[0, 0].sum().backward()
    assert (x.grad[0].abs().amax(-1) > 0).all()


def test_gradients_reach_every_parameter_after_a_few_steps():
    torch.manual_seed(0)
    network = DiT(state_dim=3, tokens=5, width=32, heads=4)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    x, mask, time = batch()
    wanted = torch.randn(6, 5, 3)
    losses = []
    for _ in range(4):
        optimizer.zero_grad()
        loss = (network(x, mask, time) - wanted).square().mean()
        loss.backward()
        losses.append(float(loss.detach()))
        optimizer.step()
    silent = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert silent == []
    assert losses[-1] < losses[0]


def test_double_precision():
    network = make()
    x, mask, time = batch()
    single = network(x, mask, time)
    double = network.double()(x.double(), mask, time)
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("whole", [False, True])
def test_bfloat16_is_close(whole):
    network = make()
    x, mask, time = batch()
    exact = network(x, mask, time)
    with torch.autocast("cpu", torch.bfloat16, enabled=not whole):
        out = network.bfloat16()(x.bfloat16(), mask, time) if whole else network(x, mask, time)
    assert out.dtype == torch.bfloat16
    assert (out.float() - exact).abs().mean() < 0.05 * exact.abs().mean()


def test_state_dict_round_trip():
    network, other = make(0), make(1)
    assert not torch.equal(network(*batch()), other(*batch()))
    other.load_state_dict(network.state_dict())
    assert torch.equal(network(*batch()), other(*batch()))


@pytest.mark.parametrize("width, heads", [(30, 4), (9, 3), (2, 1)])
def test_bad_width(width, heads):
    with pytest.raises(ValueError, match=rf"width is {width}; expected an even multiple of heads"):
        DiT(state_dim=3, tokens=5, width=width, heads=heads)


@pytest.mark.parametrize("free", [slice(0, 5), slice(1, 5), slice(1, 4), slice(2, 3)])
def test_only_the_tokens_asked_for(free):
    network = DiT(3, 5, width=32, heads=4)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(0.0, 0.2)
    x, mask, time = torch.randn(4, 5, 3), torch.rand(4, 5, 1) < 0.5, torch.rand(4)
    torch.testing.assert_close(network(x, mask, time, free), network(x, mask, time)[:, free])
