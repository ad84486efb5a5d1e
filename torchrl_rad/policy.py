"""Whole policies: built from a description, saved in a folder, loaded in another process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictSequential

from torchrl_rad.checkpoint import (
    CheckpointError,
    load_weights,
    read_json,
    save_weights,
    state_digest,
    verify_manifest,
    write_json,
    write_manifest,
)
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.modules.step import StepEstimator
from torchrl_rad.modules.target import OUT_KEYS, RetrievalTargetModule

__all__ = ["build_policy", "load_policy", "save_policy"]

FORMAT = 1


def build_policy(description: dict[str, Any], database: ExpertDatabase | None = None) -> TensorDictSequential:
    """A policy with fresh weights: TS, SE and PL, or PL alone where the description has no ``"target"``.

    Args:
        description (dict): ``state_dim``, ``action_dim``; ``planner``, ``estimator`` and ``target``: arguments of
            :class:`DiffuserLitePlanner`, :class:`StepEstimator` and :class:`RetrievalTargetModule`.
        database (ExpertDatabase, optional): the demonstrations, needed with a target.

    Raises:
        ValueError: a target is described and there is no database.

    Examples:
        >>> policy = build_policy({"state_dim": 4, "action_dim": 2, "planner": {"width": 32}, "target": None})
        >>> policy.in_keys, policy.out_keys
        (['observation'], ['plan', 'action'])
    """
    states, target = Normalizer.identity(description["state_dim"]), description.get("target")
    difference = Normalizer.identity(description["state_dim"])
    inverse = InverseDynamics(states, difference, description["action_dim"])
    options = dict(description["planner"])
    horizon, jumps = options.get("horizon", 129), options.get("jumps", (32, 8, 1))
    if options.get("candidates", 1) > 1:
        options["return_model"] = ReturnModel(states, tokens=(horizon - 1) // jumps[0] + 1)
    planner = DiffuserLitePlanner(states, inverse, targets=target is not None, database=database, **options)
    if target is None:
        return TensorDictSequential(planner)
    if database is None:
        raise ValueError("this policy retrieves targets: pass the database.")
    select = RetrievalTargetModule(database, horizon, **target, out_keys=[*OUT_KEYS, "target_offset"])
    estimator = StepEstimator(states, horizon, **description.get("estimator", {}))
    return TensorDictSequential(select, estimator, planner)


def save_policy(
    folder: str | Path,
    policy: TensorDictSequential,
    description: dict[str, Any],
    database: ExpertDatabase | None = None,
) -> None:
    """Saves a policy: ``policy.json``, ``weights.safetensors``, ``database/`` and a manifest with the sha256 of each.

    Args:
        folder (path): made if need be.
        policy (TensorDictSequential): built by :func:`build_policy` with this description.
        description (dict): see there; further entries are kept.
        database (ExpertDatabase, optional): saved beside the weights.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    save_weights(folder, "weights", policy)
    if database is not None:
        database.dumps(folder / "database")
    digest = None if database is None else database.digest()
    normalizer = state_digest(policy.module[-1].normalizer.state_dict())
    write_json(
        folder / "policy.json",
        {**description, "format": FORMAT, "database": digest, "normalizer": normalizer},
    )
    write_manifest(folder)


def load_policy(
    folder: str | Path, database: ExpertDatabase | None = None, device: str | torch.device = "cpu"
) -> TensorDictSequential:
    """Loads a saved policy; with the same seed it acts as it did where it was saved.

    Args:
        folder (path): written by :func:`save_policy`.
        database (ExpertDatabase, optional): used in place of the saved one, on purpose: other rows, other behaviour.
        device (str, optional): of the networks. Defaults to ``"cpu"``.

    Raises:
        FileNotFoundError: the folder holds no policy.
        CheckpointError: a file is damaged, cut short or missing, or the database is not the one that was saved.
    """
    folder = Path(folder)
    if not (folder / "policy.json").exists():
        raise FileNotFoundError(f"{folder} holds no policy: policy.json is missing. Pass a folder that save_policy wrote.")
    verify_manifest(folder)
    description = read_json(folder / "policy.json")
    if database is None and description["database"] is not None:
        database = ExpertDatabase.loads(folder / "database")
        if database.digest() != description["database"]:
            raise CheckpointError(
                f"{folder / 'database'} is not the database that this policy was saved with (sha256 differs); "
                "restore it, or pass another one on purpose: load_policy(folder, database=...)."
            )
    policy = build_policy(description, database)
    load_weights(folder, "weights", policy)
    return policy.to(device).eval()
