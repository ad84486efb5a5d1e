"""Episodes of policies, and the figures of each."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_rad.data.sources import find_dataset, load_dataset
from torchrl_rad.envs.task import Task
from torchrl_rad.evaluation import episode_results, evaluate, measure_latency, summarise
from torchrl_rad.experiment.data import window_sampler
from torchrl_rad.experiment.policies import BACKBONE, PolicyParts
from torchrl_rad.modules.replanning import with_replanning
from torchrl_rad.objectives.step import draw_step_pairs
from torchrl_rad.precision import planning_dtype
from torchrl_rad.results import write_results
from torchrl_rad.runs import RunFolder, environment_facts

__all__ = [
    "collect_episodes",
    "evaluate_policies",
    "load_starts",
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


def collect_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    max_steps: int,
    seed: int,
    name: str = "policy",
    dtype: torch.dtype | None = None,
    progress: bool = True,
) -> TensorDictBase:
    """The first episode of each row of an environment; same seed, same episodes.

    Args:
        env (EnvBase): [n] rows, as of :meth:`~torchrl_rad.envs.Task.make_env`.
        policy (TensorDictModuleBase): what acts.
        max_steps (int): limit of an episode.
        seed (int): of the start states and of the policy's noise.
        name (str, optional): shown beside the progress bar.
        dtype (torch.dtype, optional): of autocast, as of
            :func:`~torchrl_rad.precision.planning_dtype`. Defaults to float32.
        progress (bool, optional): show a bar. Defaults to ``True``.

    Returns:
        See :func:`~torchrl_rad.evaluation.evaluate`.
    """
    device = next(policy.parameters()).device

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        with torch.autocast(device.type, dtype, dtype is not None):
            return policy(tensordict.to(device)).to("cpu")  # where the simulator is

    env.set_seed(seed)
    torch.manual_seed(seed)
    bar = tqdm(total=max_steps, desc=f"evaluating {name}", unit="step", disable=not progress)
    with bar:
        return evaluate(env, act, max_steps, progress=bar.update)


def load_starts(settings: Mapping[str, Any] | None) -> Any:
    """Where episodes begin, for :meth:`~torchrl_rad.envs.Task.make_env`; None: the task's own.

    Args:
        settings (mapping, optional): ``cells``, a list of (row, column); or ``states``, names of a
            data set as of :func:`~torchrl_rad.data.find_dataset`, whose infos hold ``qpos`` and
            ``qvel``.

    Raises:
        FileNotFoundError: the data set is not here.
        ValueError: neither is given.
    """
    if settings is None:
        return None
    if settings.get("cells"):
        return [tuple(cell) for cell in settings["cells"]]
    if not settings.get("states"):
        raise ValueError(f"evaluation.starts is {dict(settings)}; expected cells or states.")
    names = find_dataset(settings["states"])
    return load_dataset(names, infos=("qpos", "qvel"), progress=False)["info"]


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
    settings, progress = cfg["evaluation"], cfg["logger"]["progress"]
    torch.manual_seed(settings["seed"])
    windows = window_sampler(data, cfg["network"]["horizon"], 4096)()
    rows: dict[str, dict[str, Any]] = {}
    episodes: dict[str, TensorDictBase] = {}
    seconds: dict[str, float] = {}
    env = None  # a maze costs some 13 MB a row: one environment serves all policies
    for name, parts in policies.items():
        steps = run.load_episodes(name)
        if steps is None:
            seed = settings["seed"] + cfg["seed"]
            if env is None:
                env = task.make_env(settings["episodes"], starts=load_starts(settings["starts"]))
            dtype = planning_dtype(cfg["optim"]["precision"], cfg["device"])
            policy: TensorDictModuleBase = parts.policy
            if settings.get("replan", 1) > 1:
                policy = with_replanning(parts.policy, settings["replan"])
            begin = time.perf_counter()
            steps = collect_episodes(env, policy, task.max_steps, seed, name, dtype, progress)
            seconds[name] = time.perf_counter() - begin
            run.save_episodes(name, steps)
        episodes[name] = steps
        rows[name] = policy_row(task, parts.policy, steps)
        rows[name]["rollout_s"] = seconds.get(name)  # of all episodes, side by side
        if name != BACKBONE:
            torch.manual_seed(settings["seed"])  # the same pairs for each policy, and when resumed
            recorded = parts.policy[1].estimate == "recorded"
            rows[name]["step_error"] = None if recorded else step_error(parts.policy, windows)
    if env is not None:
        threads = torch.get_num_threads()
        env.close()  # TorchRL then raises the number of threads
        torch.set_num_threads(threads)
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
