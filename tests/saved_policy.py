"""A small policy with fresh weights, saved with the demonstrations of a small collection."""

from __future__ import annotations

import torch
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, maze_task, reaches_goal
from torchrl_rad.data.pointmaze import collect_pointmaze
from torchrl_rad.policy import build_policy, fit_scales, save_policy

ENV = {"name": "pointmaze-umaze", "family": "pointmaze", "maze": "umaze"}
ABOUT = {
    "env": ENV,
    "state_dim": 4,
    "action_dim": 2,
    "planner": {"horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1, "steps": 1},
    "target": {"rule": "followed", "ahead": 4},
    "estimator": {"width": 8, "estimate": "recorded"},
}


def save_small_policy(folder):
    data = collect_pointmaze(maze_task("umaze"), 3000, progress=False)
    sampler = RetrievalSampler("euclidean", dims=[0, 1], k=50, threshold=0.8)
    database = ExpertDatabase(LazyTensorStorage(3000), expert=reaches_goal(), sampler=sampler)
    database.extend(data)
    torch.manual_seed(0)
    policy = build_policy(ABOUT, database)
    fit_scales(policy, data.set("return_to_go", data["next", "reward"].squeeze(-1)))
    save_policy(folder, policy, ABOUT, database)
