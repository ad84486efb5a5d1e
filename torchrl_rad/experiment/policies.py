"""The policies of a run, one for each way to retrieve, and the task of a saved one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage

from torchrl_rad.checkpoint import CheckpointError, load_weights, read_json
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.experts import expert_from_config
from torchrl_rad.envs.maze import MazeTask
from torchrl_rad.envs.task import Task
from torchrl_rad.envs.tasks import make_task
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.policy import build_policy, fit_scales
from torchrl_rad.retrieval import RetrievalSampler

__all__ = [
    "BACKBONE",
    "PolicyParts",
    "make_database",
    "make_policies",
    "saved_maze",
    "saved_task",
    "share_weights",
    "take_weights",
    "trained_name",
]

BACKBONE = "backbone"


@dataclass
class PolicyParts:
    """A policy with what it takes to save it."""

    policy: TensorDictSequential
    description: dict[str, Any]
    database: ExpertDatabase | None = None


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
        retrieval (mapping): name -> ``expert``, ``gamma``, ``sampler``, ``target``, ``estimator``,
            and ``network``, how this policy plans otherwise, with the same weights.
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
        own = {"planner": {**planner, **options.get("network", {})}}
        description = {**shared, **own, "target": target, "estimator": estimator}
        policy = build_policy(description, database)
        policies[name] = PolicyParts(policy, description, database)
    for parts in policies.values():
        fit_scales(parts.policy, data)
    return policies


def trained_name(policies: Mapping[str, PolicyParts]) -> str:
    """The policy with targets that is trained for all of them."""
    return next(name for name in policies if name != BACKBONE)


def share_weights(policies: Mapping[str, PolicyParts], trained: str) -> None:
    """Gives the weights of one policy to all: all of them, or the backbone what knows no target."""
    source = policies[trained].policy
    for name, parts in policies.items():
        if name == BACKBONE:
            own, given = parts.policy[-1], source[-1]
            if isinstance(own, DiffuserLitePlanner):
                own.inverse_dynamics.load_state_dict(given.inverse_dynamics.state_dict())
                if given.placement.first_only:
                    own.networks[1:].load_state_dict(given.networks[1:].state_dict())
            if own.return_model is not None:
                own.return_model.load_state_dict(given.return_model.state_dict())
        elif name != trained:
            parts.policy.load_state_dict(source.state_dict())


def take_weights(policies: Mapping[str, PolicyParts], folder: str | Path) -> None:
    """Gives the trained weights of another run to these policies, which may retrieve otherwise.

    Args:
        policies (mapping): of :func:`make_policies`, with planners of the same sizes.
        folder (path): the run folder.

    Raises:
        CheckpointError: there are no such weights, or they are of other sizes.
    """
    saved = Path(folder) / "policies"
    found = sorted(path.parent for path in saved.glob("*/policy.json"))
    with_targets = [path for path in found if path.name != BACKBONE]
    if not with_targets:
        raise CheckpointError(f"{folder} holds no trained policy with targets: give a run folder.")
    trained = trained_name(policies)
    load_weights(saved / BACKBONE, "weights", policies[BACKBONE].policy)
    load_weights(with_targets[0], "weights", policies[trained].policy)
    share_weights(policies, trained)


def saved_task(folder: str | Path) -> Task:
    """The task of a saved policy.

    Raises:
        CheckpointError: the folder holds no policy, or one that does not say of which task.
    """
    about = read_json(Path(folder) / "policy.json")
    if "env" not in about:
        raise CheckpointError(f"the policy in {folder} does not say of which task it is ('env').")
    return make_task(about["env"])


def saved_maze(folder: str | Path) -> MazeTask:
    """The task of a saved policy, which must be a PointMaze.

    Raises:
        CheckpointError: the folder holds no policy, or one that does not say of which task.
        ValueError: it is of another task.
    """
    task = saved_task(folder)
    if not isinstance(task, MazeTask):
        raise ValueError(
            f"the policy in {folder} is of {task.name}; this needs one of a PointMaze."
        )
    return task
