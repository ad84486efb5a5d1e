"""Data sets, episodes, windows and the expert database."""

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.episodes import episode_lengths, return_to_go, step_and_remaining
from torchrl_rad.data.experts import (
    Expert,
    episode_length,
    expert_from_config,
    first_hit_within,
    near_best_return,
    reaches_goal,
    return_at_least,
    subtasks_done,
    top_share_by_return,
)
from torchrl_rad.data.hdf5 import has_successor, load_hdf5
from torchrl_rad.data.kitchen import (
    KITCHEN_TASKS,
    newly_done,
    relabel_tasks,
    tasks_done,
    tasks_in_place,
)
from torchrl_rad.data.minari import check_content, join_stream, load_minari
from torchrl_rad.data.ogbench import load_ogbench
from torchrl_rad.data.pointmaze import collect_pointmaze, pointmaze_dataset
from torchrl_rad.data.regions import enters_region, without_region
from torchrl_rad.data.report import DataReport
from torchrl_rad.data.report import report as data_report  # "report" is the module
from torchrl_rad.data.sharded import ShardedExpertDatabase, load_database
from torchrl_rad.data.sources import concatenate_steps, find_dataset, load_dataset
from torchrl_rad.data.windows import Window, WindowSampler, window_buffer

__all__ = [
    "KITCHEN_TASKS",
    "DataReport",
    "Expert",
    "ExpertDatabase",
    "ShardedExpertDatabase",
    "Window",
    "WindowSampler",
    "check_content",
    "collect_pointmaze",
    "concatenate_steps",
    "data_report",
    "enters_region",
    "episode_length",
    "episode_lengths",
    "expert_from_config",
    "find_dataset",
    "first_hit_within",
    "has_successor",
    "join_stream",
    "load_database",
    "load_dataset",
    "load_hdf5",
    "load_minari",
    "load_ogbench",
    "near_best_return",
    "newly_done",
    "pointmaze_dataset",
    "reaches_goal",
    "relabel_tasks",
    "return_at_least",
    "return_to_go",
    "step_and_remaining",
    "subtasks_done",
    "tasks_done",
    "tasks_in_place",
    "top_share_by_return",
    "window_buffer",
    "without_region",
]
