"""DL-RAD on PointMaze: trains, compares with its backbone, prints a table.

python recipes/dl_rad.py task=pointmaze-medium seed=1
python recipes/dl_rad.py --multirun seed=0,1,2
python recipes/dl_rad.py resume=outputs/pointmaze-umaze/<run>
"""

from __future__ import annotations

import datetime
import logging
import sys
import warnings
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl._utils import logger as torchrl_logger
from torchrl.objectives import BCLoss

from torchrl_rad import (
    DenoisingLoss,
    ReturnGuidanceLoss,
    StepEstimationLoss,
    draw_step_pairs,
    inverse_dynamics_actor,
)
from torchrl_rad.checkpoint import Checkpointer, CheckpointError, state_digest
from torchrl_rad.envs import MazeTask
from torchrl_rad.experiment import (
    BACKBONE,
    PolicyParts,
    check_data,
    evaluate_policies,
    make_data,
    make_logger,
    make_policies,
    resolve_dataset,
    share_weights,
    window_sampler,
)
from torchrl_rad.learned_value import learn_value
from torchrl_rad.plots import plot_curves, plot_targets
from torchrl_rad.policy import save_policy
from torchrl_rad.precision import uses_bf16
from torchrl_rad.results import format_table
from torchrl_rad.runs import RunFolder
from torchrl_rad.training import Interrupted, Objective, train

torchrl_logger.setLevel(logging.WARNING)
warnings.filterwarnings("ignore", "The name target_actor_network_params")  # of TorchRL's BCLoss

# what a user can mend; OSError is a full disk or a folder that cannot be written
ERRORS = (CheckpointError, FloatingPointError, ImportError, KeyError, OSError, ValueError)


def make_objectives(cfg: dict[str, Any], policies: dict[str, PolicyParts], trained: str):
    """L_d, L_e, L_g and behaviour cloning of the inverse dynamics; L_d again for the backbone."""
    _, estimator, planner = policies[trained].policy
    backbone = policies[BACKBONE].policy[-1]
    optim, network, loss = cfg["optim"], cfg["network"], cfg["loss"]
    steps, head = optim["gradient_steps"], {"lr": optim["head_lr"], "warmup": optim["warmup"]}
    bf16 = uses_bf16(optim["precision"], cfg["device"])

    def denoising(planner) -> Objective:
        module = DenoisingLoss(
            planner,
            no_target=loss["no_target"],
            pseudo_step=loss["pseudo_step"],
            next_weight=loss["next_weight"],
            delay=True,
        )
        names = ("lr", "warmup", "weight_decay", "ema")
        options = {name: optim[name] for name in names}
        return Objective(module, lambda windows: windows, steps=steps, bf16=bf16, **options)

    objectives = {
        "planner": denoising(planner),
        BACKBONE: denoising(backbone),
        "estimator": Objective(
            StepEstimationLoss(estimator),
            lambda windows: draw_step_pairs(
                windows["observation"], horizon=estimator.horizon, pairs=loss["step_pairs"]
            ),
            steps=steps,
            **head,
        ),
        "inverse": Objective(
            BCLoss(inverse_dynamics_actor(planner.inverse_dynamics), loss_function="l2"),
            lambda windows: windows[:, :8].reshape(-1),  # enough of them; all would cost more
            steps=steps,
            **head,
        ),
    }
    if planner.return_model is not None:
        module = ReturnGuidanceLoss(
            planner.return_model, jump=network["jumps"][0], gamma=loss["gamma"]
        )
        if loss["value"] == "iql":
            module.set_keys(value="value")
        objectives["return"] = Objective(module, lambda windows: windows, steps=steps, **head)
    return objectives


def run_training(run: RunFolder, cfg: dict[str, Any], policies, data, resume: bool) -> None:
    """Trains, puts the averaged weights into all policies and saves these."""
    trained = next(name for name in policies if name != BACKBONE)
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
    for name, parts in policies.items():
        about = {"task": cfg["env"]["name"], "env": cfg["env"], "seed": cfg["seed"]}
        save_policy(
            run.path / "policies" / name,
            parts.policy,
            {**about, **parts.description},
            parts.database,
        )


def main_run(run: RunFolder, cfg: dict[str, Any], resume: bool) -> None:
    """The whole of a run, from the data to the table."""
    if cfg["device"].startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"device is {cfg['device']!r}, but torch sees no GPU; use device=cpu.")
    torch.set_num_threads(cfg["threads"])
    torch.manual_seed(cfg["seed"])  # fresh weights are the same when resumed
    if cfg["loss"]["value"] not in ("recorded", "iql"):
        raise ValueError(f"loss.value is {cfg['loss']['value']!r}; expected 'recorded' or 'iql'.")
    print(f"run folder: {run.path}\ndata: {cfg['replay_buffer']['dataset']}", flush=True)
    task, data = make_data(cfg)
    print(check_data(task, data), flush=True)
    policies = make_policies(cfg["network"], cfg["retrieval"], data)
    for parts in policies.values():
        parts.policy.to(cfg["device"])
    for name, parts in policies.items():
        if parts.database is not None:
            total, kept = (len(t["episode"].unique()) for t in (data, parts.database[:]))
            share = f"{kept} of {total} episodes ({kept / total:.1%})"
            print(f"{name}: {share}, {len(parts.database)} rows", flush=True)
    data = data.to(cfg["device"]) if cfg["device"] != "cpu" else data
    if cfg["loss"]["value"] == "iql":
        data["value"] = learn_value(run, cfg, data)
    run_training(run, cfg, policies, data, resume)
    rows, episodes = evaluate_policies(run, cfg, task, policies, data)
    plot_curves(run.metrics.rows(), run.path / "curves.png")
    titles = {name: f"{name}: {rows[name]['score']:.0f}" for name in rows}
    plain = {name: parts.policy for name, parts in policies.items()}
    if isinstance(task, MazeTask):
        plot_targets(task, episodes, plain, titles, run.path / "targets.png")
    print(f"\n{format_table(rows)}\n\n{task.score_source}", flush=True)


@hydra.main(config_path="config", config_name="dl_rad", version_base="1.3")
def main(config: DictConfig) -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    cfg = OmegaConf.to_container(config, resolve=True)
    resume = cfg["resume"] is not None
    try:
        if resume:
            run = RunFolder.open(cfg["resume"])
            progress, cfg = cfg["logger"]["progress"], run.config()
            cfg["logger"]["progress"] = progress
        else:
            date = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
            resolve_dataset(cfg)
            folder = cfg["folder"] or f"outputs/{cfg['env']['name']}/{date}-seed{cfg['seed']}"
            run = RunFolder.create(folder, cfg)
        main_run(run, cfg, resume)
    except KeyboardInterrupt as stop:
        at = f" and saved at step {stop.args[0]}" if isinstance(stop, Interrupted) else ""
        print(f"\nstopped{at}; go on with:", file=sys.stderr)
        print(f"python recipes/dl_rad.py resume={run.path}", file=sys.stderr)
        sys.exit(130)
    except ERRORS as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")


if __name__ == "__main__":
    main()
