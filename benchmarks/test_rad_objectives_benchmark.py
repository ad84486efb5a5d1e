"""Each loss forward, and forward and backward; one step of the optimisers, at two sizes."""

from __future__ import annotations

import argparse
import gc
from importlib.metadata import version
from statistics import median
from time import perf_counter
from typing import NamedTuple

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
from torchrl_rad.precision import uses_bf16
from torchrl_rad.training import Objective

THREADS = 1
VERSIONS = {name: version(name) for name in ("torch", "torchrl", "tensordict", "torchrl_rad")}
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
HORIZON, JUMPS = 129, (32, 8, 1)
LOSSES = ["denoising", "step_estimation", "return_guidance", "behaviour_cloning"]


class Size(NamedTuple):
    batch: int  # windows
    state: int
    action: int
    width: int
    heads: int


SIZES = {"pointmaze": Size(128, 4, 2, 256, 8), "antmaze": Size(256, 29, 8, 320, 10)}


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), versions=VERSIONS)
    yield
    gc.collect()  # losses and optimisers refer to each other


def make_windows(size: str) -> TensorDict:
    """Windows [B, HORIZON] of random walks."""
    batch, width, actions = SIZES[size][:3]
    generator = torch.Generator().manual_seed(0)
    walk = 0.05 * torch.randn(batch, HORIZON + 1, width, generator=generator)
    walk = walk.cumsum(1).to(DEVICE)
    steps = {
        "observation": walk[:, :-1],
        "action": torch.zeros(batch, HORIZON, actions, device=DEVICE),
        "return_to_go": torch.ones(batch, HORIZON, device=DEVICE),
        "next": {
            "observation": walk[:, 1:],
            "reward": torch.zeros(batch, HORIZON, 1, device=DEVICE),
        },
    }
    return TensorDict(steps, [batch, HORIZON])


def make_objectives(
    size: str, process: str = "flow", bf16: tuple[str, ...] = ()
) -> dict[str, Objective]:
    """The four losses of DL-RAD, those named in bfloat16; they share no parameters."""
    torch.manual_seed(0)
    _, width, actions, inner, heads = SIZES[size]
    states, difference = Normalizer.identity(width), Normalizer.identity(width)
    inverse = InverseDynamics(states, difference, actions)
    guide = ReturnModel(states, tokens=(HORIZON - 1) // JUMPS[0] + 1)
    planner = DiffuserLitePlanner(
        states, inverse, HORIZON, JUMPS, inner, heads, process=process, return_model=guide
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
        name: Objective(loss, prepare, lr=5e-4, steps=10_000, ema=ema, bf16=name in bf16)
        for name, (loss, prepare, ema) in zip(LOSSES, parts, strict=True)
    }


def finished(result):
    """A GPU works on while Python goes on."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
    return result


def run(benchmark, call, plain=None, rounds: int = 10):
    """Ten rounds; before each a plain call, if there is one, that counts for itself.

    The machine is then as busy for the one as for the other.
    """
    times = []

    def between():
        begin = perf_counter()
        finished(plain())
        times.append(1e3 * (perf_counter() - begin))

    setup = None if plain is None else between
    result = benchmark.pedantic(
        lambda: finished(call()), setup=setup, rounds=rounds, warmup_rounds=2
    )
    if times and benchmark.enabled:
        plain_ms = median(times[2:])
        ratio = plain_ms / (1e3 * benchmark.stats["median"])
        benchmark.extra_info.update(plain_ms=plain_ms, ratio=ratio)
    return result


def measure_loss(benchmark, objective: Objective, size: str, backward, bf16: bool = False):
    windows = make_windows(size)
    loss, batch = objective.loss, objective.prepare(windows)

    def forward():
        with torch.autocast(DEVICE.type, torch.bfloat16, bf16):
            out = loss(batch)
        return sum(out[key] for key in out.keys() if key.startswith("loss_"))

    def forward_and_backward():
        total = forward()
        total.backward()
        loss.zero_grad()
        return total

    benchmark.extra_info.update(windows=len(windows), calls=backward or "forward")
    total = run(benchmark, forward_and_backward if backward else forward)
    assert total.isfinite()


def is_bf16(precision: str) -> bool:
    if precision == "bf16" and not uses_bf16("auto", DEVICE):
        pytest.skip("products of bfloat16 matrices are not faster on this device")
    return precision == "bf16"


backward = pytest.mark.parametrize("backward", [None, "backward"], ids=["forward", "backward"])
precisions = pytest.mark.parametrize("precision", ["fp32", "bf16"])
sizes = pytest.mark.parametrize("size", SIZES)


@backward
@pytest.mark.parametrize("name", LOSSES)
def test_rad_loss_speed(benchmark, name, backward):
    measure_loss(benchmark, make_objectives("pointmaze")[name], "pointmaze", backward)


@backward
def test_rad_diffusion_loss_speed(benchmark, backward):
    """The other generative process."""
    objective = make_objectives("pointmaze", "diffusion")["denoising"]
    measure_loss(benchmark, objective, "pointmaze", backward)


@backward
@precisions
def test_rad_denoising_loss_speed(benchmark, precision, backward):
    """The largest loss at the largest size, over all three levels, without the optimiser."""
    bf16 = is_bf16(precision)
    objective = make_objectives("antmaze")["denoising"]
    measure_loss(benchmark, objective, "antmaze", backward, bf16)


def measure_update(benchmark, size: str, names: list[str], bf16: tuple[str, ...]):
    """One step of each objective named; where some are in bfloat16, beside all in float32."""
    windows = make_windows(size)

    def step_of(objectives):
        return lambda: [objectives[name].update(windows) for name in names]

    step = step_of(make_objectives(size, bf16=bf16))
    plain = step_of(make_objectives(size)) if bf16 else None
    objective = names[0] if len(names) == 1 else "all"
    benchmark.extra_info.update(windows=len(windows), objective=objective)
    run(benchmark, step, plain)


@sizes
@precisions
@pytest.mark.parametrize("name", LOSSES)
def test_rad_update_speed(benchmark, size, name, precision):
    """One objective: loss, gradient, clipping, AdamW, average of the weights."""
    measure_update(benchmark, size, [name], (name,) if is_bf16(precision) else ())


@sizes
@precisions
def test_rad_training_step_speed(benchmark, size, precision):
    """All four objectives on the same windows, as a training of DL-RAD does.

    Only the denoising is done in bfloat16, the others are small.
    """
    measure_update(benchmark, size, LOSSES, ("denoising",) if is_bf16(precision) else ())


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
