"""Planning with retrieved demonstrations (RAD) as TorchRL modules."""

from torchrl_rad.data import *  # noqa: F403
from torchrl_rad.envs import *  # noqa: F403
from torchrl_rad.modules import *  # noqa: F403
from torchrl_rad.objectives import *  # noqa: F403
from torchrl_rad.retrieval import *  # noqa: F403
