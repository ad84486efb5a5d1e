"""Behaviour cloning for one goal, to compare with: TorchRL's BCLoss on the ways to that goal.

python recipes/behaviour_cloning.py medium --goal 3,4
"""

from __future__ import annotations

import argparse
import logging
import sys
import warnings

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl._utils import logger as torchrl_logger
from torchrl.modules import MLP
from torchrl.objectives import BCLoss
from tqdm import tqdm

from torchrl_rad import Normalizer, make_maze_env, maze_task, relabel_goal
from torchrl_rad.data import episode_lengths, return_to_go
from torchrl_rad.data.maze2d import maze_dataset
from torchrl_rad.envs import FixedGoalMaze
from torchrl_rad.envs.maze import maze_cell
from torchrl_rad.evaluation import episode_results, summarise
from torchrl_rad.experiment import collect_episodes
from torchrl_rad.results import format_table
from torchrl_rad.training import Objective

torchrl_logger.setLevel(logging.WARNING)
warnings.filterwarnings("ignore", "The name target_actor_network_params")  # of TorchRL's BCLoss


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Clones the ways to one goal.")
    parser.add_argument("maze", help="umaze, medium or large")
    parser.add_argument("--goal", type=maze_cell, metavar="ROW,COLUMN", help="in place of its own")
    parser.add_argument("--gradient-steps", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=300_000, help="recorded")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches")
    parser.add_argument("--threads", type=int, default=2)
    return parser.parse_args()


def ways_to(data: TensorDictBase, goal) -> TensorDictBase:
    """The recorded steps after which their episode visits the goal."""
    data = relabel_goal(data, goal)
    later = return_to_go(data["next", "reward"], episode_lengths(data), 1.0)
    if not (later > 0).any():
        raise ValueError("no recorded episode visits the goal; record more with --steps.")
    return data[later > 0]


def train(data: TensorDictBase, gradient_steps: int, seed: int) -> TensorDictSequential:
    """An MLP from state to action."""
    torch.manual_seed(seed)
    normalizer = Normalizer.of(data["observation"])
    network = MLP(data["observation"].shape[-1], data["action"].shape[-1], num_cells=[256, 256])
    head = torch.nn.Sequential(normalizer, network, torch.nn.Tanh())
    actor = TensorDictModule(head, ["observation"], ["action"])
    objective = Objective(
        BCLoss(actor, loss_function="l2"), lambda batch: batch, lr=1e-3, steps=gradient_steps
    )
    steps = data.select("observation", "action")
    for _ in tqdm(range(gradient_steps), desc="training", unit="step"):
        objective.update(steps[torch.randint(len(steps), (256,))])
    return TensorDictSequential(actor).requires_grad_(False)


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    arguments = parse()
    torch.set_num_threads(arguments.threads)
    try:
        task = maze_task(arguments.maze)
        env = make_maze_env(task, arguments.episodes, goal_cell=arguments.goal)
        goal = FixedGoalMaze(task, arguments.goal).goal
        data = ways_to(maze_dataset(task, steps=arguments.steps), goal)
        policy = train(data, arguments.gradient_steps, arguments.seed)
    except (KeyError, OSError, ValueError) as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")
    name = f"{task.name} {arguments.goal or task.goal_cell}"
    steps = collect_episodes(env, policy, task.max_steps, 10_000, name)
    row = summarise(episode_results(steps), task.normalised_score)
    print(f"{len(data)} steps on the way to {arguments.goal or task.goal_cell}")
    print(format_table({name: row}))
    print(f"\n{task.score_source}")


if __name__ == "__main__":
    main()
