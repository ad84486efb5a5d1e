"""TS, SE and PL as TensorDict modules."""

from torchrl_rad.modules.condition import ReturnCondition
from torchrl_rad.modules.diffuser import DiffuserPlanner
from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.dit import DiT
from torchrl_rad.modules.inverse import InverseDynamics, inverse_dynamics_actor
from torchrl_rad.modules.levels import plan_levels
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.placement import TargetPlacement
from torchrl_rad.modules.process import (
    AncestralDiffusion,
    Diffusion,
    RectifiedFlow,
    make_process,
)
from torchrl_rad.modules.replanning import PlanActions, with_replanning
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.modules.sampling import Guidance, sample_plan
from torchrl_rad.modules.step import StepEstimator
from torchrl_rad.modules.target import RetrievalTargetModule
from torchrl_rad.modules.target_variants import PlainTargetModule
from torchrl_rad.modules.temporal_unet import TemporalUNet

__all__ = [
    "AncestralDiffusion",
    "DiT",
    "Diffusion",
    "DiffuserLitePlanner",
    "DiffuserPlanner",
    "Guidance",
    "InverseDynamics",
    "NoisyReturnModel",
    "Normalizer",
    "PlanActions",
    "PlainTargetModule",
    "RectifiedFlow",
    "RetrievalTargetModule",
    "ReturnCondition",
    "ReturnModel",
    "StepEstimator",
    "TargetPlacement",
    "TemporalUNet",
    "inverse_dynamics_actor",
    "make_process",
    "plan_levels",
    "sample_plan",
    "with_replanning",
]
