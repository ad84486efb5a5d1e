import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.modules.process import Diffusion, RectifiedFlow, make_process
from torchrl_rad.modules.sampling import sample_plan

PROCESSES = ["flow", "diffusion"]


def cosine(time):
    """Scale of the data and of the noise by Nichol and Dhariwal's formula, in double precision."""
    alpha = math.cos(math.pi / 2 * (time + 0.008) / 1.008) / math.cos(math.pi / 2 * 0.008 / 1.008)
    return alpha, math.sqrt(1 - alpha**2)


def test_flow_by_hand():
    flow = RectifiedFlow()
    clean, noise = torch.tensor([2.0, 0.0]), torch.tensor([-2.0, 4.0])
    assert flow.corrupt(clean, noise, torch.tensor(0.25)).tolist() == [1.0, 1.0]
    assert flow.target(clean, noise).tolist() == [4.0, -4.0]
    # from time 0.75 to 0.25 along a velocity of 4: 1 + 0.5 * 4
    assert flow.step(torch.tensor([1.0]), torch.tensor([4.0]), 0.75, 0.25).tolist() == [3.0]


def test_flow_grid_by_hand():
    flow = RectifiedFlow()
    assert flow.grid(1) == [1.0, 0.0]
    assert flow.grid(3) == pytest.approx([1.0, 0.5443, 0.1925, 0.0], abs=1e-4)
    assert flow.grid(5) == pytest.approx([1.0, 0.7155, 0.4648, 0.2530, 0.0894, 0.0], abs=1e-4)


def test_diffusion_grid_by_hand():
    assert Diffusion().grid(4) == [1.0, 0.75, 0.5, 0.25, 0.0]


@pytest.mark.parametrize("time", [0.0, 0.1, 0.5, 0.9])
def test_diffusion_scales(time):
    alpha, sigma = Diffusion().alpha_sigma(time)
    assert (float(alpha), float(sigma)) == pytest.approx(cosine(time), abs=1e-5)


def test_diffusion_corrupts_and_predicts_the_clean_data():
    diffusion = Diffusion()
    clean, noise = torch.tensor([2.0]), torch.tensor([-1.0])
    alpha, sigma = cosine(0.3)
    noisy = diffusion.corrupt(clean, noise, torch.tensor([0.3]))
    assert float(noisy) == pytest.approx(2 * alpha - sigma, abs=1e-6)
    assert torch.equal(diffusion.target(clean, noise), clean)


def test_ddim_equals_its_formula():
    # x' = alpha' x0 + sigma' (x - alpha x0) / sigma (Song et al., 2021, equation 12, eta 0)
    (alpha, sigma), (alpha_next, sigma_next) = cosine(0.75), cosine(0.5)
    sample, predicted = 0.8, -0.3
    expected = alpha_next * predicted + sigma_next * (sample - alpha * predicted) / sigma
    got = Diffusion().step(torch.tensor(sample), torch.tensor(predicted), 0.75, 0.5)
    assert float(got) == pytest.approx(expected, abs=1e-6)


def test_ddim_keeps_the_noise_of_an_exact_prediction():
    diffusion = Diffusion()
    clean, noise = torch.randn(50), torch.randn(50)
    sample = diffusion.corrupt(clean, noise, torch.tensor(0.9))
    stepped = diffusion.step(sample, clean, 0.9, 0.4)
    torch.testing.assert_close(stepped, diffusion.corrupt(clean, noise, torch.tensor(0.4)))


def test_diffusion_is_finite_at_time_one():
    diffusion = Diffusion()
    alpha, sigma = diffusion.alpha_sigma(1.0)
    assert 0 < float(alpha) < 0.01 and float(sigma) == pytest.approx(1.0, abs=1e-3)
    noisy = diffusion.corrupt(torch.ones(3), torch.full((3,), 2.0), torch.ones(3))
    torch.testing.assert_close(noisy, torch.full((3,), 2.0), atol=0.01, rtol=0)
    assert diffusion.step(noisy, torch.ones(3), 1.0, 0.5).isfinite().all()


@pytest.mark.parametrize("name", PROCESSES)
def test_time_broadcasts_against_a_batch(name):
    process = make_process(name)
    clean, noise, time = torch.randn(3, 4, 2), torch.randn(3, 4, 2), torch.rand(3)
    together = process.corrupt(clean, noise, time[:, None, None])
    for row in range(3):
        torch.testing.assert_close(
            together[row], process.corrupt(clean[row], noise[row], time[row])
        )


@pytest.mark.parametrize("name", PROCESSES)
@settings(max_examples=20, deadline=None)
@given(steps=st.integers(1, 7), seed=st.integers(0, 1000))
def test_a_perfect_network_recovers_the_data(name, steps, seed):
    generator = torch.Generator().manual_seed(seed)
    clean, noise = torch.randn(2, 3, 5, 2, generator=generator)
    process = make_process(name)
    target = process.target(clean, noise)
    mask = torch.zeros(3, 5, 1, dtype=torch.bool)
    plan = sample_plan(process, lambda x, step: target, noise, clean, mask, steps)
    torch.testing.assert_close(plan, clean, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", PROCESSES)
@given(steps=st.integers(1, 50))
@settings(max_examples=20, deadline=None)
def test_grids_fall_from_one_to_zero(name, steps):
    grid = make_process(name).grid(steps)
    assert len(grid) == steps + 1 and grid[0] == 1.0 and grid[-1] == 0.0
    assert all(earlier > later for earlier, later in zip(grid[:-1], grid[1:], strict=True))


@pytest.mark.parametrize("name", PROCESSES)
def test_double_precision_is_kept(name):
    process = make_process(name)
    clean, noise = torch.randn(2, 3, 2, 2, dtype=torch.float64)
    assert process.corrupt(clean, noise, torch.rand(3, 1, 1)).dtype == torch.float64
    assert process.step(noise, clean, 0.6, 0.3).dtype == torch.float64


def test_names():
    assert isinstance(make_process("flow"), RectifiedFlow)
    assert isinstance(make_process("diffusion"), Diffusion)
    with pytest.raises(
        ValueError, match=r"process is 'ddpm'; expected one of \['diffusion', 'flow'\]"
    ):
        make_process("ddpm")
