"""Starts with a few demonstrations and adds the policy's own good episodes; nothing is trained.

python recipes/growth.py outputs/pointmaze-medium/<run>/policies/followed --start 3 --rounds 20
python recipes/growth.py outputs/pointmaze-medium/<run>/policies/followed --start 1 3 10 --rounds 1
python recipes/growth.py outputs/pointmaze-medium/<run>/policies/followed --backend ray --workers 2
"""

from __future__ import annotations

import argparse
import logging
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl._utils import logger as torchrl_logger
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, reaches_goal
from torchrl_rad._files import staged_folder
from torchrl_rad.checkpoint import CheckpointError, read_json, write_json
from torchrl_rad.data import episode_lengths
from torchrl_rad.data.experts import select_episodes
from torchrl_rad.data.saved import database_stamp
from torchrl_rad.evaluation import episode_results, interval
from torchrl_rad.experiment import (
    HeldRows,
    PolicyFactory,
    RayEpisodes,
    TaskRows,
    collector_settings,
    make_data,
    saved_maze,
    split_units,
)
from torchrl_rad.plots import plot_growth
from torchrl_rad.policy import load_policy
from torchrl_rad.precision import planning_dtype
from torchrl_rad.provenance import demonstration_usage
from torchrl_rad.runs import RunFolder, environment_facts

torchrl_logger.setLevel(logging.WARNING)

COLUMNS = ("observation", "action", *(("next", name) for name in ("observation", "reward", "done")))
LINE = (
    "{seen:5d} seen, {demonstrations:4d} demonstrations: score {score:6.1f} +- {interval:4.1f}, "
    "{success:.2f} arriving, {found:.3f} found"
)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Lets a database grow by the policy's episodes.")
    parser.add_argument("folder", help="policy folder, such as <run folder>/policies/followed")
    parser.add_argument(
        "--start", type=int, nargs="+", default=[3], help="demonstrations to begin with"
    )
    parser.add_argument("--rounds", type=int, default=20, help="1: nothing is added")
    parser.add_argument("--rows", type=int, default=10, help="episodes of a round")
    parser.add_argument("--backend", default="direct", choices=("direct", "ray"), help="who drives")
    parser.add_argument("--workers", type=int, default=1, help="processes of --backend ray")
    parser.add_argument(
        "--unit", type=int, help="rows of a unit of work; same units, same results on any backend"
    )
    parser.add_argument("--capacity", type=int, default=200_000, help="rows; the worst give way")
    parser.add_argument(
        "--prune", action="store_true", help="a round more with the demonstrations of the last one"
    )
    parser.add_argument("--seed", type=int, default=0, help="of demonstrations, starts and noise")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", default="growth", help="folder of results; a run goes on there")
    return parser.parse_args()


def demonstrations(data: TensorDictBase, seed: int) -> list[TensorDictBase]:
    """The recorded episodes that reach the goal, in the order in which they are given out."""
    episodes = data.select(*COLUMNS).split(episode_lengths(data).tolist())
    good = select_episodes(reaches_goal(), episodes).nonzero()[:, 0]
    order = torch.randperm(len(good), generator=torch.Generator().manual_seed(seed))
    return [episodes[i] for i in good[order].tolist()]


def database_of(
    episodes: list[TensorDictBase], like: ExpertDatabase, capacity: int
) -> ExpertDatabase:
    """A database of some episodes, searched as another is."""
    database = ExpertDatabase(
        LazyTensorStorage(capacity),
        like.gamma,
        reaches_goal(),
        RetrievalSampler(**like.sampler.config),
        evict="lowest_return",
    )
    database.extend(torch.cat(episodes))
    return database


def add(database: ExpertDatabase, steps: TensorDictBase) -> None:
    """Adds those episodes of an evaluation [n, T] that reached the goal."""
    reached = (steps["next", "reward"] > 0).any(1).squeeze(-1)
    if reached.any():
        database.extend(steps[reached].select(*COLUMNS).reshape(-1))


def figures(task, steps: TensorDictBase, held: int) -> dict[str, Any]:
    """Of the episodes of a round, driven with ``held`` demonstrations."""
    results = episode_results(steps)
    scores = task.normalised_score(results["return"])
    mean, half = interval(scores)
    return {
        "demonstrations": held,
        "scores": scores.tolist(),
        "score": mean,
        "interval": half,
        "success": float(results["success"].mean()),
        "found": float(results["found"].mean()),
        "followed": [used["episode"] for used in demonstration_usage(steps)],
    }


class Rounds:
    """Drives rounds of a policy whose database lies in a folder: here, or on Ray's workers.

    Workers open the rows in the folder anew when these have changed.
    """

    def __init__(self, arguments: argparse.Namespace, task, collector: dict[str, Any]):
        self.rows, self.task, self.unit = arguments.rows, task, collector["rows"]
        self.policy = str(Path(arguments.folder).absolute()) if on_ray(collector) else None
        self.workers, self.episodes = collector["workers"], None if self.policy else HeldRows(task)

    def __call__(self, policy, folder: Path, seed: int, name: str) -> TensorDictBase:
        """The episodes [rows, T] of a round."""
        units, acting = split_units(self.rows, self.unit, seed), policy
        if self.policy is not None:
            database = folder.absolute() / "database"
            acting = PolicyFactory(self.policy, str(database), database_stamp(database))
        if self.episodes is None:
            env = TaskRows(read_json(Path(self.policy) / "policy.json")["env"])
            self.episodes = RayEpisodes(env, acting, self.workers, units[0].rows)
        return self.episodes.drive(units, acting, self.task.max_steps, name, planning_dtype())

    def close(self) -> None:
        """Ends environments and workers."""
        if self.episodes is not None:
            self.episodes.close()


def on_ray(collector: dict[str, Any]) -> bool:
    """Whether Ray's workers drive."""
    return collector["backend"] == "ray"


def grow(
    arguments: argparse.Namespace, policy, drive: Rounds, folder: Path
) -> list[dict[str, Any]]:
    """Acts and adds, round by round; goes on after the rounds that the folder holds."""
    database, rounds = policy[0].database, read_rounds(folder)
    for number in range(len(rounds), arguments.rounds + arguments.prune):
        pruned = number == arguments.rounds
        if pruned:
            database.keep(rounds[-1]["followed"])
            print("only those that were followed in the last round:", flush=True)
        if pruned or not folder.exists():
            save(folder, database, rounds)  # from where workers read it
        seed = 10_000 + arguments.seed + number  # other start states each time
        held = len(database[:]["episode"].unique())
        steps = drive(policy, folder, seed, f"{held} demonstrations")
        about = {"seen": number * arguments.rows, "pruned": pruned}
        rounds.append({**about, **figures(drive.task, steps, held)})
        print(LINE.format(**rounds[-1]), flush=True)
        add(database, steps)
        save(folder, database, rounds)
    return rounds


def save(folder: Path, database: ExpertDatabase, rounds: list[dict[str, Any]]) -> None:
    """Database and rounds, both or none."""
    with staged_folder(folder, replace=True) as stage:
        database.dumps(stage / "database")
        write_json(stage / "rounds.json", rounds)


def read_rounds(folder: Path) -> list[dict[str, Any]]:
    """What was done before."""
    return read_json(folder / "rounds.json") if folder.exists() else []


def prepare(
    arguments: argparse.Namespace, folder: Path, unit: int | None
) -> list[tuple[TensorDictSequential, Path]]:
    """For each size to begin with the policy, with its database, and where its rounds are kept."""
    if min(arguments.rows, arguments.rounds) < 1:
        raise ValueError("--rows and --rounds are at least 1.")
    out = Path(arguments.out)
    settings = {name: getattr(arguments, name) for name in ("rows", "capacity", "seed")}
    if unit is not None:
        settings["unit"] = unit
    out.mkdir(parents=True, exist_ok=True)
    about = out / "settings.json"
    if about.exists() and read_json(about) != settings:
        raise ValueError(f"{out} is of a run with {read_json(about)}; pass another --out.")
    _, data = make_data(RunFolder.open(folder.parents[1]).config())
    good = demonstrations(data, arguments.seed)
    like, prepared = ExpertDatabase.loads(folder / "database", memmap=True), []
    for count in arguments.start:
        if not 0 < count <= len(good):
            raise ValueError(
                f"--start is {count}; there are {len(good)} demonstrations of the goal."
            )
        kept = out / f"start-{count}"
        if kept.exists():
            database = ExpertDatabase.loads(kept / "database")
        else:
            database = database_of(good[:count], like, arguments.capacity)
        prepared.append((load_policy(folder, database).requires_grad_(False), kept))
    write_json(about, settings)
    return prepared


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    arguments = parse()
    torch.set_num_threads(arguments.threads)
    folder, out = Path(arguments.folder).absolute(), Path(arguments.out)
    settings = {"backend": arguments.backend, "workers": arguments.workers, "rows": arguments.unit}
    runs = {}
    try:
        collector = collector_settings(settings)
        task = saved_maze(folder)  # first: no policy is said before no run is
        prepared = prepare(arguments, folder, collector["rows"])
        with closing(Rounds(arguments, task, collector)) as drive:
            for count, (policy, kept) in zip(arguments.start, prepared, strict=True):
                runs[count] = grow(arguments, policy, drive, kept)
    except (CheckpointError, ImportError, OSError, KeyError, ValueError) as error:
        sys.exit(f"error: {error.args[0] if isinstance(error, KeyError) else error}")
    write_json(out / "results.json", {"runs": runs, **vars(arguments), **environment_facts()})
    plot_growth(runs, out / "growth.png")
    print(f"\n{out / 'results.json'}, {out / 'growth.png'}")


if __name__ == "__main__":
    main()
