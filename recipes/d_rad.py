"""D-RAD: trains, compares with its backbone, prints a table.

python recipes/d_rad.py task=hopper-medium-replay seed=1
python recipes/d_rad.py --multirun seed=0,1,2
python recipes/d_rad.py resume=outputs/pointmaze-umaze/<run>
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrl_rad import Objective, SequenceDenoisingLoss, SequenceGuidanceLoss
from torchrl_rad.experiment import (
    BACKBONE,
    PolicyParts,
    denoising_objective,
    return_objective,
    run_recipe,
    step_objective,
)


def make_objectives(
    cfg: dict[str, Any], policies: Mapping[str, PolicyParts], trained: str
) -> dict[str, Objective]:
    """L_d, L_e and L_g; L_d again for the backbone."""
    planner, backbone = (policies[name].policy[-1] for name in (trained, BACKBONE))
    loss = cfg["loss"]
    shared = {name: loss[name] for name in ("no_target", "pseudo_step")}

    def denoising(planner) -> Objective:
        module = SequenceDenoisingLoss(
            planner, action_weight=loss["next_weight"], delay=True, **shared
        )
        return denoising_objective(cfg, module)

    objectives = {
        "planner": denoising(planner),
        BACKBONE: denoising(backbone),
        "estimator": step_objective(cfg, policies[trained].policy[1]),
    }
    if planner.return_model is not None:
        module = SequenceGuidanceLoss(planner, gamma=loss["gamma"], **shared)
        objectives["return"] = return_objective(cfg, module, cfg["optim"]["lr"])
    return objectives


@hydra.main(config_path="config", config_name="d_rad", version_base="1.3")
def main(config: DictConfig) -> None:
    """Reads the command line."""
    cfg = OmegaConf.to_container(config, resolve=True)
    cfg["network"] = cfg.pop("diffuser")
    for options in cfg["retrieval"].values():
        options["network"] = options.pop("diffuser", {})
    run_recipe(cfg, make_objectives, "d_rad.py", sweep=HydraConfig.get().mode == RunMode.MULTIRUN)


if __name__ == "__main__":
    main()
