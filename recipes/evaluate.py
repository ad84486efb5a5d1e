"""Scores a saved policy on its task, or on the way to other goals, for which nothing is trained.

python recipes/evaluate.py outputs/pointmaze-umaze/<run>/policies/followed --episodes 100
python recipes/evaluate.py outputs/pointmaze-umaze/<run>/policies/followed --backend ray --workers 4
python recipes/evaluate.py outputs/pointmaze-umaze/<run>/policies/followed --goals 3,1 1,3 3,3
"""

from __future__ import annotations

import argparse
import logging
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl._utils import logger as torchrl_logger

from torchrl_rad import ExpertDatabase, make_maze_env, with_goals
from torchrl_rad.checkpoint import CheckpointError, read_json
from torchrl_rad.envs.maze import maze_cell
from torchrl_rad.evaluation import episode_results
from torchrl_rad.experiment import (
    HeldRows,
    PolicyFactory,
    RayEpisodes,
    TaskRows,
    collect_episodes,
    collector_settings,
    make_data,
    make_database,
    policy_row,
    saved_maze,
    saved_task,
    split_units,
)
from torchrl_rad.plots import plot_followed
from torchrl_rad.policy import load_policy
from torchrl_rad.precision import planning_dtype
from torchrl_rad.provenance import write_provenance
from torchrl_rad.results import format_table
from torchrl_rad.runs import RunFolder

torchrl_logger.setLevel(logging.WARNING)

# for goals: with 0.8 a policy that overshoots may not find back, with 0.7 it looks around corners
THRESHOLD = 0.75


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Scores a saved policy.")
    parser.add_argument("folder", help="policy folder, such as <run folder>/policies/followed")
    parser.add_argument("--episodes", type=int, default=100, help="of each goal, one a row")
    parser.add_argument("--seed", type=int, default=10_000, help="of start states and noise")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--precision", default="auto", choices=("auto", "bf16", "fp16", "fp32"))
    parser.add_argument(
        "--goals",
        type=maze_cell,
        nargs="+",
        metavar="ROW,COLUMN",
        help="goal cells in place of its own",
    )
    parser.add_argument(
        "--database", help="folder of the demonstrations; with --goals all steps that the run "
        "recorded are searched by default"
    )  # fmt: skip
    parser.add_argument("--backend", default="direct", choices=("direct", "ray"), help="who drives")
    parser.add_argument("--workers", type=int, default=1, help="processes of --backend ray")
    parser.add_argument(
        "--rows",
        type=int,
        help="episodes of a unit of work; same rows, same results on any backend",
    )
    parser.add_argument("--csv", help="file for what was followed at each step")
    parser.add_argument("--picture", help="png of the longest way to the first goal")
    return parser.parse_args()


def recorded_steps(folder: Path, like: ExpertDatabase) -> ExpertDatabase:
    """All episodes that the policy's run recorded, searched as its own database is."""
    _, data = make_data(RunFolder.open(folder.absolute().parents[1]).config())
    # of more rows as many more, which lie in the same area: they have to reach across the goal
    k = round(like.sampler.k * len(data) / len(like))
    sampler = {**like.sampler.config, "k": k, "threshold": THRESHOLD}
    return make_database(data, {"gamma": like.gamma, "sampler": sampler})


def load(arguments: argparse.Namespace) -> TensorDictSequential:
    """The policy with the database and the goals asked for."""
    other = arguments.database and ExpertDatabase.loads(arguments.database)
    policy = load_policy(arguments.folder, other)
    if not arguments.goals:
        return policy
    if len(policy) == 1:  # without targets it goes the same way whatever the goal
        policy[-1].candidates = 1
        return policy
    database = other or recorded_steps(Path(arguments.folder), policy[0].database)
    return with_goals(policy, database)


def drive(arguments: argparse.Namespace, policy, task, collector) -> TensorDictBase:
    """The episodes of the task's own goal, by this process or by workers of Ray."""
    units = split_units(arguments.episodes, collector["rows"], arguments.seed)
    acting, rows = policy, HeldRows(task)
    if collector["backend"] == "ray":
        acting = PolicyFactory(*map(absolute, (arguments.folder, arguments.database)))
        env = TaskRows(read_json(Path(arguments.folder) / "policy.json")["env"])
        rows = RayEpisodes(env, acting, collector["workers"], units[0].rows)
    with closing(rows):
        dtype = planning_dtype(arguments.precision)
        return rows.drive(units, acting, task.max_steps, task.name, dtype)


def absolute(path: str | None) -> str | None:
    """A path as workers, which are in other folders, see it."""
    return None if path is None else str(Path(path).absolute())


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    arguments = parse()
    torch.set_num_threads(arguments.threads)
    goals, count = arguments.goals or [None], arguments.episodes
    try:
        settings = {name: getattr(arguments, name) for name in ("backend", "workers", "rows")}
        collector = collector_settings(settings)
        policy = load(arguments)
        needs_maze = arguments.goals or arguments.picture
        task = (saved_maze if needs_maze else saved_task)(arguments.folder)
        if count < 1:
            raise ValueError(f"--episodes is {count}; at least one is needed.")
        if len(policy) == 1 and (arguments.csv or arguments.picture):
            raise ValueError(f"the policy in {arguments.folder} retrieves nothing to write down.")
        if arguments.goals:
            if collector["backend"] == "ray" or collector["rows"] is not None:
                raise ValueError("--goals are driven by one process, all at once: leave --backend "
                                 "and --rows out.")  # fmt: skip
            cells = [goal for goal in goals for _ in range(count)]
            env = make_maze_env(task, len(cells), goal_cell=cells, show_goal=True)
            dtype = planning_dtype(arguments.precision)
            steps = collect_episodes(env, policy, task.max_steps, arguments.seed, task.name, dtype)
        else:
            steps = drive(arguments, policy, task, collector)
    except (CheckpointError, FileNotFoundError, ImportError, KeyError, ValueError) as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")
    names = [task.name if goal is None else f"{task.name} {goal}" for goal in goals]
    parts = dict(zip(names, steps.split(count), strict=True))
    print(format_table({name: policy_row(task, policy, part) for name, part in parts.items()}))
    print(f"\n{task.score_source}")
    if arguments.goals:
        print("these are of the task's own goal; plans were not ranked: the return model is of it")
    if arguments.csv:
        write_provenance(arguments.csv, steps)
    if arguments.picture:
        way = episode_results(steps[:count])["arrival"]
        longest = int(np.nan_to_num(way).argmax())
        plot_followed(task, steps, policy[0].database, longest, arguments.picture, goals[0])


if __name__ == "__main__":
    main()
