"""Each loss forward, and forward and backward; one step of the optimisers."""

from __future__ import annotations

import argparse
import gc

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from torchrl_rad import (
    DenoisingLoss,
    DiffuserLitePlanner,
    InverseDynamics,
    Normalizer,
    ReturnGuidanceLoss,
    ReturnModel,
    StepEstimationLoss,
    StepEstimator,
    draw_step_pairs,
    inverse_dynamics_actor,
)
from torchrl_rad.training import Objective, uses_bf16

THREADS = 1
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
BATCH, HORIZON, JUMPS = 128, 129, (32, 8, 1)
STATE, ACTION = 4, 2  # PointMaze's
LOSSES = ["denoising", "step_estimation", "return_guidance", "behaviour_cloning"]


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), windows=BATCH, horizon=HORIZON)
    yield
    gc.collect()  # losses and optimisers refer to each other


@pytest.fixture(scope="module")
def windows():
    """Windows [BATCH, HORIZON] of random walks."""
    generator = torch.Generator().manual_seed(0)
    shape = (BATCH, HORIZON + 1, STATE)
    walk = (0.05 * torch.randn(shape, generator=generator)).cumsum(1).to(DEVICE)
    reward = torch.zeros(BATCH, HORIZON, 1, device=DEVICE)
    steps = {
        "observation": walk[:, :-1],
        "action": torch.zeros(BATCH, HORIZON, ACTION, device=DEVICE),
        "return_to_go": torch.ones(BATCH, HORIZON, device=DEVICE),
        "next": {"observation": walk[:, 1:], "reward": reward},
    }
    return TensorDict(steps, [BATCH, HORIZON])


def make_objectives(process: str = "flow", bf16: bool = False) -> dict[str, Objective]:
    """The four losses of DL-RAD at the recipe's sizes; they share no parameters."""
    torch.manual_seed(0)
    states, difference = Normalizer.identity(STATE), Normalizer.identity(STATE)
    inverse = InverseDynamics(states, difference, ACTION)
    guide = ReturnModel(states, tokens=(HORIZON - 1) // JUMPS[0] + 1)
    planner = DiffuserLitePlanner(
        states, inverse, HORIZON, JUMPS, process=process, return_model=guide
    ).to(DEVICE)
    estimator = StepEstimator(states, HORIZON).to(DEVICE)
    cloning = BCLoss(inverse_dynamics_actor(inverse), loss_function="l2")
    parts = [
        (DenoisingLoss(planner, delay=True), lambda w: w.select("observation"), 0.99),
        (StepEstimationLoss(estimator), lambda w: draw_step_pairs(w["observation"]), None),
        (ReturnGuidanceLoss(guide, jump=JUMPS[0], gamma=0.997), lambda w: w, None),
        (cloning, lambda w: w[:, :8].reshape(-1), None),
    ]
    return {
        name: Objective(
            loss, prepare, lr=5e-4, steps=10_000, ema=ema, bf16=bf16 and name == "denoising"
        )
        for name, (loss, prepare, ema) in zip(LOSSES, parts, strict=True)
    }


def finished(result):
    """A GPU works on while Python goes on."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
    return result


def run(benchmark, call, rounds: int = 10):
    return benchmark.pedantic(lambda: finished(call()), rounds=rounds, warmup_rounds=2)


def measure_loss(benchmark, objective: Objective, windows, backward):
    loss, batch = objective.loss, objective.prepare(windows)

    def forward():
        out = loss(batch)
        return sum(out[key] for key in out.keys() if key.startswith("loss_"))

    def forward_and_backward():
        total = forward()
        total.backward()
        loss.zero_grad()
        return total

    total = run(benchmark, forward_and_backward if backward else forward)
    assert total.isfinite()


backward = pytest.mark.parametrize("backward", [None, "backward"], ids=["forward", "backward"])


@backward
@pytest.mark.parametrize("name", LOSSES)
def test_rad_loss_speed(benchmark, windows, name, backward):
    measure_loss(benchmark, make_objectives()[name], windows, backward)


@backward
def test_rad_diffusion_loss_speed(benchmark, windows, backward):
    """The other generative process."""
    measure_loss(benchmark, make_objectives("diffusion")["denoising"], windows, backward)


@pytest.mark.parametrize("name", LOSSES)
def test_rad_update_speed(benchmark, windows, name):
    """One objective: loss, gradient, clipping, AdamW, average of the weights."""
    objective = make_objectives()[name]
    run(benchmark, lambda: objective.update(windows))


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_rad_training_step_speed(benchmark, windows, precision):
    """All four objectives on the same windows, as a training of DL-RAD does."""
    if precision == "bf16" and not uses_bf16("auto", DEVICE):
        pytest.skip("products of bfloat16 matrices are not faster on this device")
    objectives = make_objectives(bf16=precision == "bf16")

    def step():
        return {name: objective.update(windows) for name, objective in objectives.items()}

    run(benchmark, step)


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
