"""When a target helps: starts at places that the demonstrations do not cover, with and without.

python recipes/fallback.py outputs/pointmaze-medium/<run>/policies/followed --without 1,1 1,2 2,1
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl._utils import logger as torchrl_logger

from torchrl_rad import (
    ExpertDatabase,
    RetrievalSampler,
    reaches_goal,
    similarity_threshold,
)
from torchrl_rad.checkpoint import CheckpointError, write_json
from torchrl_rad.data import episode_lengths
from torchrl_rad.data.experts import select_episodes
from torchrl_rad.data.regions import enters_region
from torchrl_rad.envs import FixedGoalMaze
from torchrl_rad.envs.maze import maze_cell
from torchrl_rad.evaluation import episode_results, interval
from torchrl_rad.experiment import collect_episodes, make_data, make_database, saved_maze
from torchrl_rad.policy import load_policy
from torchrl_rad.precision import planning_dtype
from torchrl_rad.runs import RunFolder, environment_facts

torchrl_logger.setLevel(logging.WARNING)

BINS = (0.0, 0.1, 0.25, 0.5, 1.0, np.inf)  # of the distance to the nearest demonstration


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Scores starts off the data.")
    parser.add_argument("folder", help="policy folder, such as <run folder>/policies/followed")
    parser.add_argument(
        "--without", type=maze_cell, nargs="+", metavar="ROW,COLUMN", required=True,
        help="cells that no demonstration enters",
    )  # fmt: skip
    parser.add_argument("--episodes", type=int, default=4, help="of each start cell")
    parser.add_argument("--level", type=float, default=0.05, help="of the conformal quantile")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", default="fallback.json")
    return parser.parse_args()


def demonstrations(data: TensorDictBase, centres: torch.Tensor, half_width: float):
    """Steps of the recorded episodes that reach the goal and do not enter some cells."""
    gone = enters_region(data, centres, half_width)
    lengths = episode_lengths(data)
    reaches = select_episodes(reaches_goal(), data.split(lengths.tolist()))
    if not (reaches & ~gone).any():
        raise ValueError("no demonstration is left that enters none of these cells.")
    return data[torch.repeat_interleave(reaches & ~gone, lengths)]


def database_of(steps: TensorDictBase, like: ExpertDatabase, threshold: float) -> ExpertDatabase:
    """Demonstrations searched as another database is, with another threshold."""
    sampler = {**like.sampler.config, "threshold": threshold}
    return make_database(steps, {"gamma": like.gamma, "sampler": sampler})


def drive(arguments, task, policy, cells: list[tuple[int, int]], seed: int, name: str):
    """An episode from each cell, so many times."""
    policy[-1].candidates = 1
    starts = [cell for cell in cells for _ in range(arguments.episodes)]
    env = task.make_env(len(starts), starts=starts)
    torch.set_num_threads(arguments.threads)
    steps = collect_episodes(env, policy, task.max_steps, seed, name, planning_dtype())
    env.close()
    torch.set_num_threads(arguments.threads)
    return steps


def calibrated(arguments, task, folder: Path, database: ExpertDatabase, cells) -> float:
    """The threshold by the policy's own good episodes, in which it never fell back."""
    policy = load_policy(folder, database)
    steps = drive(arguments, task, policy, cells, 20_000 + arguments.seed, "to calibrate")
    good = steps[torch.from_numpy(episode_results(steps)["success"] > 0)]
    good = good.select("observation", ("next", "reward"), ("next", "done"))
    return similarity_threshold(database, good.reshape(-1), arguments.level, arguments.seed)


def figures(task, steps: TensorDictBase, distance: np.ndarray) -> list[dict[str, Any]]:
    """Score and fallback rate by the distance of start states from the demonstrations."""
    results = episode_results(steps)
    scores = task.normalised_score(results["return"])
    rows = []
    for low, high in zip(BINS, BINS[1:], strict=False):
        here = (distance >= low) & (distance < high)
        if here.any():
            mean, half = interval(scores[here])
            rows.append(
                {
                    "distance": [low, None if np.isinf(high) else high],
                    "episodes": int(here.sum()),
                    "fallback": float(1 - results["found"][here].mean()),
                    "start_fallback": float((~steps["found"][here, 0]).float().mean()),
                    "success": float(results["success"][here].mean()),
                    "score": mean,
                    "interval": half,
                }
            )
    return rows


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    arguments = parse()
    torch.set_num_threads(arguments.threads)
    folder = Path(arguments.folder).absolute()
    try:
        task = saved_maze(folder)
        _, data = make_data(RunFolder.open(folder.parents[1]).config())
        like = ExpertDatabase.loads(folder / "database", memmap=True)
        region = task.cells(arguments.without)
        if not 0.0 < arguments.level < 1.0:
            raise ValueError(f"--level is {arguments.level}; expected a share between 0 and 1.")
        if arguments.episodes < 1:
            raise ValueError(f"--episodes is {arguments.episodes}; at least one is needed.")
        data = demonstrations(data, *region)
        always = database_of(data, like, 0.0)
    except (CheckpointError, OSError, KeyError, ValueError) as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")
    maze = FixedGoalMaze(task)
    cells = [tuple(cell) for cell in maze.free_cells.tolist()]
    maze.close()
    covered = [cell for cell in cells if cell not in arguments.without]
    threshold = calibrated(arguments, task, folder, always, covered)
    print(f"calibrated at level {arguments.level}: similarity {threshold:.3f}")
    databases = {
        "a target always": always,
        "calibrated": database_of(data, like, threshold),
        "no target": ExpertDatabase(sampler=RetrievalSampler(**like.sampler.config)),
    }
    table, distance = {}, None
    for name, database in databases.items():
        policy = load_policy(folder, database)
        steps = drive(arguments, task, policy, cells, 30_000 + arguments.seed, name)
        if distance is None:  # the starts are the same in each
            starts = steps["observation"][:, 0]
            distance = (1 / always.sampler.nearest(always.storage, starts, 1)[1] - 1)[:, 0].numpy()
        table[name] = figures(task, steps, distance)
        for row in table[name]:
            print(name, row, flush=True)
    about = {"threshold": threshold, **vars(arguments), **environment_facts()}
    write_json(arguments.out, {"rows": table, **about})


if __name__ == "__main__":
    main()
