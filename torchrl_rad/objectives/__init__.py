"""L_d, L_g and L_e as TorchRL losses."""

from torchrl_rad.objectives.denoising import DenoisingLoss
from torchrl_rad.objectives.guidance import ReturnGuidanceLoss, plan_return
from torchrl_rad.objectives.sequence import SequenceDenoisingLoss, SequenceGuidanceLoss
from torchrl_rad.objectives.step import StepEstimationLoss, draw_step_pairs
from torchrl_rad.objectives.value import make_value_loss, state_values

__all__ = [
    "DenoisingLoss",
    "ReturnGuidanceLoss",
    "SequenceDenoisingLoss",
    "SequenceGuidanceLoss",
    "StepEstimationLoss",
    "draw_step_pairs",
    "make_value_loss",
    "plan_return",
    "state_values",
]
