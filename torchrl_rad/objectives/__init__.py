"""L_d, L_g and L_e as TorchRL losses."""

from torchrl_rad.objectives.denoising import DenoisingLoss
from torchrl_rad.objectives.guidance import ReturnGuidanceLoss, plan_return
from torchrl_rad.objectives.step import StepEstimationLoss, draw_step_pairs

__all__ = [
    "DenoisingLoss",
    "ReturnGuidanceLoss",
    "StepEstimationLoss",
    "draw_step_pairs",
    "plan_return",
]
