"""The whole of a run, whatever planner it is of: from the command line to the table."""

from __future__ import annotations

import datetime
import itertools
import logging
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl._utils import logger as torchrl_logger
from torchrl.objectives.common import LossModule
from torchrl.record.loggers import get_logger

from torchrl_rad.checkpoint import Checkpointer, CheckpointError, state_digest
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.envs.maze import MazeTask
from torchrl_rad.experiment.data import (
    check_data,
    describe_windows,
    make_data,
    resolve_dataset,
    window_sampler,
)
from torchrl_rad.experiment.driving import check_evaluation, collector_settings
from torchrl_rad.experiment.policies import (
    BACKBONE,
    PolicyParts,
    make_policies,
    share_weights,
    take_weights,
    trained_name,
)
from torchrl_rad.experiment.scoring import evaluate_policies
from torchrl_rad.learned_value import learn_value
from torchrl_rad.modules.step import StepEstimator
from torchrl_rad.objectives.step import StepEstimationLoss, draw_step_pairs
from torchrl_rad.parallel import first_before_others, first_decides, is_first, process_group
from torchrl_rad.plots import plot_curves, plot_targets
from torchrl_rad.policy import save_policy
from torchrl_rad.precision import uses_bf16
from torchrl_rad.results import format_table
from torchrl_rad.runs import RunFolder
from torchrl_rad.training import Interrupted, Objective, train

__all__ = [
    "MakeObjectives",
    "denoising_objective",
    "head_options",
    "make_logger",
    "return_objective",
    "run_recipe",
    "save_policies",
    "step_objective",
    "train_policies",
]

# config, policies and the name of the one that is trained -> objectives by name
MakeObjectives = Callable[[dict[str, Any], Mapping[str, PolicyParts], str], dict[str, Objective]]

# what a user can mend; OSError is a full disk or a folder that cannot be written
ERRORS = (CheckpointError, FloatingPointError, ImportError, KeyError, OSError, ValueError)


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


def denoising_objective(cfg: Mapping[str, Any], loss: LossModule) -> Objective:
    """L_d of a planner, with averaged weights, in bfloat16 where that is fast."""
    optim = cfg["optim"]
    rates = {name: optim[name] for name in ("lr", "warmup", "weight_decay", "ema")}
    bf16 = uses_bf16(optim["precision"], cfg["device"])
    common = {"steps": optim["gradient_steps"], "graphs": cfg["compile"]["cudagraphs"]}
    return Objective(loss, lambda windows: windows, bf16=bf16, **common, **rates)


def head_options(cfg: Mapping[str, Any]) -> dict[str, Any]:
    """How inverse dynamics, step estimator and return model are optimised."""
    optim = cfg["optim"]
    return {
        "lr": optim["head_lr"],
        "steps": optim["gradient_steps"],
        "warmup": optim["warmup"],
        "graphs": cfg["compile"]["cudagraphs"],
    }


def return_objective(cfg: Mapping[str, Any], loss: LossModule, lr: float) -> Objective:
    """L_g, of recorded returns or of the learned value."""
    if cfg["loss"]["value"] == "iql":
        loss.set_keys(value="value")
    return Objective(loss, lambda windows: windows, **{**head_options(cfg), "lr": lr})


def step_objective(cfg: Mapping[str, Any], estimator: StepEstimator) -> Objective:
    """L_e, on several pairs of states of each window."""
    pairs = cfg["loss"]["step_pairs"]
    return Objective(
        StepEstimationLoss(estimator),
        lambda windows: draw_step_pairs(
            windows["observation"], horizon=estimator.horizon, pairs=pairs
        ),
        **head_options(cfg),
    )


def train_policies(
    run: RunFolder,
    cfg: dict[str, Any],
    policies: Mapping[str, PolicyParts],
    data: TensorDictBase,
    make_objectives: MakeObjectives,
    resume: bool,
) -> None:
    """Trains and puts the averaged weights into all policies."""
    trained = trained_name(policies)
    objectives = make_objectives(cfg, policies, trained)
    logger, settings = make_logger(run, cfg), cfg["logger"]
    planner = policies[trained].policy[-1]
    torch.manual_seed(cfg["seed"])
    train(
        objectives,
        window_sampler(data, cfg["network"]["horizon"], cfg["replay_buffer"]["batch_size"]),
        cfg["optim"]["gradient_steps"],
        Checkpointer(run.path / "checkpoints"),
        save_interval=settings["save_interval"],
        log_interval=settings["log_interval"],
        log=logger,
        meta={
            "task": cfg["env"]["name"],
            "normalizer": state_digest(planner.normalizer.state_dict()),
            "network": cfg["network"],
        },
        resume=resume,
        begun=run.metrics.rewind,
        progress=settings["progress"],
    )
    for name in ("planner", BACKBONE):
        loss = objectives[name].loss
        loss.network_params.data.update_(loss.target_network_params.data)
    share_weights(policies, trained)


def save_policies(run: RunFolder, cfg: dict[str, Any], policies: Mapping[str, PolicyParts]) -> None:
    """Into the run folder's ``policies``."""
    for name, parts in policies.items():
        about = {"task": cfg["env"]["name"], "env": cfg["env"], "seed": cfg["seed"]}
        save_policy(
            run.path / "policies" / name,
            parts.policy,
            {**about, **parts.description},
            parts.database,
        )


def _say(text: Any) -> None:
    """Prints, in the first process of a group."""
    if is_first():
        print(text, flush=True)


def _open_run(cfg: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The run's folder, made or found, and its config."""
    if cfg["resume"] is not None:
        run = RunFolder.open(cfg["resume"])
        progress, saved = cfg["logger"]["progress"], run.config()
        saved["logger"]["progress"] = progress
        return str(run.path), saved
    resolve_dataset(cfg)
    if cfg["folder"] is not None:
        return str(RunFolder.create(cfg["folder"], cfg).path), cfg
    date = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder = f"outputs/{cfg['env']['name']}/{date}-seed{cfg['seed']}"
    return str(RunFolder.create(_new_folder(folder), cfg).path), cfg


def _new_folder(name: str) -> Path:
    """Makes a folder of that name, or where one is (of a sweep), of that name and a number."""
    for number in itertools.count(1):
        path = Path(name if number == 1 else f"{name}-{number}")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.mkdir()
        except FileExistsError:
            continue
        return path
    raise AssertionError("numbers do not end")


def _check_settings(cfg: Mapping[str, Any]) -> None:
    """Refuses now what would fail after the data is made, or after the training."""
    collector_settings(cfg.get("collector"))
    if cfg["loss"]["value"] not in ("recorded", "iql"):
        raise ValueError(f"loss.value is {cfg['loss']['value']!r}; expected 'recorded' or 'iql'.")
    threads, batch = cfg["threads"], cfg["replay_buffer"]["batch_size"]
    if min(threads, batch) < 1:
        raise ValueError(
            f"threads is {threads} and replay_buffer.batch_size is {batch}; expected 1 or more of "
            "both."
        )


def _say_kept(name: str, database: ExpertDatabase, data: TensorDictBase) -> None:
    """How many episodes the expert rule of a policy keeps."""
    total, kept = (len(rows["episode"].unique()) for rows in (data, database[:]))
    _say(f"{name}: {kept} of {total} episodes ({kept / total:.1%}), {len(database)} rows")
    if kept == total and database.expert is not None:
        advice = f"retrieval.{name}.expert='{{rule: top_share_by_return, args: [0.1]}}'"
        _say(f"WARNING: {name}'s rule keeps every episode; choose by {advice}")


def _whole_run(
    run: RunFolder, cfg: dict[str, Any], make_objectives: MakeObjectives, resume: bool
) -> None:
    """From the data to the table."""
    _check_settings(cfg)
    torch.set_num_threads(cfg["threads"])
    torch.manual_seed(cfg["seed"])  # fresh weights are the same when resumed
    _say(f"run folder: {run.path}\ndata: {cfg['replay_buffer']['dataset']}")
    task, data = first_before_others(lambda: make_data(cfg))  # which may record it
    _say(check_data(task, data))
    _say(describe_windows(data, cfg["network"]["horizon"]))
    try:
        policies = make_policies(cfg["network"], cfg["retrieval"], data)
    except TypeError as error:  # names and types of settings are those of the modules' arguments
        raise ValueError(f"a setting of the planner or of retrieval is wrong: {error}") from error
    check_evaluation(cfg["evaluation"], task, [parts.policy for parts in policies.values()])
    for name, parts in policies.items():
        parts.policy.to(cfg["device"])
        if parts.database is not None:
            _say_kept(name, parts.database, data)
    data = data.to(cfg["device"]) if cfg["device"] != "cpu" else data
    trained = not cfg.get("weights")
    if trained:
        if cfg["loss"]["value"] == "iql":
            data["value"] = learn_value(run, cfg, data, task.over(data))
        train_policies(run, cfg, policies, data, make_objectives, resume)
    else:
        take_weights(policies, cfg["weights"])
    if not is_first():
        return  # the first process evaluates
    if trained:
        plot_curves(run.metrics.rows(), run.path / "curves.png")
    save_policies(run, cfg, policies)
    if cfg["compile"]["cudagraphs"]:
        for parts in policies.values():
            parts.policy[-1].capture()
    rows, episodes = evaluate_policies(run, cfg, task, policies, data)
    titles = {name: f"{name}: {rows[name]['score']:.0f}" for name in rows}
    plain = {name: parts.policy for name, parts in policies.items()}
    if isinstance(task, MazeTask):
        plot_targets(task, episodes, plain, titles, run.path / "targets.png")
    print(f"\n{format_table(rows)}\n\n{task.score_source}", flush=True)


def run_recipe(
    cfg: dict[str, Any],
    make_objectives: MakeObjectives,
    recipe: str = "dl_rad.py",
    sweep: bool = False,
) -> None:
    """Runs a recipe; errors that a user can mend end in one line, kept in ``error.txt``.

    Args:
        cfg (dict): the resolved config; with ``resume`` that of the run folder it names is taken.
        make_objectives (callable): the losses of the recipe.
        recipe (str, optional): its file, named where it says how to go on.
        sweep (bool, optional): it is one of several runs; its errors do not end the others.

    Raises:
        RuntimeError: an error, in a sweep.
    """
    torchrl_logger.setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", "The name target_actor_network_params")  # of BCLoss
    resume, run = cfg["resume"] is not None, None
    try:
        with process_group(cfg["device"]) as device:
            folder, cfg = first_decides(lambda: _open_run(cfg))
            cfg["device"] = device
            opened = RunFolder(folder)
            with opened.locked() if is_first() else nullcontext():
                run = opened  # from here on its folder is ours
                run.note_error(None)
                _whole_run(run, cfg, make_objectives, resume)
    except KeyboardInterrupt as stop:
        at = f" and saved at step {stop.args[0]}" if isinstance(stop, Interrupted) else ""
        print(f"\nstopped{at}; go on with:", file=sys.stderr)
        print(f"python recipes/{recipe} resume={run.path if run else '<folder>'}", file=sys.stderr)
        sys.exit(130)
    except ERRORS as error:
        text = f"error: {error.args[0] if isinstance(error, KeyError) else error}"
        if run is not None:
            run.note_error(text)
        if sweep:
            raise RuntimeError(text) from error
        sys.exit(text)
