"""Whole policies: built from a description, saved in a folder, loaded in another process."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey

from torchrl_rad.checkpoint import (
    CheckpointError,
    load_weights,
    read_json,
    save_weights,
    staged_folder,
    state_digest,
    verify_manifest,
    write_json,
)
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.sharded import ShardedExpertDatabase, load_database
from torchrl_rad.modules.diffuser import DiffuserPlanner
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.levels import level_changes
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.planner import Planner
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.modules.step import StepEstimator
from torchrl_rad.modules.target import OUT_KEYS, RetrievalTargetModule
from torchrl_rad.modules.target_variants import PlainTargetModule
from torchrl_rad.retrieval.goals import GoalReward

__all__ = ["build_policy", "fit_scales", "load_policy", "save_policy", "with_goals"]

Database = ExpertDatabase | ShardedExpertDatabase

FORMAT = 1
# settings that must be known before a planner is built, by its kind
PLANNERS: dict[str, dict[str, Any]] = {
    "diffuser": {"horizon": 32, "candidates": 64, "return_model": {}},
    "diffuser_lite": {"horizon": 129, "jumps": (32, 8, 1), "candidates": 1},
}


def build_policy(
    description: dict[str, Any], database: Database | None = None
) -> TensorDictSequential:
    """A policy with fresh weights: TS, SE and PL, or PL alone where there is no ``"target"``.

    Args:
        description (dict): ``state_dim``, ``action_dim`` and ``action_bound`` (1.0 if left out);
            ``planner``, ``estimator`` and ``target``: arguments of :class:`DiffuserLitePlanner` (of
            :class:`DiffuserPlanner` if its ``kind`` is ``"diffuser"``, whose ``return_model`` holds
            arguments of :class:`NoisyReturnModel`, or None),
            :class:`StepEstimator` and :class:`RetrievalTargetModule`, a ``goal_reward`` as those of
            :class:`GoalReward`; the rules ``"random"``, ``"nearest"`` and ``"none"`` are those of
            :class:`PlainTargetModule`. The horizon of ``"target"`` holds for the estimator too; it
            is the planner's if it is left out.
        database (ExpertDatabase or ShardedExpertDatabase, optional): the demonstrations, needed
            with a target.

    Raises:
        ValueError: the planner's kind is none of these; a target is described and there is no
            database, or its horizon is larger than the planner's or not the estimator's.

    Examples:
        >>> policy = build_policy({
        ...     "state_dim": 4, "action_dim": 2, "planner": {"width": 32}, "target": None})
        >>> policy.in_keys, policy.out_keys
        (['observation'], ['plan', 'action'])
    """
    target = description.get("target")
    kind = description["planner"].get("kind", "diffuser_lite")
    if kind not in PLANNERS:
        raise ValueError(f"kind of planner is {kind!r}; expected one of {sorted(PLANNERS)}.")
    options = {**PLANNERS[kind], **description["planner"], "targets": target is not None}
    options.pop("kind", None)
    horizon = options["horizon"]
    estimator_options = dict(description.get("estimator") or {})
    reach = (target or {}).get("horizon", horizon)
    if reach > horizon:
        raise ValueError(
            f"the horizon of 'target' is {reach}, but the planner was built for {horizon}; "
            f"a target beyond the plan cannot be planned for: use {horizon} or less."
        )
    other = estimator_options.get("horizon", reach)
    if other != reach:
        raise ValueError(
            f"the horizon of 'estimator' is {other}, but that of 'target' is {reach}; "
            "leave it out, so that the target's holds."
        )
    states, action_dim = Normalizer.identity(description["state_dim"]), description["action_dim"]
    bound = description.get("action_bound", 1.0)
    if kind == "diffuser":
        planner: Planner = _diffuser(states, action_dim, bound, options)
    else:
        planner = _diffuser_lite(states, action_dim, bound, options, database)
    if target is None:
        return TensorDictSequential(planner)
    if database is None:
        raise ValueError("this policy retrieves targets: pass the database.")
    select = _select(database, {**target, "horizon": reach})
    estimator = StepEstimator(states, **{**estimator_options, "horizon": reach})
    return TensorDictSequential(select, estimator, planner)


def _diffuser_lite(
    states: Normalizer,
    action_dim: int,
    bound: float,
    options: dict[str, Any],
    database: Database | None,
) -> DiffuserLitePlanner:
    difference = Normalizer.identity(len(states.mean))
    inverse = InverseDynamics(states, difference, action_dim, bound=bound)
    if options["candidates"] > 1:
        tokens = (options["horizon"] - 1) // options["jumps"][0] + 1
        options["return_model"] = ReturnModel(states, tokens)
    return DiffuserLitePlanner(states, inverse, database=database, **options)


def _diffuser(
    states: Normalizer, action_dim: int, bound: float, options: dict[str, Any]
) -> DiffuserPlanner:
    model = options.pop("return_model")
    if model is not None:
        model = NoisyReturnModel(states, action_dim, options["horizon"], **model)
    return DiffuserPlanner(states, action_dim, return_model=model, bound=bound, **options)


def _select(database: Database, options: dict[str, Any]) -> TensorDictModuleBase:
    names = (*OUT_KEYS, "target_offset", "target_source")
    if options.get("rule") in ("random", "nearest", "none"):
        return PlainTargetModule(database, options["rule"], out_keys=names)
    if "goal_reward" in options:
        options["goal_reward"] = GoalReward(**options["goal_reward"])
    return RetrievalTargetModule(database, out_keys=names, **options)


def with_goals(
    policy: TensorDictSequential,
    database: Database,
    goal_key: NestedKey = "goal",
    goal_reward: GoalReward | None = None,
) -> TensorDictSequential:
    """The same planner on the way to a goal that each row brings along: nothing is trained.

    What the planner and the step estimator learned holds for any goal; the return model belongs to
    the one it was trained for, so that plans are neither ranked nor guided by it.

    Args:
        policy (TensorDictSequential): of :func:`build_policy`, with targets; its weights are
            shared.
        database (ExpertDatabase or ShardedExpertDatabase): of all recorded episodes, not only
            those that reach one goal.
        goal_key (NestedKey, optional): the goal [*B, G]. Defaults to ``"goal"``.
        goal_reward (GoalReward, optional): when it is reached. Defaults to within 0.5 of it.

    Raises:
        ValueError: the policy has no targets, or its planner is told returns.
    """
    if len(policy) != 3:
        raise ValueError("this policy has no targets; goals need one of TS, SE and PL.")
    select, estimator, planner = policy
    if planner.condition is not None:
        raise ValueError(
            "this planner is told returns, which are of the goal it was trained for; train it "
            "with network.condition=null."
        )
    names = ("horizon", "rule", "ahead", "retrieval_interval", "min_offset")
    settings = {name: getattr(select, name) for name in names}
    select = RetrievalTargetModule(
        database,
        **settings,
        goal_key=goal_key,
        goal_reward=goal_reward,
        in_keys=select.in_keys[:1],
        out_keys=select.named_out,
    )
    planner = copy.copy(planner)
    planner.candidates = 1
    if isinstance(planner, DiffuserPlanner):
        planner.guide_scale = 0.0
    else:
        planner.__dict__["database"] = database
    return TensorDictSequential(select, estimator, planner)


def fit_scales(policy: TensorDictSequential, data: TensorDictBase) -> None:
    """Takes over the scales of recorded data: of states, their changes, and of returns.

    Args:
        policy (TensorDictSequential): of :func:`build_policy`; changed in place.
        data (TensorDictBase): flat steps [T] with ``observation``, ``("next", "observation")``,
            ``episode`` and ``return_to_go`` [T].

    Raises:
        ValueError: the states hold NaN or Inf, or have another width.
    """
    planner = policy[-1]
    now, following = data["observation"], data["next", "observation"]
    planner.normalizer.load_state_dict(_scale(now, planner.normalizer))
    if isinstance(planner, DiffuserLitePlanner):
        change = planner.inverse_dynamics.difference
        change.load_state_dict(_scale(following - now, change))
        if planner.changes is not None:
            for level, scale in zip(planner.levels, planner.changes, strict=True):
                scale.load_state_dict(level_changes(now, data["episode"], level).state_dict())
        if planner.condition is not None:
            planner.condition.fit(data["return_to_go"])
    if planner.return_model is not None:
        planner.return_model.fit_scale(data["return_to_go"])


def _scale(values, like: Normalizer) -> dict[str, Any]:
    if values.shape[-1] != len(like.mean):
        raise ValueError(
            f"the states have {values.shape[-1]} entries; the policy was built for {len(like.mean)}"
        )
    return Normalizer.of(values).state_dict()


def save_policy(
    folder: str | Path,
    policy: TensorDictSequential,
    description: dict[str, Any],
    database: Database | None = None,
) -> None:
    """Saves a policy: description, weights and database, with the sha256 of each file.

    The folder holds ``policy.json``, ``weights.safetensors``, ``database/`` and
    ``manifest.json``; it appears only when it is complete, in place of an older one.

    Args:
        folder (path): parents are made if need be.
        policy (TensorDictSequential): built by :func:`build_policy` with this description.
        description (dict): see there; further entries are kept.
        database (ExpertDatabase or ShardedExpertDatabase, optional): saved beside the weights.

    Raises:
        CheckpointError: the disk is full or the folder cannot be written.
    """
    try:
        with staged_folder(folder, replace=True) as stage:
            save_weights(stage, "weights", policy)
            if database is not None:
                database.dumps(stage / "database")
            about = {
                "format": FORMAT,
                "database": None if database is None else database.digest(),
                "normalizer": state_digest(policy[-1].normalizer.state_dict()),
            }
            write_json(stage / "policy.json", {**description, **about})
    except OSError as error:
        raise CheckpointError(f"the policy was not saved in {folder}: {error}.") from error
    if database is not None:
        database.path = Path(folder).absolute() / "database"  # no longer in the stage


def load_policy(
    folder: str | Path,
    database: Database | None = None,
    device: str | torch.device = "cpu",
    memmap: bool = False,
) -> TensorDictSequential:
    """Loads a saved policy; with the same seed it acts as it did where it was saved.

    Args:
        folder (path): written by :func:`save_policy`.
        database (ExpertDatabase or ShardedExpertDatabase, optional): used in place of the saved
            one, on purpose: other rows, other behaviour.
        device (str, optional): of the networks. Defaults to ``"cpu"``.
        memmap (bool, optional): read the rows of the saved database from its files as they are
            asked for, which processes of one machine share; it cannot grow then. Defaults to
            ``False``.

    Raises:
        FileNotFoundError: the folder holds no policy.
        CheckpointError: a file is damaged, cut short or missing, the folder is of another version,
            or the database or the normaliser is not the one that was saved.
    """
    folder = Path(folder)
    if not (folder / "policy.json").exists():
        raise FileNotFoundError(
            f"{folder} holds no policy: policy.json is missing. "
            "Pass a folder that save_policy wrote, such as <run folder>/policies/followed."
        )
    verify_manifest(folder)
    description = read_json(folder / "policy.json")
    if description.get("format") != FORMAT:
        raise CheckpointError(
            f"{folder} has the format {description.get('format')}; this version of torchrl_rad "
            f"reads {FORMAT}. Load it with the version that saved it."
        )
    if database is None and description["database"] is not None:
        database = load_database(folder / "database", memmap)
        if database.digest() != description["database"]:
            raise CheckpointError(
                f"{folder / 'database'} is not the database that this policy was saved with "
                "(sha256 differs); restore it, or pass another one on purpose: "
                "load_policy(folder, database=...)."
            )
    policy = build_policy(description, database)
    load_weights(folder, "weights", policy)
    if state_digest(policy[-1].normalizer.state_dict()) != description["normalizer"]:
        raise CheckpointError(f"the weights in {folder} have another normaliser than policy.json.")
    return policy.to(device).eval()
