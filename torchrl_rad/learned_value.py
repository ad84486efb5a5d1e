"""The learned value as a column of the data: trained once for a run, resumed with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.checkpoint import Checkpointer, state_digest
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.objectives.value import make_value_loss, state_values
from torchrl_rad.runs import RunFolder
from torchrl_rad.training import Objective, train

__all__ = ["learn_value"]

BATCH, LR, EMA = 256, 3e-4, 0.995  # as IQL's authors have them


def learn_value(
    run: RunFolder, cfg: Mapping[str, Any], data: TensorDictBase, over: Tensor
) -> Tensor:
    """V(s) of each recorded step, float32 [T], by implicit Q-learning.

    Args:
        run (RunFolder): whose folder ``value/`` holds checkpoints and ``value.csv`` the losses; a
            training that was stopped is gone on with.
        cfg (mapping): ``loss`` (``gamma``, ``expectile``, ``value_steps``), ``logger`` and
            ``seed``.
        data (TensorDictBase): flat steps [T].
        over (Tensor): bool [T, 1], which of them end the task.

    Raises:
        CheckpointError: a checkpoint is damaged or of another run.
        FloatingPointError: a loss is NaN or Inf.
        Interrupted: it was asked to stop; what was done is saved.
    """
    settings, steps = cfg["loss"], cfg["loss"]["value_steps"]
    torch.manual_seed(cfg["seed"])
    normalizer = Normalizer.of(data["observation"])
    made = make_value_loss(
        normalizer, data["action"].shape[-1], settings["gamma"], settings["expectile"]
    )
    objective = Objective(made, lambda batch: batch, lr=LR, steps=steps, weight_decay=0.0, ema=EMA)
    kept = data.select("observation", "action", "next").copy()
    kept["next", "terminated"] = kept["next", "done"] = over

    def sample() -> TensorDictBase:
        return kept[torch.randint(len(kept), (BATCH,), device=kept.device)]

    about = {"gamma": settings["gamma"], "expectile": settings["expectile"], "steps": steps}
    train(
        {"value": objective},
        sample,
        steps,
        Checkpointer(run.path / "value"),
        save_interval=max(1, steps // 10),
        log_interval=max(1, steps // 100),
        log=run.value_metrics.write,
        meta={**about, "normalizer": state_digest(normalizer.state_dict())},
        resume=True,
        begun=run.value_metrics.rewind,
        progress=cfg["logger"]["progress"],
    )
    return state_values(made, data["observation"])
