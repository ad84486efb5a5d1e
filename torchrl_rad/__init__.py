"""Planning with retrieved demonstrations (RAD) as TorchRL modules."""

from torchrl_rad.calibration import similarity_threshold
from torchrl_rad.checkpoint import Checkpointer, CheckpointError
from torchrl_rad.data import *  # noqa: F403
from torchrl_rad.data import __all__ as _data
from torchrl_rad.envs import *  # noqa: F403
from torchrl_rad.envs import __all__ as _envs
from torchrl_rad.evaluation import evaluate
from torchrl_rad.modules import *  # noqa: F403
from torchrl_rad.modules import __all__ as _modules
from torchrl_rad.objectives import *  # noqa: F403
from torchrl_rad.objectives import __all__ as _objectives
from torchrl_rad.policy import build_policy, load_policy, save_policy, with_goals
from torchrl_rad.precision import planning_dtype
from torchrl_rad.provenance import demonstration_usage, provenance_table, write_provenance
from torchrl_rad.retrieval import *  # noqa: F403
from torchrl_rad.retrieval import __all__ as _retrieval
from torchrl_rad.training import Objective, train

__all__ = [
    "CheckpointError",
    "Checkpointer",
    "Objective",
    "build_policy",
    "demonstration_usage",
    "evaluate",
    "load_policy",
    "planning_dtype",
    "provenance_table",
    "save_policy",
    "similarity_threshold",
    "train",
    "with_goals",
    "write_provenance",
]
__all__ += [*_data, *_envs, *_modules, *_objectives, *_retrieval]
