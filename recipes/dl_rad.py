"""DL-RAD: trains, compares with its backbone, prints a table.

python recipes/dl_rad.py task=pointmaze-medium seed=1
python recipes/dl_rad.py --multirun seed=0,1,2
python recipes/dl_rad.py resume=outputs/pointmaze-umaze/<run>
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from torchrl.objectives import BCLoss

from torchrl_rad import (
    DenoisingLoss,
    Objective,
    ReturnGuidanceLoss,
    inverse_dynamics_actor,
)
from torchrl_rad.experiment import (
    BACKBONE,
    PolicyParts,
    denoising_objective,
    head_options,
    return_objective,
    run_recipe,
    step_objective,
)


def make_objectives(
    cfg: dict[str, Any], policies: Mapping[str, PolicyParts], trained: str
) -> dict[str, Objective]:
    """L_d, L_e, L_g and behaviour cloning of the inverse dynamics; L_d again for the backbone."""
    _, estimator, planner = policies[trained].policy
    backbone = policies[BACKBONE].policy[-1]
    optim, network, loss = cfg["optim"], cfg["network"], cfg["loss"]

    def denoising(planner, only=None) -> Objective:
        module = DenoisingLoss(
            planner,
            no_target=loss["no_target"],
            pseudo_step=loss["pseudo_step"],
            next_weight=loss["next_weight"],
            only=only,
            delay=True,
        )
        return denoising_objective(cfg, module)

    objectives = {
        "planner": denoising(planner),
        # finer levels without targets are the same ones: trained once
        BACKBONE: denoising(backbone, only=[0] if planner.placement.first_only else None),
        "estimator": step_objective(cfg, estimator),
        "inverse": Objective(
            BCLoss(inverse_dynamics_actor(planner.inverse_dynamics), loss_function="l2"),
            lambda windows: windows[:, :8].reshape(-1),  # enough of them; all would cost more
            **head_options(cfg),
        ),
    }
    if planner.return_model is not None:
        module = ReturnGuidanceLoss(
            planner.return_model, jump=network["jumps"][0], gamma=loss["gamma"]
        )
        objectives["return"] = return_objective(cfg, module, optim["head_lr"])
    return objectives


@hydra.main(config_path="config", config_name="dl_rad", version_base="1.3")
def main(config: DictConfig) -> None:
    """Reads the command line."""
    cfg = OmegaConf.to_container(config, resolve=True)
    cfg.pop("diffuser", None)  # of the other recipe
    run_recipe(cfg, make_objectives, sweep=HydraConfig.get().mode == RunMode.MULTIRUN)


if __name__ == "__main__":
    main()
