"""The U-Net and the steps of its processes against those of the package diffusers."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.modules.process import AncestralDiffusion, Diffusion
from torchrl_rad.modules.temporal_unet import TemporalUNet

diffusers = pytest.importorskip("diffusers")


def scheduler(kind, levels, **options):
    """One whose noise levels are those of our schedule at times 1/n, 2/n, ..., 1."""
    time = torch.arange(levels + 1, dtype=torch.float64) / levels
    angle = torch.pi / 2 * (time.clamp_max(0.9946) + 0.008) / 1.008
    kept = (angle.cos() / angle[0].cos()).square()
    options.update(prediction_type="sample", clip_sample=False)
    made = kind(levels, trained_betas=(1 - kept[1:] / kept[:-1]).numpy(), **options)
    made.alphas_cumprod = kept[1:]  # theirs are multiplied up in float32
    return made


levels_and_step = st.integers(2, 50).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1)))


@settings(max_examples=50, deadline=None)
@given(which=levels_and_step, seed=st.integers(0, 1000))
def test_noising(which, seed):
    levels, step = which
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, 4, 8, 5, generator=generator)
    theirs = scheduler(diffusers.DDPMScheduler, levels)
    expected = theirs.add_noise(clean, noise, torch.full((4,), step))
    found = Diffusion().corrupt(clean, noise, torch.tensor((step + 1) / levels))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@settings(max_examples=50, deadline=None)
@given(which=levels_and_step, seed=st.integers(0, 1000))
def test_ancestral_step(which, seed):
    levels, step = which
    generator = torch.Generator().manual_seed(seed)
    sample, predicted = torch.randn(2, 4, 8, 5, generator=generator)
    theirs = scheduler(diffusers.DDPMScheduler, levels, variance_type="fixed_small")
    drawn = torch.Generator().manual_seed(seed)
    expected = theirs.step(predicted, step, sample, generator=drawn).prev_sample
    process, time, following = AncestralDiffusion(), (step + 1) / levels, step / levels
    found = process.step(sample, predicted, time, following)
    if step > 0:  # none is added after the last one
        fresh = torch.randn(sample.shape, generator=torch.Generator().manual_seed(seed))
        found = found + process.deviation(time, following) * fresh
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 5, 20])
def test_ddim_sampling(steps):
    torch.manual_seed(steps)
    process, theirs = Diffusion(), scheduler(
        diffusers.DDIMScheduler, 20, timestep_spacing="trailing", set_alpha_to_one=True
    )  # fmt: skip
    theirs.set_timesteps(steps)
    found = expected = torch.randn(4, 8, 5)
    grid = process.grid(steps)
    for number, step in enumerate(theirs.timesteps):
        assert (int(step) + 1) / 20 == pytest.approx(grid[number])
        predicted = torch.randn(4, 8, 5)
        expected = theirs.step(predicted, step, expected, eta=0.0).prev_sample
        found = process.step(found, predicted, grid[number], grid[number + 1])
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def take_block(ours, theirs):
    for mine, given_ in ((ours.first, theirs.conv_in), (ours.second, theirs.conv_out)):
        mine[0].load_state_dict(given_.conv1d.state_dict())
        mine[1].load_state_dict(given_.group_norm.state_dict())
    ours.time.load_state_dict(theirs.time_emb.state_dict())
    ours.skip.load_state_dict(theirs.residual_conv.state_dict())


def take_weights(ours, theirs):
    """The same network, whose modules have other names."""
    ours.time.first.load_state_dict(theirs.time_mlp.linear_1.state_dict())
    ours.time.rest[1].load_state_dict(theirs.time_mlp.linear_2.state_dict())
    down = ours.encoder
    for level, block in enumerate(theirs.down_blocks):
        take_block(down.first[level], block.resnets[0])
        take_block(down.second[level], block.resnets[1])
        if level < len(down.down):
            down.down[level].load_state_dict(block.downsample.conv.state_dict())
    for mine, block in zip(ours.middle, theirs.mid_block.resnets, strict=True):
        take_block(mine, block)
    for level, block in enumerate(theirs.up_blocks):
        take_block(ours.first[level], block.resnets[0])
        take_block(ours.second[level], block.resnets[1])
        ours.up[level].load_state_dict(block.upsample.conv.state_dict())
    ours.last[0].load_state_dict(theirs.out_block.final_conv1d_1.state_dict())
    ours.last[1].load_state_dict(theirs.out_block.final_conv1d_gn.state_dict())
    ours.head.load_state_dict(theirs.out_block.final_conv1d_2.state_dict())


@pytest.mark.parametrize("multiples", [(1, 2, 4, 8), (1, 4, 8), (1, 2)])
def test_u_net(multiples):
    torch.manual_seed(0)
    entries, channels = 6, [32 * multiple for multiple in multiples]
    theirs = diffusers.UNet1DModel(
        in_channels=entries + 1,
        out_channels=entries,
        block_out_channels=channels,
        down_block_types=["DownResnetBlock1D"] * len(channels),
        mid_block_type="MidResTemporalBlock1D",
        up_block_types=["UpResnetBlock1D"] * (len(channels) - 1),
        out_block_type="OutConv1DBlock",
        act_fn="mish",
        use_timestep_embedding=True,
        time_embedding_type="positional",
        flip_sin_to_cos=False,
        freq_shift=1,
        layers_per_block=1,
    )
    ours = TemporalUNet(entries, 32, multiples)
    take_weights(ours, theirs)
    x, mask, time = torch.randn(3, 16, entries), torch.rand(3, 16, 1) < 0.3, torch.rand(3)
    seen = torch.cat([x, mask.float()], -1).transpose(1, 2)
    with torch.no_grad():
        expected = theirs(seen, 1000.0 * time).sample.transpose(1, 2)
        torch.testing.assert_close(ours(x, mask, time), expected, atol=1e-5, rtol=0)
