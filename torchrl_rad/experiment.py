"""The steps that recipes share: data, databases, policies, evaluation and its table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage
from torchrl.envs import EnvBase
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from torchrl_rad.checkpoint import read_json
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.episodes import episode_lengths, return_to_go
from torchrl_rad.data.experts import expert_from_config, select_episodes
from torchrl_rad.data.maze2d import maze_dataset
from torchrl_rad.data.regions import without_region
from torchrl_rad.data.report import DataReport, report
from torchrl_rad.data.sources import find_dataset, load_dataset
from torchrl_rad.data.windows import window_buffer
from torchrl_rad.envs.maze import MazeTask
from torchrl_rad.envs.task import Task
from torchrl_rad.envs.tasks import make_task
from torchrl_rad.evaluation import episode_results, evaluate, measure_latency, summarise
from torchrl_rad.objectives.step import draw_step_pairs
from torchrl_rad.policy import build_policy, fit_scales
from torchrl_rad.precision import planning_dtype
from torchrl_rad.results import write_results
from torchrl_rad.retrieval import RetrievalSampler
from torchrl_rad.runs import RunFolder, environment_facts

__all__ = [
    "BACKBONE",
    "PolicyParts",
    "check_data",
    "collect_episodes",
    "evaluate_policies",
    "make_data",
    "make_database",
    "make_logger",
    "load_starts",
    "make_policies",
    "policy_row",
    "resolve_dataset",
    "restrict",
    "saved_maze",
    "saved_task",
    "share_weights",
    "step_error",
    "task_dataset",
    "window_sampler",
]

BACKBONE = "backbone"
PARTS = {"TS": "RetrievalTargetModule", "SE": "StepEstimator", "PL": "DiffuserLitePlanner"}


@dataclass
class PolicyParts:
    """A policy with what it takes to save it."""

    policy: TensorDictSequential
    description: dict[str, Any]
    database: ExpertDatabase | None = None


def make_data(cfg: Mapping[str, Any]) -> tuple[Task, TensorDictBase]:
    """The task and its recorded steps [T], with ``return_to_go`` at the discount of L_g."""
    task = make_task(cfg["env"])
    data = task_dataset(task, cfg["replay_buffer"], cfg["logger"]["progress"])
    data = restrict(task, data, cfg["replay_buffer"]).copy()
    value = return_to_go(data["next", "reward"], episode_lengths(data), cfg["loss"]["gamma"])
    data["return_to_go"] = value
    return task, data


def task_dataset(task: Task, source: Mapping[str, Any], progress: bool = True) -> TensorDictBase:
    """Recorded steps [T] with the rewards of a task.

    Args:
        task (Task): whose rewards they get.
        source (mapping): ``dataset``, ``download`` and, of a collection, ``steps`` and ``seed``.
        progress (bool, optional): show a progress bar. Defaults to ``True``.
    """
    if isinstance(task, MazeTask):
        options = {name: source[name] for name in ("steps", "seed", "download")}
        (name,) = source["dataset"] if isinstance(source["dataset"], list) else [source["dataset"]]
        return maze_dataset(task, name, **options, progress=progress)
    keys = task.adapter.keys
    return task.label(load_dataset(source["dataset"], keys, (), source["download"], progress))


def resolve_dataset(cfg: dict[str, Any]) -> None:
    """Puts in place of a config's data sets those that are here, so that the run says which.

    Raises:
        FileNotFoundError: none is here, and none can be fetched.
    """
    if cfg["replay_buffer"]["dataset"] != "collected":
        cfg["replay_buffer"]["dataset"] = find_dataset(cfg["replay_buffer"]["dataset"])


def restrict(task: Task, data: TensorDictBase, source: Mapping[str, Any]) -> TensorDictBase:
    """Recorded steps without a region of the maze, or demonstrations alone, if a config says so.

    Args:
        task (Task): of a maze where ``without`` is set.
        data (TensorDictBase): flat steps [T].
        source (mapping): ``without`` (cells; None for none), ``coverage`` (share of the episodes
            that enter them and stay) and ``keep`` (config of an expert rule; None for all).

    Raises:
        ValueError: nothing is left, or the task has no cells.
    """
    if source["without"] is not None:
        centres, half_width = task.cells(source["without"])
        data = without_region(data, centres, half_width, source["coverage"])
    if source["keep"] is not None:
        lengths = episode_lengths(data)
        rule = expert_from_config(source["keep"])
        keep = select_episodes(rule, data.split(lengths.tolist()))
        if not keep.any():
            raise ValueError(f"no episode is left by replay_buffer.keep={rule}.")
        data = data[torch.repeat_interleave(keep, lengths)]
    return data


def check_data(task: Task, data: TensorDictBase) -> DataReport:
    """A report on the data against the task's starts.

    Raises:
        ValueError: it has faults; the message names them.
    """
    found = report(data, starts=task.starts())
    if not found.ok:
        raise ValueError(f"the data cannot be trained on:\n{found}")
    return found


def make_database(data: TensorDictBase, options: Mapping[str, Any]) -> ExpertDatabase:
    """The demonstrations among recorded steps.

    Args:
        data (TensorDictBase): flat steps [T].
        options (mapping): ``expert`` (config of a rule, or None), ``gamma`` and ``sampler``
            (arguments of :class:`~torchrl_rad.retrieval.RetrievalSampler`).

    Raises:
        ValueError: the rule keeps no episode.
    """
    rule = options.get("expert")
    database = ExpertDatabase(
        LazyTensorStorage(len(data)),
        gamma=options["gamma"],
        expert=None if rule is None else expert_from_config(rule),
        sampler=RetrievalSampler(**options["sampler"]),
    )
    database.extend(data.exclude("return_to_go"))
    return database


def make_policies(
    network: Mapping[str, Any], retrieval: Mapping[str, Any], data: TensorDictBase
) -> dict[str, PolicyParts]:
    """The backbone and one policy for each way to retrieve, with fresh weights.

    Args:
        network (mapping): arguments of the planner, and ``step_horizon`` (of target and step
            estimator) and ``step_width`` (of the latter's network).
        retrieval (mapping): name -> ``expert``, ``gamma``, ``sampler``, ``target``, ``estimator``.
        data (TensorDictBase): flat steps [T].

    Raises:
        ValueError: a policy asks for a horizon of its own; they share one step estimator.
    """
    planner = dict(network)
    reach, width = planner.pop("step_horizon"), planner.pop("step_width")
    sizes = {
        "state_dim": data["observation"].shape[-1],
        "action_dim": data["action"].shape[-1],
        "action_bound": float(data["action"].abs().max()),  # beyond, nobody knows what happens
    }
    shared = {**sizes, "planner": planner}
    policies = {BACKBONE: PolicyParts(build_policy(shared), shared)}
    for name, options in retrieval.items():
        target = {"horizon": reach, **options["target"]}
        if target["horizon"] != reach:
            raise ValueError(
                f"the horizon of 'target' is {target['horizon']} for {name!r}, not the "
                f"step_horizon {reach}; set network.step_horizon: all policies share one step "
                "estimator."
            )
        database = make_database(data, options)
        estimator = {"width": width, **options["estimator"]}
        description = {**shared, "target": target, "estimator": estimator}
        policy = build_policy(description, database)
        policies[name] = PolicyParts(policy, description, database)
    for parts in policies.values():
        fit_scales(parts.policy, data)
    return policies


def share_weights(policies: Mapping[str, PolicyParts], trained: str) -> None:
    """Gives the weights of one policy to all: all of them, or the backbone its heads alone."""
    source = policies[trained].policy
    for name, parts in policies.items():
        if name == BACKBONE:
            own, given = parts.policy[-1], source[-1]
            own.inverse_dynamics.load_state_dict(given.inverse_dynamics.state_dict())
            if own.return_model is not None:
                own.return_model.load_state_dict(given.return_model.state_dict())
        elif name != trained:
            parts.policy.load_state_dict(source.state_dict())


def window_sampler(data: TensorDictBase, horizon: int, batch_size: int):
    """A function that draws windows [batch_size, horizon] of recorded steps."""
    kept = data.select(
        "observation", "action", "episode", "return_to_go", "value",
        ("next", "observation"), ("next", "reward"), strict=False,
    )  # fmt: skip
    buffer = window_buffer(kept, horizon, batch_size)
    return lambda: buffer.sample().reshape(-1, horizon)


def step_error(policy: TensorDictSequential, windows: TensorDictBase) -> float:
    """Mean absolute error of the step estimator on pairs of recorded states, in steps."""
    estimator = policy[1]
    pairs = draw_step_pairs(windows["observation"], horizon=estimator.horizon)
    with torch.no_grad():
        steps = estimator._steps(estimator.logits(pairs["observation"], pairs["target"]))
    return float((steps - pairs["target_step"]).abs().float().mean())


def saved_task(folder: str | Path) -> Task:
    """The task of a saved policy.

    Raises:
        FileNotFoundError: the folder holds no policy.
    """
    return make_task(read_json(Path(folder) / "policy.json")["env"])


def saved_maze(folder: str | Path) -> MazeTask:
    """The task of a saved policy, which must be a PointMaze.

    Raises:
        FileNotFoundError: the folder holds no policy.
        ValueError: it is of another task.
    """
    task = saved_task(folder)
    if not isinstance(task, MazeTask):
        raise ValueError(
            f"the policy in {folder} is of {task.name}; this needs one of a PointMaze."
        )
    return task


def collect_episodes(
    env: EnvBase,
    policy: TensorDictSequential,
    max_steps: int,
    seed: int,
    name: str = "policy",
    dtype: torch.dtype | None = None,
    progress: bool = True,
) -> TensorDictBase:
    """The first episode of each row of an environment; same seed, same episodes.

    Args:
        env (EnvBase): [n] rows, as of :meth:`~torchrl_rad.envs.Task.make_env`.
        policy (TensorDictSequential): what acts.
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


def make_logger(run: RunFolder, cfg: Mapping[str, Any]) -> Callable[[int, dict[str, float]], None]:
    """Writes ``metrics.csv``, and to TensorBoard or W&B if the config names one of them.

    Raises:
        ValueError: another backend.
    """
    settings = cfg["logger"]
    backend = settings["backend"]
    if backend not in ("csv", "tensorboard", "wandb"):
        raise ValueError(
            f"logger.backend is {backend!r}; expected 'csv', 'tensorboard' or 'wandb'."
        )
    other = None
    if backend != "csv":
        options = {"mode": settings["mode"], "project": settings["project_name"], "config": cfg}
        other = get_logger(
            backend,
            logger_name=str(run.path / backend),
            experiment_name=run.path.name,
            **({"wandb_kwargs": options} if backend == "wandb" else {}),
        )

    def log(step: int, values: dict[str, float]) -> None:
        run.metrics.write(step, values)
        if other is not None:
            other.log_metrics(values, step=step)

    return log


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
    env = None  # a maze costs some 13 MB a row: one environment serves all policies
    for name, parts in policies.items():
        steps = run.load_episodes(name)
        if steps is None:
            seed = settings["seed"] + cfg["seed"]
            if env is None:
                env = task.make_env(settings["episodes"], starts=load_starts(settings["starts"]))
            dtype = planning_dtype(cfg["optim"]["precision"], cfg["device"])
            steps = collect_episodes(
                env, parts.policy, task.max_steps, seed, name, dtype, progress=progress
            )
            run.save_episodes(name, steps)
        episodes[name] = steps
        rows[name] = policy_row(task, parts.policy, steps)
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
    for part, module in PARTS.items():
        if module in latency["1"]:
            row[part] = "{p50:.1f} / {p95:.1f}".format(**latency["1"][module])
    return row
