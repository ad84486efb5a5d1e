import pytest
import torch

from torchrl_rad.modules.process import make_process
from torchrl_rad.modules.sampling import Guidance, inpaint, sample_plan

PROCESSES = ["flow", "diffusion", "ancestral"]


def known_entries(per_dim):
    torch.manual_seed(0)
    mask = torch.rand(4, 5, 3 if per_dim else 1) < 0.4
    known = torch.randn(4, 5, 3)
    return torch.where(mask, known, torch.nan), mask  # what is not known must not be read


def test_inpaint_by_hand():
    values, known = torch.tensor([[1.0], [2.0]]), torch.tensor([[8.0], [9.0]])
    assert inpaint(values, known, torch.tensor([[False], [True]])).tolist() == [[1.0], [9.0]]


@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("per_dim", [False, True])
@pytest.mark.parametrize("steps", [1, 4])
def test_known_entries_hold_at_every_call_and_at_the_end(name, per_dim, steps):
    known, mask = known_entries(per_dim)
    full, called = mask.expand(4, 5, 3), []

    def network(sample, step):
        assert torch.equal(sample[full], known[full])
        called.append(step)
        return torch.randn_like(sample)

    process = make_process(name)
    plan = sample_plan(process, network, torch.randn(4, 5, 3), known, mask, steps)
    assert torch.equal(plan[full], known[full])
    assert plan.isfinite().all()
    assert called == list(range(steps))


@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("free", [slice(1, 5), slice(1, 4), slice(0, 5), slice(2, 3)])
def test_known_tokens_at_the_ends_need_no_prediction(name, free):
    process, network = make_process(name), torch.nn.Linear(3, 3)
    mask = torch.ones(4, 5, 1, dtype=torch.bool)
    mask[:, free] = torch.rand(4, free.stop - free.start, 1) < 0.3
    noise, known = torch.randn(2, 4, 5, 3)
    with torch.no_grad():
        torch.manual_seed(0)
        some = sample_plan(
            process, lambda x, step: network(x)[:, free], noise, known, mask, 3, free
        )
        torch.manual_seed(0)
        whole = sample_plan(process, lambda x, step: network(x), noise, known, mask, 3)
    torch.testing.assert_close(some, whole, rtol=0, atol=0)


def test_euler_by_hand():
    # the velocity is the sample itself: 1 -> 1 + (1 - t) * 1 -> ..., with t = 0.5 ** 1.5
    t = 0.5**1.5
    expected = (1 + (1 - t)) * (1 + t)
    plan = sample_plan(
        make_process("flow"),
        lambda x, step: x,
        torch.ones(1, 1, 1),
        torch.zeros(1, 1, 1),
        torch.zeros(1, 1, 1, dtype=torch.bool),
        2,
    )
    assert float(plan) == pytest.approx(expected, rel=1e-6)


def test_fresh_noise_by_hand():
    process = make_process("ancestral")
    none = torch.zeros(1, 1, 1, dtype=torch.bool)
    one, zero = torch.ones(1, 1, 1), torch.zeros(1, 1, 1)
    seen, drawn = [], []

    def network(sample, step):
        seen.append(float(sample))
        return zero

    def fresh():
        drawn.append(10.0)
        return 10 * one

    plan = sample_plan(process, network, one, zero, none, 3, fresh=fresh)
    (_, sigma), (alpha, _) = (process._numbers(2 / 3), process._numbers(1.0))
    mean = alpha / process._numbers(2 / 3)[0] * sigma**2 / process._numbers(1.0)[1] ** 2
    assert seen[:2] == pytest.approx([1.0, mean + 10 * process.deviation(1.0, 2 / 3)], rel=1e-5)
    assert len(drawn) == 2 and float(plan) == 0.0  # none after the last step


def test_noise_is_standard_normal_by_default():
    process, none = make_process("ancestral"), torch.zeros(1, 1, 1, dtype=torch.bool)
    noise = torch.randn(5, 4, 3)
    network = lambda x, step: 0.5 * x  # noqa: E731
    torch.manual_seed(0)
    plan = sample_plan(process, network, noise, noise, none, 4)
    torch.manual_seed(0)
    same = sample_plan(process, network, noise, noise, none, 4, fresh=lambda: torch.randn(5, 4, 3))
    assert torch.equal(plan, same)


def test_guidance_by_hand():
    # the value is the sum of the sample's squares: the gradient doubles it
    calls, seen = [], []
    known, mask = torch.tensor([[[7.0], [0.0]]]), torch.tensor([[[True], [False]]])

    def gradient(sample, step):
        calls.append((step, sample.flatten().tolist()))
        return 2 * sample

    def network(sample, step):
        seen.append(sample.flatten().tolist())
        return torch.zeros_like(sample)

    sample_plan(
        make_process("flow"),
        network,
        torch.ones(1, 2, 1),
        known,
        mask,
        2,
        guidance=Guidance(gradient, [0.5, 0.0], repeats=2),
    )
    assert calls == [(0, [7.0, 1.0]), (0, [7.0, 2.0])]  # known entries stay
    assert seen == [[7.0, 4.0], [7.0, 4.0]]  # the network sees what was moved


@pytest.mark.parametrize("steps", [0, -1])
def test_too_few_steps(steps):
    mask = torch.zeros(1, 1, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=f"steps is {steps}; a plan needs at least one"):
        sample_plan(
            make_process("flow"),
            lambda x, step: x,
            torch.ones(1, 1, 1),
            torch.ones(1, 1, 1),
            mask,
            steps,
        )
