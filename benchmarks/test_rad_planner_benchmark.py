"""One plan, and one action of the whole policy TS -> SE -> PL, at PointMaze's sizes."""

from __future__ import annotations

import argparse
from itertools import cycle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage
from torchrl.modules import DiffusionActor

from torchrl_rad import ExpertDatabase, RetrievalSampler
from torchrl_rad.evaluation import measure_latency
from torchrl_rad.policy import build_policy, fit_scales

THREADS = 1
DEVICE = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
EPISODES, LENGTH = 200, 300  # 60,000 rows
DRIVEN = 32  # consecutive states asked for


@pytest.fixture(scope="module", autouse=True)
def fixed_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def stated(benchmark):
    benchmark.extra_info.update(threads=THREADS, device=str(DEVICE))


@pytest.fixture(scope="module")
def database():
    """Random walks in a plane: states [N, 4] of position and velocity, actions [N, 2]."""
    generator = torch.Generator().manual_seed(0)
    shape = (EPISODES, LENGTH, 2)
    velocity = 0.05 * torch.randn(shape, generator=generator)
    start = 6 * torch.rand(EPISODES, 1, 2, generator=generator)
    state = torch.cat([start + velocity.cumsum(1), velocity], -1).flatten(0, 1).to(DEVICE)
    done = torch.zeros(len(state), 1, dtype=torch.bool, device=DEVICE)
    done[LENGTH - 1 :: LENGTH] = True
    following = {
        "observation": torch.where(done, state, state.roll(-1, 0)),
        "reward": (state[:, :2].norm(dim=-1, keepdim=True) < 2.0).float(),
        "done": done,
    }
    steps = {"observation": state, "action": state[:, 2:].clamp(-1, 1), "next": following}
    sampler = RetrievalSampler("euclidean", dims=[0, 1], k=500, threshold=0.8)
    database = ExpertDatabase(LazyTensorStorage(len(state), device=DEVICE), 0.97, sampler=sampler)
    database.extend(TensorDict(steps, [len(state)]))
    return database


def make_policy(database: ExpertDatabase, rule: str = "followed", **planner):
    """The policy of the recipe, with fresh weights: they do not change what a plan costs."""
    torch.manual_seed(0)
    description = {
        "state_dim": 4,
        "action_dim": 2,
        "planner": planner,
        "target": {"rule": rule},
        "estimator": {"estimate": "recorded" if rule == "followed" else "mode"},
    }
    policy = build_policy(description, database)
    fit_scales(policy, database[:])
    return policy.to(DEVICE).eval()


def driven(database: ExpertDatabase, batch: int) -> torch.Tensor:
    """Consecutive states [batch, DRIVEN, S], each row along an episode of its own."""
    states = database[:]["observation"].unflatten(0, (EPISODES, LENGTH))
    return states[:batch, 100 : 100 + DRIVEN] + 0.01


def run(benchmark, module, tensordict_of, batch: int):
    @torch.no_grad()
    def act():
        tensordict = module(tensordict_of())
        if DEVICE.type == "cuda":  # a GPU works on while Python goes on
            torch.cuda.synchronize(DEVICE)
        return tensordict

    rounds = 20 if batch == 1 else 5
    return benchmark.pedantic(act, rounds=rounds, warmup_rounds=rounds // 5)


batches = pytest.mark.parametrize("batch", [1, 50], ids="b{}".format)


@batches
@pytest.mark.parametrize("candidates", [1, 16], ids="c{}".format)
@pytest.mark.parametrize("process", ["flow", "diffusion"])
def test_rad_plan_speed(benchmark, database, process, candidates, batch):
    """PL alone: 129 steps on three levels, three calls of the network each."""
    select, estimate, planner = make_policy(database, process=process, candidates=candidates)
    state = driven(database, batch)[:, 0]
    told = estimate(select(TensorDict({"observation": state}, [batch])))
    assert told["found"].all()
    benchmark.extra_info["parameters"] = sum(p.numel() for p in planner.parameters())
    planned = run(benchmark, planner, told.copy, batch)
    assert planned["plan"].isfinite().all()


@batches
@pytest.mark.parametrize("rule", ["highest", "followed"])
def test_rad_policy_speed(benchmark, database, rule, batch):
    """TS, SE and PL, four candidates; the median and 95 % times of each go into extra_info."""
    policy = make_policy(database, rule, candidates=4)
    states = driven(database, batch)
    observations = cycle(states.unbind(1))
    acted = run(
        benchmark, policy, lambda: TensorDict({"observation": next(observations)}, [batch]), batch
    )
    assert acted["action"].isfinite().all()
    times = measure_latency(policy, states, batch, calls=10)
    retrieval = sum(times[name]["p50"] for name in ("RetrievalTargetModule", "StepEstimator"))
    share = retrieval / times["total"]["p50"]
    benchmark.extra_info.update(milliseconds=times, share_of_ts_and_se=share)


@batches
def test_rad_backbone_speed(benchmark, database, batch):
    """The same planner without a target."""
    torch.manual_seed(0)
    planner = {"candidates": 4}
    policy = build_policy({"state_dim": 4, "action_dim": 2, "planner": planner}).to(DEVICE)
    observations = cycle(driven(database, batch).unbind(1))
    run(benchmark, policy, lambda: TensorDict({"observation": next(observations)}, [batch]), batch)


@batches
def test_rad_anchor_diffusion_actor_speed(benchmark, database, batch):
    """TorchRL's own diffusion policy at as many network calls as a plan has, for comparison."""
    torch.manual_seed(0)
    actor = DiffusionActor(action_dim=2, obs_dim=4, num_steps=9).to(DEVICE)
    observations = cycle(driven(database, batch).unbind(1))
    run(benchmark, actor, lambda: TensorDict({"observation": next(observations)}, [batch]), batch)


if __name__ == "__main__":
    args, unknown = argparse.ArgumentParser().parse_known_args()
    pytest.main([__file__, "--capture", "no", "--exitfirst"] + unknown)
