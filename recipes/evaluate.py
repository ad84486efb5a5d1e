"""Scores a saved policy on its task.

python recipes/evaluate.py outputs/pointmaze-umaze/<run>/policies/followed --episodes 100
"""

from __future__ import annotations

import argparse
import logging
import sys

import torch
from torchrl._utils import logger as torchrl_logger

from torchrl_rad import make_maze_env, maze_task
from torchrl_rad.checkpoint import CheckpointError, read_json
from torchrl_rad.experiment import collect_episodes, policy_row
from torchrl_rad.policy import load_policy
from torchrl_rad.precision import planning_dtype
from torchrl_rad.results import format_table, score_source

torchrl_logger.setLevel(logging.WARNING)


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    parser = argparse.ArgumentParser(description="Scores a saved policy on its task.")
    parser.add_argument("folder", help="policy folder, such as <run folder>/policies/followed")
    parser.add_argument("--episodes", type=int, default=100, help="rows, one episode each")
    parser.add_argument("--seed", type=int, default=10_000, help="of start states and noise")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--precision", default="auto", choices=("auto", "bf16", "fp16", "fp32"))
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    try:
        policy = load_policy(arguments.folder)
        task = maze_task(read_json(f"{arguments.folder}/policy.json")["maze"])
        if arguments.episodes < 1:
            raise ValueError(f"--episodes is {arguments.episodes}; at least one is needed.")
    except (CheckpointError, FileNotFoundError, KeyError, ValueError) as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")
    env = make_maze_env(task, arguments.episodes)
    dtype = planning_dtype(arguments.precision)
    steps = collect_episodes(env, policy, task.max_steps, arguments.seed, task.name, dtype)
    print(format_table({task.name: policy_row(task, policy, steps)}))
    print(f"\n{score_source(task)}")


if __name__ == "__main__":
    main()
