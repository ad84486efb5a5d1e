"""One plan of D-RAD, against a plain one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from itertools import pairwise
from time import perf_counter

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase
from torchrl_rad.policy import build_policy, fit_scales

THREADS = 1
VERSIONS = {name: version(name) for name in ("torch", "torchrl", "tensordict", "torchrl_rad")}
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
STATE, ACTION = 11, 3  # hopper
LENGTH, AHEAD = 200, 17  # of the one episode; steps to the target
SECONDS = 3.0  # for the calls of one case; 5 at least, 50 at most

Noise = Callable[..., torch.Tensor]  # (shape, device=)


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), versions=VERSIONS)


@pytest.fixture(scope="module")
def database() -> ExpertDatabase:
    return make_database()


def make_database() -> ExpertDatabase:
    """One random walk; a plan costs the same whatever else was recorded."""
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(LENGTH + 1, STATE, generator=generator).cumsum(0).to(DEVICE)
    done = torch.zeros(LENGTH, 1, dtype=torch.bool, device=DEVICE)
    done[-1] = True
    steps = {
        "observation": state[:-1],
        "action": torch.zeros(LENGTH, ACTION, device=DEVICE),
        "next": {"observation": state[1:], "reward": state[1:, :1], "done": done},
    }
    database = ExpertDatabase(LazyTensorStorage(LENGTH, device=DEVICE))
    database.extend(TensorDict(steps, [LENGTH]))
    return database


def make_planner(database, **options):
    """PL of the recipe's policy, with random weights: they do not change what a plan costs."""
    torch.manual_seed(0)
    planner = {"kind": "diffuser", "horizon": 32, "width": 32, "multiples": (1, 2, 4, 8)}
    planner.update({"return_model": {"width": 16}, "guide_steps": 2, "guide_stop": 2, **options})
    description = {"state_dim": STATE, "action_dim": ACTION, "planner": planner}
    policy = build_policy({**description, "target": {"rule": "followed"}}, database)
    fit_scales(policy, database[:])
    return policy[-1].to(DEVICE).eval()


def make_told(database: ExpertDatabase) -> TensorDict:
    """One state and its target, as TS and SE write it."""
    rows = database[:]["observation"]
    told = {
        "observation": rows[:1] + 0.01,
        "target": rows[AHEAD : AHEAD + 1],
        "found": torch.ones(1, 1, dtype=torch.bool, device=DEVICE),
        "target_step": torch.full((1, 1), AHEAD, device=DEVICE),
    }
    return TensorDict(told, [1])


# the plain plan


def plain_plan(planner, told, noise: Noise = torch.randn) -> dict[str, torch.Tensor]:
    """The same plan, written down: the networks as they are, step by step, for every candidate."""
    states, mask = known_states(planner, told)
    actions = states.new_zeros(*states.shape[:2], ACTION)
    clean = torch.cat([planner.normalizer(states), actions], -1)
    kept = torch.cat([mask.expand_as(states), actions.bool()], -1)
    sample = torch.where(kept, clean, noise(clean.shape, device=DEVICE))
    for step, (time, following) in enumerate(pairwise(planner.process.grid(planner.steps))):
        now = torch.full((1,), time, device=DEVICE)
        guided = step < planner.steps - planner.guide_stop
        scale = planner.guide_scale * planner.process.variance(time, following)
        for _ in range(planner.guide_steps if guided else 0):
            moved = sample + scale * slope(planner.return_model, sample, mask, now)
            sample = torch.where(kept, clean, moved)
        moved = planner.process.step(
            sample, planner.networks[0](sample, mask, now), time, following
        )
        deviation = planner.process.deviation(time, following)
        if deviation:
            moved = moved + deviation * noise(clean.shape, device=DEVICE)
        sample = torch.where(kept, clean, moved)
    return best_plan(planner, sample, states, mask)


def known_states(planner, told) -> tuple[torch.Tensor, torch.Tensor]:
    """Current state and target in raw units [C, H, S], and where they are [C, H, 1]."""
    states = torch.zeros(planner.candidates, planner.horizon, STATE, device=DEVICE)
    mask = torch.zeros_like(states[..., :1], dtype=torch.bool)
    for place, key in ((0, "observation"), (int(told["target_step"]), "target")):
        states[:, place], mask[:, place] = told[key], True
    return states, mask


def slope(model, sample, mask, time) -> torch.Tensor:
    """Of the predicted return with respect to the sample."""
    with torch.enable_grad():
        sample = sample.clone().requires_grad_()
        return torch.autograd.grad(model.standardised(sample, mask, time).sum(), sample)[0]


def best_plan(planner, sample, states, mask) -> dict[str, torch.Tensor]:
    """The candidate with the largest predicted return, in raw units."""
    best = slice(0, 1)
    if len(sample) > 1:
        now = torch.zeros(1, device=DEVICE)
        best = planner.return_model.standardised(sample, mask, now).argmax(0, keepdim=True)
    plans = torch.where(mask, states, planner.normalizer.inverse(sample[..., :STATE]))
    action = sample[best, 0, STATE:].clamp(-planner.bound, planner.bound)
    return {"plan": plans[best], "action": action}


# both in alternation


def finished(result):
    """A GPU works on while Python goes on."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize(DEVICE)
    return result


def spent(call) -> float:
    """Milliseconds."""
    begin = perf_counter()
    finished(call())
    return 1e3 * (perf_counter() - begin)


def run(benchmark, call, between):
    """As many rounds as fit, with another call before each, which does not count.

    The machine is then as busy for the one as for the other. Gives the result of the last round.
    """
    call()  # what is made at the first call
    fits = int(1e3 * SECONDS / (spent(call) + spent(between)))
    rounds = max(5, min(50, fits)) if benchmark.enabled else 1
    return benchmark.pedantic(lambda: finished(call()), setup=between, rounds=rounds)


def assert_same_plan(planner, told):
    """Without noise; and with the same noise, by which candidates differ."""
    drawn = partial(torch.randn, generator=torch.Generator(DEVICE).manual_seed(0))
    before = planner.noise
    for planner.noise, noise in (("zero", torch.zeros), ("seeded", drawn)):
        plain, planned = plain_plan(planner, told, noise), planner(told.copy())
        for key, value in plain.items():
            torch.testing.assert_close(planned[key], value, rtol=1e-3, atol=1e-3)
    planner.noise = before


samplers = pytest.mark.parametrize(
    "sampler, steps",
    [pytest.param(s, n, id=f"{s}-s{n}") for s, n in [("ancestral", 20), ("ddim", 20), ("ddim", 5)]],
)


@samplers
@pytest.mark.parametrize("candidates", [1, 64], ids="c{}".format)
@torch.no_grad()
def test_rad_diffuser_plan_speed(benchmark, database, sampler, steps, candidates):
    """PL alone, told of a target, and the plain plan beside it."""
    planner = make_planner(database, sampler=sampler, steps=steps, candidates=candidates)
    told = make_told(database)
    parameters = sum(p.numel() for p in planner.parameters())
    benchmark.extra_info.update(parameters=parameters, size="hopper")
    assert_same_plan(planner, told)
    times = []  # of the plain plan

    def plain():
        times.append(spent(lambda: plain_plan(planner, told)))

    planned = run(benchmark, lambda: planner(told.copy()), plain)
    assert planned["plan"].isfinite().all()
    if benchmark.enabled:
        plain_ms = float(np.median(times[1:]))
        ratio = plain_ms / (1e3 * benchmark.stats["median"])
        benchmark.extra_info.update(plain_ms=plain_ms, ratio=ratio)


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
