import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.modules.process import AncestralDiffusion, Diffusion, RectifiedFlow, make_process
from torchrl_rad.modules.sampling import sample_plan

PROCESSES = ["flow", "diffusion", "ancestral"]


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


# ancestral sampling


def ddpm(levels):
    """alpha_k and abar_k of DDPM's cosine schedule, k = 0 to K, by Nichol and Dhariwal."""
    bar = [cosine(k / levels)[0] ** 2 for k in range(levels)]
    alpha = [1.0, *(after / before for before, after in zip(bar[:-1], bar[1:], strict=True))]
    return alpha, bar


@settings(max_examples=30, deadline=None)
@given(levels=st.integers(2, 200), data=st.data())
def test_ancestral_step_equals_the_posterior_of_ddpm(levels, data):
    # Ho et al. (2020), equation 7
    k = data.draw(st.integers(1, levels - 1))
    alpha, bar = ddpm(levels)
    if k > 0.99 * levels:
        return  # there abar is kept from 0
    beta = 1 - alpha[k]
    of_data = math.sqrt(bar[k - 1]) * beta / (1 - bar[k])
    of_sample = math.sqrt(alpha[k]) * (1 - bar[k - 1]) / (1 - bar[k])
    process, sample, clean = AncestralDiffusion(), torch.tensor(0.7), torch.tensor(-1.3)
    mean = process.step(sample, clean, k / levels, (k - 1) / levels)
    assert float(mean) == pytest.approx(-1.3 * of_data + 0.7 * of_sample, abs=1e-5)
    variance = beta * (1 - bar[k - 1]) / (1 - bar[k])
    assert process.variance(k / levels, (k - 1) / levels) == pytest.approx(variance, abs=1e-6)
    deviation = process.deviation(k / levels, (k - 1) / levels)
    assert deviation == pytest.approx(math.sqrt(variance), abs=1e-5)


def test_ancestral_step_by_hand():
    # the eleventh of 20 levels: abar 0.4163 after 0.4938
    process, one, zero = AncestralDiffusion(), torch.ones(()), torch.zeros(())
    assert float(process.step(zero, one, 0.55, 0.5)) == pytest.approx(0.1890, abs=1e-4)
    assert float(process.step(one, zero, 0.55, 0.5)) == pytest.approx(0.7962, abs=1e-4)


@settings(max_examples=30, deadline=None)
@given(time=st.floats(0.05, 1.0), share=st.floats(0.0, 0.99))
def test_ancestral_mean_of_a_scaled_clean_sample_is_the_clean_sample_scaled(time, share):
    process, clean = AncestralDiffusion(), torch.tensor([2.0, -0.5])
    following = share * time
    mean = process.step(process.alpha_sigma(time)[0] * clean, clean, time, following)
    torch.testing.assert_close(mean, process.alpha_sigma(following)[0] * clean, atol=1e-5, rtol=0)


def test_no_noise_in_the_last_step():
    process = AncestralDiffusion()
    assert process.variance(0.05, 0.0) == process.deviation(0.05, 0.0) == 0.0
    assert process.deviation(0.1, 0.05) > 0
    assert Diffusion().deviation(0.1, 0.05) == RectifiedFlow().deviation(0.1, 0.05) == 0.0
    prediction = torch.randn(3)
    assert torch.equal(process.step(torch.randn(3), prediction, 0.05, 0.0), prediction)


def test_ancestral_samples_of_noisy_data_are_spread_as_noisy_data():
    # data 0: what is sampled at time s must be N(0, sigma_s^2)
    process, generator = AncestralDiffusion(), torch.Generator().manual_seed(0)
    sample = process.alpha_sigma(0.9)[1] * torch.randn(100_000, generator=generator)
    for time, following in ((0.9, 0.6), (0.6, 0.5), (0.5, 0.1)):
        fresh = torch.randn(100_000, generator=generator)
        mean = process.step(sample, torch.zeros(()), time, following)
        sample = mean + process.deviation(time, following) * fresh
        sigma = float(process.alpha_sigma(following)[1])
        assert float(sample.std()) == pytest.approx(sigma, rel=0.01)


def test_steps_that_fall_together_change_nothing():
    # beyond the last time alpha is kept: of 1000 levels the first ones are one
    sample = torch.randn(3)
    for process in (Diffusion(), AncestralDiffusion()):
        torch.testing.assert_close(process.step(sample, torch.ones(3), 1.0, 0.999), sample)
        assert process.deviation(1.0, 0.999) == 0.0


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
    assert type(make_process("diffusion")) is Diffusion
    assert isinstance(make_process("ancestral"), AncestralDiffusion)
    with pytest.raises(
        ValueError,
        match=r"process is 'ddpm'; expected one of \['ancestral', 'diffusion', 'flow'\]",
    ):
        make_process("ddpm")
