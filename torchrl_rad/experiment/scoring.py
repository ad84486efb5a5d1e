"""Episodes of policies, and the figures of each."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential

from torchrl_rad.envs.task import Task
from torchrl_rad.evaluation import episode_results, measure_latency, summarise
from torchrl_rad.experiment.data import window_sampler
from torchrl_rad.experiment.driving import Driver
from torchrl_rad.experiment.policies import BACKBONE, PolicyParts
from torchrl_rad.objectives.step import draw_step_pairs
from torchrl_rad.results import write_results
from torchrl_rad.runs import RunFolder, environment_facts

__all__ = [
    "evaluate_policies",
    "policy_row",
    "step_error",
]

PARTS = {  # what stands in their columns
    "RetrievalTargetModule": "TS",
    "PlainTargetModule": "TS",
    "StepEstimator": "SE",
    "DiffuserLitePlanner": "PL",
    "DiffuserPlanner": "PL",
}


def evaluate_policies(
    run: RunFolder,
    cfg: Mapping[str, Any],
    task: Task,
    policies: Mapping[str, PolicyParts],
    data: TensorDictBase,
) -> tuple[dict[str, dict[str, Any]], dict[str, TensorDictBase]]:
    """Scores every policy and writes ``results.json``; what was evaluated before is not done again.

    Returns:
        Rows for :func:`~torchrl_rad.results.format_table`, and the episodes [n, T] of each policy.
    """
    seed = cfg["evaluation"]["seed"]
    torch.manual_seed(seed)
    windows = window_sampler(data, cfg["network"]["horizon"], 4096)()
    rows: dict[str, dict[str, Any]] = {}
    episodes: dict[str, TensorDictBase] = {}
    seconds: dict[str, float] = {}
    with closing(Driver(run, cfg, task)) as drive:
        for name, parts in policies.items():
            steps = run.load_episodes(name)
            if steps is None:
                begin = time.perf_counter()
                steps = drive(name, parts.policy)
                seconds[name] = time.perf_counter() - begin
                run.save_episodes(name, steps)
            episodes[name] = steps
            rows[name] = policy_row(task, parts.policy, steps)
            rows[name]["rollout_s"] = seconds.get(name)  # of all episodes
            if name != BACKBONE:
                torch.manual_seed(seed)  # the same pairs for each policy, and when resumed
                recorded = parts.policy[1].estimate == "recorded"
                rows[name]["step_error"] = None if recorded else step_error(parts.policy, windows)
    about = {"task": cfg["env"]["name"], "seed": cfg["seed"], "data": cfg["replay_buffer"]}
    facts = {"score_source": task.score_source, **environment_facts()}
    write_results(run.path, {**about, "rows": rows, **facts})
    return rows, episodes


def policy_row(task: Task, policy: TensorDictSequential, steps: TensorDictBase) -> dict[str, Any]:
    """The figures of one policy: means, each episode's return, and latencies on one thread."""
    results = episode_results(steps)
    row: dict[str, Any] = summarise(results, task.normalised_score, task.figures)
    row["episode_returns"] = results["return"].tolist()
    row["episode_scores"] = task.normalised_score(results["return"]).tolist()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    latency = {}
    for count in (1, min(50, len(steps))):
        goals = steps["goal"][:, 0] if "goal" in steps.keys() else None
        latency[str(count)] = measure_latency(policy, steps["observation"], count, goals=goals)
    torch.set_num_threads(threads)
    row["latency_ms"] = latency
    for module, part in PARTS.items():
        if module in latency["1"]:
            row[part] = "{p50:.1f} / {p95:.1f}".format(**latency["1"][module])
    return row


def step_error(policy: TensorDictSequential, windows: TensorDictBase) -> float:
    """Mean absolute error of the step estimator on pairs of recorded states, in steps."""
    estimator = policy[1]
    pairs = draw_step_pairs(windows["observation"], horizon=estimator.horizon)
    with torch.no_grad():
        steps = estimator._steps(estimator.logits(pairs["observation"], pairs["target"]))
    return float((steps - pairs["target_step"]).abs().float().mean())
