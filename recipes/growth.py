"""Starts with a few demonstrations and adds the policy's own good episodes; nothing is trained.

python recipes/growth.py outputs/pointmaze-medium/<run>/policies/followed --start 3 --rounds 20
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl._utils import logger as torchrl_logger
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, make_maze_env, maze_task, reaches_goal
from torchrl_rad.checkpoint import CheckpointError, read_json, write_json
from torchrl_rad.data import episode_lengths
from torchrl_rad.data.experts import select_episodes
from torchrl_rad.evaluation import episode_results
from torchrl_rad.experiment import collect_episodes, make_data
from torchrl_rad.plots import plot_growth
from torchrl_rad.policy import load_policy
from torchrl_rad.precision import planning_dtype
from torchrl_rad.runs import RunFolder, environment_facts

torchrl_logger.setLevel(logging.WARNING)

COLUMNS = ("observation", "action", *(("next", name) for name in ("observation", "reward", "done")))
LINE = (
    "{seen:5d} seen, {demonstrations:4d} demonstrations: score {score:6.1f}, {success:.2f} "
    "arriving, {found:.3f} found"
)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Lets a database grow by the policy's episodes.")
    parser.add_argument("folder", help="policy folder, such as <run folder>/policies/followed")
    parser.add_argument("--start", type=int, default=3, help="demonstrations to begin with")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--rows", type=int, default=10, help="episodes of a round")
    parser.add_argument("--capacity", type=int, default=200_000, help="rows; the worst give way")
    parser.add_argument("--seed", type=int, default=0, help="of demonstrations, starts and noise")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", default="growth", help="folder for results.json and growth.png")
    return parser.parse_args()


def first_demonstrations(
    data: TensorDictBase, like: ExpertDatabase, count: int, capacity: int, seed: int
) -> ExpertDatabase:
    """A database of some of the recorded episodes that reach the goal, searched as another is."""
    episodes = data.select(*COLUMNS).split(episode_lengths(data).tolist())
    good = select_episodes(reaches_goal(), episodes).nonzero()[:, 0]
    if not 0 < count <= len(good):
        raise ValueError(f"--start is {count}; there are {len(good)} demonstrations of the goal.")
    order = torch.randperm(len(good), generator=torch.Generator().manual_seed(seed))
    database = ExpertDatabase(
        LazyTensorStorage(capacity),
        like.gamma,
        reaches_goal(),
        RetrievalSampler(**like.sampler.config),
        evict="lowest_return",
    )
    database.extend(torch.cat([episodes[i] for i in good[order[:count]].tolist()]))
    return database


def add(database: ExpertDatabase, steps: TensorDictBase) -> None:
    """Adds those episodes of an evaluation [n, T] that reached the goal."""
    reached = (steps["next", "reward"] > 0).any(1).squeeze(-1)
    if reached.any():
        database.extend(steps[reached].select(*COLUMNS).reshape(-1))


def grow(arguments: argparse.Namespace, policy, database, task) -> list[dict[str, Any]]:
    """Acts and adds, round by round: figures of each."""
    env, rounds = make_maze_env(task, arguments.rows), []
    for number in range(arguments.rounds):
        begin, episodes = time.perf_counter(), len(database[:]["episode"].unique())
        seed = 10_000 + arguments.seed + number  # other start states each time
        name = f"round {number + 1}, {episodes} demonstrations"
        steps = collect_episodes(env, policy, task.max_steps, seed, name, planning_dtype())
        results = episode_results(steps)
        scores = task.normalised_score(results["return"]).tolist()
        add(database, steps)
        rounds.append(
            {
                "seen": number * arguments.rows,
                "demonstrations": episodes,
                "scores": scores,
                "score": sum(scores) / len(scores),
                "success": float(results["success"].mean()),
                "found": float(results["found"].mean()),
                "seconds": time.perf_counter() - begin,
            }
        )
        print(LINE.format(**rounds[-1]), flush=True)
    env.close()
    return rounds


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    arguments = parse()
    torch.set_num_threads(arguments.threads)
    folder, out = Path(arguments.folder).absolute(), Path(arguments.out)
    try:
        task = maze_task(read_json(folder / "policy.json")["maze"])
        if min(arguments.rows, arguments.rounds) < 1:
            raise ValueError("--rows and --rounds are at least 1.")
        like = ExpertDatabase.loads(folder / "database", memmap=True)
        _, data = make_data(RunFolder.open(folder.parents[1]).config())
        chosen = (arguments.start, arguments.capacity, arguments.seed)
        database = first_demonstrations(data, like, *chosen)
        policy = load_policy(folder, database).requires_grad_(False)
        out.mkdir(parents=True, exist_ok=True)
    except (CheckpointError, OSError, KeyError, ValueError) as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")
    rounds = grow(arguments, policy, database, task)
    facts = {"settings": vars(arguments), **environment_facts()}
    write_json(out / "results.json", {"rounds": rounds, **facts})
    plot_growth(rounds, out / "growth.png")
    print(f"\n{out / 'results.json'}, {out / 'growth.png'}")


if __name__ == "__main__":
    main()
