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
from torchrl_rad.experiment.policies import (
    BACKBONE,
    PolicyParts,
    make_database,
    make_policies,
    saved_maze,
    saved_task,
    share_weights,
    take_weights,
)
from torchrl_rad.experiment.recipe import (
    MakeObjectives,
    make_logger,
    run_recipe,
    save_policies,
    step_objective,
    train_policies,
)
from torchrl_rad.experiment.scoring import (
    collect_episodes,
    evaluate_policies,
    load_starts,
    policy_row,
    step_error,
)

__all__ = [
    "BACKBONE",
    "MakeObjectives",
    "PolicyParts",
    "check_data",
    "describe_windows",
    "collect_episodes",
    "evaluate_policies",
    "load_starts",
    "make_data",
    "make_database",
    "make_logger",
    "make_policies",
    "policy_row",
    "resolve_dataset",
    "restrict",
    "run_recipe",
    "saved_maze",
    "saved_task",
    "save_policies",
    "share_weights",
    "step_error",
    "step_objective",
    "take_weights",
    "task_dataset",
    "train_policies",
    "window_sampler",
]
