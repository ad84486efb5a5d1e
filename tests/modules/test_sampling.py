import pytest
import torch

from torchrl_rad.modules.process import make_process
from torchrl_rad.modules.sampling import inpaint, sample_plan

PROCESSES = ["flow", "diffusion"]


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
    full, times = mask.expand(4, 5, 3), []

    def network(sample, given, time):
        assert torch.equal(sample[full], known[full]) and given is mask
        assert time.shape == (1,)
        times.append(float(time))
        return torch.randn_like(sample)

    process = make_process(name)
    plan = sample_plan(process, network, torch.randn(4, 5, 3), known, mask, steps)
    assert torch.equal(plan[full], known[full])
    assert plan.isfinite().all()
    assert times == pytest.approx(process.grid(steps)[:-1])


def test_euler_by_hand():
    # the velocity is the sample itself: 1 -> 1 + (1 - t) * 1 -> ..., with t = 0.5 ** 1.5
    t = 0.5**1.5
    expected = (1 + (1 - t)) * (1 + t)
    plan = sample_plan(
        make_process("flow"),
        lambda x, mask, time: x,
        torch.ones(1, 1, 1),
        torch.zeros(1, 1, 1),
        torch.zeros(1, 1, 1, dtype=torch.bool),
        2,
    )
    assert float(plan) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("steps", [0, -1])
def test_too_few_steps(steps):
    mask = torch.zeros(1, 1, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=f"steps is {steps}; a plan needs at least one"):
        sample_plan(
            make_process("flow"),
            lambda x, mask, time: x,
            torch.ones(1, 1, 1),
            torch.ones(1, 1, 1),
            mask,
            steps,
        )
