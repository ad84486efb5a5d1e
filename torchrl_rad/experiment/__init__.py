"""The steps that recipes share: data, policies, training, evaluation and its table."""

from torchrl_rad.experiment.data import (
    check_data,
    describe_windows,
    make_data,
    resolve_dataset,
    restrict,
    task_dataset,
    window_sampler,
)
from torchrl_rad.experiment.driving import Driver, check_evaluation, collector_settings
from torchrl_rad.experiment.episodes import (
    HeldRows,
    Unit,
    collect_episodes,
    join_units,
    load_starts,
    split_units,
)
from torchrl_rad.experiment.factory import PolicyFactory, TaskRows
from torchrl_rad.experiment.policies import (
    BACKBONE,
    PolicyParts,
    make_database,
    make_policies,
    saved_maze,
    saved_task,
    share_weights,
    take_weights,
    trained_name,
)
from torchrl_rad.experiment.ray_episodes import EpisodeCollector, RayEpisodes
from torchrl_rad.experiment.recipe import (
    MakeObjectives,
    denoising_objective,
    head_options,
    make_logger,
    return_objective,
    run_recipe,
    save_policies,
    step_objective,
    train_policies,
)
from torchrl_rad.experiment.scoring import (
    evaluate_policies,
    policy_row,
    step_error,
)

__all__ = [
    "BACKBONE",
    "Driver",
    "EpisodeCollector",
    "HeldRows",
    "MakeObjectives",
    "PolicyFactory",
    "PolicyParts",
    "RayEpisodes",
    "TaskRows",
    "Unit",
    "check_data",
    "check_evaluation",
    "collect_episodes",
    "collector_settings",
    "denoising_objective",
    "head_options",
    "describe_windows",
    "evaluate_policies",
    "join_units",
    "load_starts",
    "make_data",
    "make_database",
    "make_logger",
    "make_policies",
    "policy_row",
    "resolve_dataset",
    "restrict",
    "return_objective",
    "run_recipe",
    "save_policies",
    "saved_maze",
    "saved_task",
    "share_weights",
    "split_units",
    "step_error",
    "step_objective",
    "take_weights",
    "task_dataset",
    "train_policies",
    "trained_name",
    "window_sampler",
]
