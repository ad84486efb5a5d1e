"""One plan of D-RAD beside one by Diffuser's own code, in alternation; times are medians in ms.

    python benchmarks/beside_diffuser.py <clone of github.com/jannerm/diffuser> [--compile]

It needs einops. Diffuser's code runs as it is; with --compile this planner's networks are compiled
beforehand (DiffuserPlanner.compile), which takes minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from types import ModuleType, SimpleNamespace

import torch

CANDIDATES, STEPS, ROUNDS = 64, 20, 6  # the first round does not count


def imported(folder: Path, name: str) -> ModuleType:
    """A module of Diffuser without what its packages import for training and simulators of 2022."""
    for package in ("diffuser", "diffuser.sampling"):
        bare = sys.modules.setdefault(package, ModuleType(package))
        bare.__path__ = [str(folder / package.replace(".", "/"))]
    silent = SimpleNamespace(update=lambda _: None, stamp=lambda: None)
    tools = sys.modules.setdefault("diffuser.utils", ModuleType("diffuser.utils"))
    sys.modules["diffuser"].utils, tools.Silent = tools, lambda: silent
    return import_module(name)


def reference_plan(folder: Path, ours: ModuleType, told) -> Callable[[], object]:
    """A plan by its own guided sampler; its return model is 32 wide, with halvings for 32 steps."""
    networks = imported(folder, "diffuser.models.temporal")
    sampler = imported(folder, "diffuser.sampling.functions")
    guides = imported(folder, "diffuser.sampling.guides")
    diffusion = imported(folder, "diffuser.models.diffusion").GaussianDiffusion(
        networks.TemporalUnet(
            32, ours.STATE + ours.ACTION, ours.STATE, dim=32, dim_mults=(1, 2, 4, 8)
        ),
        horizon=32,
        observation_dim=ours.STATE,
        action_dim=ours.ACTION,
        n_timesteps=STEPS,
        predict_epsilon=False,
    )
    value = networks.ValueFunction(
        32, ours.STATE + ours.ACTION, ours.STATE, dim=32, dim_mults=(1, 2, 4, 8)
    )
    guided = partial(
        sampler.n_step_guided_p_sample,
        guide=guides.ValueGuide(value.to(ours.DEVICE).eval()),
        scale=0.1,
        t_stopgrad=2,
        n_guide_steps=2,
        scale_grad_by_std=True,
    )
    diffusion = diffusion.to(ours.DEVICE).eval()
    pins = {0: told["observation"], int(told["target_step"]): told["target"]}
    pins = {place: state.repeat(CANDIDATES, 1) for place, state in pins.items()}
    return lambda: diffusion.conditional_sample(pins, verbose=False, sample_fn=guided)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clone", type=Path)
    parser.add_argument("--compile", action="store_true")
    args = parser.parse_args()
    ours = import_module("test_rad_diffuser_benchmark")  # of this folder
    torch.set_num_threads(ours.THREADS)
    database = ours.make_database()
    told = ours.make_told(database)
    reference = reference_plan(args.clone, ours, told)
    print("| width of the return model | ms | reference | ratio |\n|---|---|---|---|")
    for width in (16, 32):
        planner = ours.make_planner(
            database,
            sampler="ancestral",
            steps=STEPS,
            candidates=CANDIDATES,
            return_model={"width": width},
        )
        if args.compile:
            planner.compile()
        pairs = [(ours.spent(partial(planner, told)), ours.spent(reference)) for _ in range(ROUNDS)]
        mine, theirs = (median(times[1:]) for times in zip(*pairs, strict=True))
        print(f"| {width} | {mine:.0f} | {theirs:.0f} | {theirs / mine:.2f} |")


if __name__ == "__main__":
    main()
