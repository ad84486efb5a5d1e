"""One plan, against a plain one, and one action of the whole policy TS -> SE -> PL."""

from __future__ import annotations

import argparse
from importlib.metadata import version
from itertools import cycle, pairwise, product
from time import perf_counter
from typing import NamedTuple

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage
from torchrl.modules import DiffusionActor

from torchrl_rad import ExpertDatabase, RetrievalSampler
from torchrl_rad.policy import build_policy, fit_scales
from torchrl_rad.precision import planning_dtype

THREADS = 1
VERSIONS = {name: version(name) for name in ("torch", "torchrl", "tensordict", "torchrl_rad")}
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
EPISODES, LENGTH = 200, 300  # 60,000 rows
DRIVEN = 32  # consecutive states asked for
SECONDS = 3.0  # for the calls of one case; 5 at least, 50 at most


class Size(NamedTuple):
    state: int
    action: int
    width: int
    heads: int
    steps: int  # calls of the network a level


SIZES = {
    "pointmaze": Size(4, 2, 256, 8, 3),
    "hopper": Size(11, 3, 256, 8, 3),
    "antmaze": Size(29, 8, 320, 10, 5),
}


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE), versions=VERSIONS)


def make_database(size: str) -> ExpertDatabase:
    """Random walks: states [N, S], searched by position, the first two entries."""
    generator = torch.Generator().manual_seed(0)
    width, actions = SIZES[size][:2]
    change = 0.05 * torch.randn(EPISODES, LENGTH, width, generator=generator)
    start = 6 * torch.rand(EPISODES, 1, width, generator=generator)
    state = (start + change.cumsum(1)).flatten(0, 1).to(DEVICE)
    done = torch.zeros(len(state), 1, dtype=torch.bool, device=DEVICE)
    done[LENGTH - 1 :: LENGTH] = True
    following = {
        "observation": torch.where(done, state, state.roll(-1, 0)),
        "reward": (state[:, :2].norm(dim=-1, keepdim=True) < 2.0).float(),
        "done": done,
    }
    action = torch.zeros(len(state), actions, device=DEVICE)
    steps = {"observation": state, "action": action, "next": following}
    sampler = RetrievalSampler("euclidean", dims=[0, 1], k=500, threshold=0.8)
    database = ExpertDatabase(LazyTensorStorage(len(state), device=DEVICE), 0.97, sampler=sampler)
    database.extend(TensorDict(steps, [len(state)]))
    return database


@pytest.fixture(scope="module")
def databases():
    return {size: make_database(size) for size in SIZES}


def lowered(precision: str) -> torch.autocast:
    """What a plan is made under."""
    dtype = {"fp32": None, "bf16": torch.bfloat16, "fp16": torch.float16}[precision]
    if dtype not in (None, planning_dtype("auto", DEVICE)):
        pytest.skip(f"plans are not made faster by {dtype} on this device")
    return torch.autocast(DEVICE.type, dtype, dtype is not None)


def make_policy(database, size, rule="highest", target=True, **planner):
    """A policy as the recipe's, with random weights: they do not change what a plan costs."""
    torch.manual_seed(0)
    state, action, width, heads, steps = SIZES[size]
    planner.update(width=width, heads=heads, steps=steps)
    description = {"state_dim": state, "action_dim": action, "planner": planner, "target": None}
    if target:
        description["target"] = {"rule": rule}
        description["estimator"] = {"estimate": "recorded" if rule == "followed" else "mode"}
    policy = build_policy(description, database if target else None)
    fit_scales(policy, database[:])
    with torch.no_grad():  # fresh ones give zero, whatever the network does
        for parameter in policy[-1].networks.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return policy.to(DEVICE).eval()


def driven(database: ExpertDatabase, batch: int) -> torch.Tensor:
    """Consecutive states [batch, DRIVEN, S], each row beside an episode of its own."""
    states = database[:]["observation"].unflatten(0, (EPISODES, LENGTH))
    return states[:batch, 100 : 100 + DRIVEN] + 0.01


# a plan


def plain_plan(planner, told, noise=torch.randn) -> dict[str, torch.Tensor]:
    """The same plan, written down: each level's network, step by step, for every candidate."""
    state, end, plan = told["observation"], None, None
    for number in range(len(planner.levels)):
        known, mask = known_states(planner, told, number, end)
        copies = planner.candidates if number == 0 else 1
        known, mask = known.repeat_interleave(copies, 0), mask.repeat_interleave(copies, 0)
        clean = planner.normalizer(known)
        sample = torch.where(mask, clean, noise(clean.shape, device=clean.device))
        for time, following in pairwise(planner.process.grid(planner.steps)):
            now = torch.full((1,), time, device=clean.device)
            predicted = planner.networks[number](sample, mask, now)
            moved = planner.process.step(sample, predicted, time, following)
            sample = torch.where(mask, clean, moved)
        states = torch.where(mask, known, planner.normalizer.inverse(sample))
        states = states.unflatten(0, (len(state), copies))  # [Q, C, n, S]
        best = planner.return_model(states).argmax(-1) if copies > 1 else state.new_zeros(1).long()
        states = states[torch.arange(len(state), device=state.device), best]
        plan = states if plan is None else torch.cat([states, plan[:, 2:]], 1)
        end = states[:, 1]
    return {"plan": plan, "action": planner.inverse_dynamics(state, plan[:, 1])}


def known_states(planner, told, number, end):
    """What a level is told: states [Q, n, S] and their mask [Q, n, 1]."""
    state, level = told["observation"], planner.levels[number]
    known = state.new_zeros(len(state), level.tokens, state.shape[-1])
    mask = torch.zeros(len(state), level.tokens, 1, dtype=torch.bool, device=state.device)
    known[:, 0], mask[:, 0] = state, True
    if end is not None:
        known[:, -1], mask[:, -1] = end, True
    step, row = told["target_step"].squeeze(-1), told["target_index"].squeeze(-1)
    place, rows = planner.placement(step, number, *level), planner.database[:]
    shift = (place.time - step).maximum(-rows["step"][row]).minimum(rows["remaining"][row])
    here = torch.arange(level.tokens, device=state.device) == place.token[:, None]
    here = (here & place.active[:, None])[..., None]
    target = rows["observation"][row + shift]
    return torch.where(here, target[:, None], known), mask | here


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


def run(benchmark, call, between=lambda: None):
    """As many rounds as fit, with another call before each, which does not count.

    The machine is then as busy for the one as for the other. Gives the result of the last round.
    """
    call()  # what is made at the first call
    fits = int(1e3 * SECONDS / (spent(call) + spent(between)))
    rounds = max(5, min(50, fits)) if benchmark.enabled else 1
    return benchmark.pedantic(lambda: finished(call()), setup=between, rounds=rounds)


def assert_same_plan(planner, told):
    before, planner.noise = planner.noise, "zero"
    plain, plan = plain_plan(planner, told, torch.zeros)["plan"], planner(told.copy())["plan"]
    planner.noise = before
    torch.testing.assert_close(plan, plain, rtol=1e-3, atol=1e-3)


@torch.no_grad()
def measure_plan(benchmark, database, size, process, candidates, batch, precision):
    """PL alone, told of targets, and the plain plan beside it."""
    select, estimate, planner = make_policy(database, size, process=process, candidates=candidates)
    state = driven(database, batch)[:, 0]
    told = estimate(select(TensorDict({"observation": state}, [batch])))
    assert told["found"].all()
    parameters = sum(p.numel() for p in planner.parameters())
    benchmark.extra_info.update(parameters=parameters, size=size)
    if precision == "fp32":
        assert_same_plan(planner, told)
    times = []  # of the plain plan, always in float32

    def plain():
        times.append(spent(lambda: plain_plan(planner, told)))

    def plan():
        with lowered(precision):
            return planner(told.copy())

    planned = run(benchmark, plan, plain)
    assert planned["plan"].isfinite().all()
    if benchmark.enabled:
        plain_ms = float(np.median(times[1:]))
        ratio = plain_ms / (1e3 * benchmark.stats["median"])
        benchmark.extra_info.update(plain_ms=plain_ms, ratio=ratio)


batches = pytest.mark.parametrize("batch", [1, 50], ids="b{}".format)
processes = pytest.mark.parametrize("process", ["flow", "diffusion"])
precisions = pytest.mark.parametrize("precision", ["fp32", "bf16", "fp16"])
# 50 environments with 64 candidates each take long at the larger sizes
ASKED = [
    pytest.param(size, candidates, batch, id=f"{size}-c{candidates}-b{batch}")
    for size, candidates, batch in product(SIZES, [1, 64], [1, 50])
    if size == "pointmaze" or candidates * batch < 3200
]
asked = pytest.mark.parametrize("size, candidates, batch", ASKED)


@asked
@processes
@precisions
def test_rad_plan_speed(benchmark, databases, size, candidates, batch, process, precision):
    measure_plan(benchmark, databases[size], size, process, candidates, batch, precision)


SCALING = [(1, 1), (1, 4), (1, 16), (1, 64), (4, 1), (16, 1), (64, 1)]


@pytest.mark.parametrize(
    "candidates, batch", [pytest.param(c, b, id=f"c{c}-b{b}") for c, b in SCALING]
)
@precisions
def test_rad_plan_scaling_speed(benchmark, databases, candidates, batch, precision):
    """The largest size against the number of environments, and of candidates."""
    measure_plan(benchmark, databases["antmaze"], "antmaze", "flow", candidates, batch, precision)


# a whole action


def timed_action(policy, state) -> list[float]:
    """Milliseconds of TS, SE, PL without inverse dynamics, and of that; then of all."""
    told, inverse = TensorDict({"observation": state}, [len(state)]), policy[-1].inverse_dynamics
    select, estimate, plan = (spent(lambda part=part: part(told)) for part in policy.module)
    first = told["plan"][:, 1]
    act = spent(lambda: inverse(state, first))  # by itself: the planner's time holds it too
    return [select, estimate, plan - act, act, select + estimate + plan]


def split_times(policy, states) -> dict[str, dict[str, float]]:
    """Median and 95 % of each part of an action along states [B, T, S], the first two apart."""
    times = np.array([timed_action(policy, state) for state in states.unbind(1)])[2:]
    percentiles = np.percentile(times, [50, 95], axis=0).T.tolist()
    names = ("TS", "SE", "PL", "ID", "total")
    return {
        name: {"p50": p50, "p95": p95} for name, (p50, p95) in zip(names, percentiles, strict=True)
    }


@asked
@pytest.mark.parametrize(
    "rule, process", [("highest", "flow"), ("highest", "diffusion"), ("followed", "flow")]
)
@precisions
@torch.no_grad()
def test_rad_policy_speed(benchmark, databases, size, candidates, batch, rule, process, precision):
    """The times of TS, SE, PL and inverse dynamics go into extra_info."""
    policy = make_policy(databases[size], size, rule, process=process, candidates=candidates)
    states = driven(databases[size], batch)
    endless = cycle(states.unbind(1))

    def act():
        with lowered(precision):
            return policy(TensorDict({"observation": next(endless)}, [batch]))

    acted = run(benchmark, act)
    assert acted["action"].isfinite().all()
    calls = min(DRIVEN, 2 + benchmark.stats["rounds"]) if benchmark.enabled else 3
    with lowered(precision):
        times = split_times(policy, states[:, :calls])
    share = (times["TS"]["p50"] + times["SE"]["p50"]) / times["total"]["p50"]
    benchmark.extra_info.update(size=size, milliseconds=times, share_of_ts_and_se=share)


@batches
@torch.no_grad()
def test_rad_backbone_speed(benchmark, databases, batch):
    """The same planner without a target, with four candidates."""
    database = databases["pointmaze"]
    policy = make_policy(database, "pointmaze", target=False, candidates=4)
    endless = cycle(driven(database, batch).unbind(1))
    run(benchmark, lambda: policy(TensorDict({"observation": next(endless)}, [batch])))


@batches
@torch.no_grad()
def test_rad_anchor_diffusion_actor_speed(benchmark, databases, batch):
    """TorchRL's own diffusion policy at as many network calls as a plan has, for comparison."""
    torch.manual_seed(0)
    actor = DiffusionActor(action_dim=2, obs_dim=4, num_steps=9).to(DEVICE)
    endless = cycle(driven(databases["pointmaze"], batch).unbind(1))
    run(benchmark, lambda: actor(TensorDict({"observation": next(endless)}, [batch])))


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
