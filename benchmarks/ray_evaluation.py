"""An evaluation on Ray's workers: episodes a second, bytes sent, kills; and what more would give.

python benchmarks/ray_evaluation.py <run folder>/policies/followed --episodes 100 --kills 10

The last table is a simulation, from the costs that one worker was measured to have.
"""

from __future__ import annotations

import argparse
import hashlib
import heapq
import json
import logging
import os
import random
import signal
import sys
import threading
import time
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from torchrl._utils import logger as torchrl_logger

from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.experiment import (
    HeldRows,
    PolicyFactory,
    RayEpisodes,
    TaskRows,
    saved_task,
    split_units,
)
from torchrl_rad.experiment.ray_episodes import require_ray

torchrl_logger.setLevel(logging.WARNING)
warnings.filterwarnings("ignore", category=FutureWarning)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Measures an evaluation on Ray's workers.")
    parser.add_argument("folder", help="policy folder, such as <run folder>/policies/followed")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--rows", type=int, default=10, help="episodes of a unit")
    parser.add_argument("--max-steps", type=int, help="of an episode; the task's own if left out")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--kills", type=int, default=10, help="of workers, in one more evaluation")
    parser.add_argument("--seed", type=int, default=10_000)
    parser.add_argument("--json", type=Path, help="file for the figures")
    return parser.parse_args()


def fingerprints(steps) -> list[str]:
    """Of each episode sha256 of all its states, actions and rewards."""
    keys = ("observation", "action", ("next", "observation"), ("next", "reward"))
    return [
        hashlib.sha256(b"".join(row[key].numpy().tobytes() for key in keys)).hexdigest()
        for row in steps.contiguous().unbind(0)
    ]


def alone(task, source: PolicyFactory, units, steps: int) -> dict[str, Any]:
    """This process: when environment and policy are there, and what an evaluation takes."""
    begin = time.perf_counter()
    policy = source()
    with closing(HeldRows(task)) as held:
        held(units[0])
        ready = time.perf_counter()
        episodes = held.drive(units, policy, steps, progress=False)
        end = time.perf_counter()
    return {"start_s": ready - begin, "drive_s": end - ready, "episodes": fingerprints(episodes)}


def on_ray(env: TaskRows, source: PolicyFactory, units, steps: int, workers: int, kills: int = 0):
    """The same on workers, some of which are killed at random times."""
    begin = time.perf_counter()
    with closing(RayEpisodes(env, source, workers, units[0].rows)) as episodes:
        ready, killed = time.perf_counter(), []
        stop = threading.Event()
        killer = threading.Thread(target=kill, args=(kills, killed, stop))
        killer.start()
        found = episodes.drive(units, source, steps, progress=False)
        end = time.perf_counter()
        stop.set()
        killer.join()
        serial = serial_seconds(episodes.collector.remote_collectors[0], found, units)
    figures = {"start_s": ready - begin, "drive_s": end - ready, "episodes": fingerprints(found)}
    answer = {"answer_bytes": answer_bytes(found, units), "serial_s": serial}
    return {**figures, "killed": len(killed), **answer}


def serial_seconds(worker, episodes, units, calls: int = 50) -> float:
    """Of the asking process for a unit: a call that does nothing, and unpickling an answer."""
    ray = require_ray()
    answer = ray.cloudpickle.dumps(episodes[: units[0].rows].clone())
    ray.get(worker.get_distant_attr.remote("n_env"))  # it may just be starting anew
    begin = time.perf_counter()
    for _ in range(calls):
        ray.get(worker.get_distant_attr.remote("n_env"))
        ray.cloudpickle.loads(answer)
    return (time.perf_counter() - begin) / calls


def kill(count: int, killed: list[int], stop: threading.Event) -> None:
    """Ends workers, one after another, at random times while they drive."""
    chance = random.Random(0)
    while len(killed) < count and not stop.wait(chance.uniform(1.0, 5.0)):
        alive = [pid for pid in worker_pids() if pid not in killed]
        if alive:
            killed.append(chance.choice(alive))
            os.kill(killed[-1], signal.SIGKILL)


def worker_pids() -> list[int]:
    """Of the collectors that have started."""
    actors = require_ray()._private.state.actors().values()
    return [actor["Pid"] for actor in actors if actor["State"] == "ALIVE" and actor["Pid"]]


def answer_bytes(episodes, units) -> int:
    """Of the answer to one unit, pickled."""
    return len(require_ray().cloudpickle.dumps(episodes[: units[0].rows].clone()))


def sent_bytes(env: TaskRows, source: PolicyFactory, units, steps: int) -> dict[str, int]:
    """What a worker is sent, and what it is not."""
    dumps = require_ray().cloudpickle.dumps
    folder = Path(source.folder)
    files = [path for path in (folder / "database").rglob("*") if path.is_file()]
    return {
        "to start a worker": len(dumps((env, source))),
        "for a unit": len(dumps((units[0], source, steps, torch.bfloat16, 1))),
        "weights, read from their file": (folder / "weights.safetensors").stat().st_size,
        "database, memory-mapped": sum(path.stat().st_size for path in files),
    }


def simulate(workers: int, units: int, unit_s: float, start_s: float, serial_s: float) -> float:
    """Seconds until all units are driven, by list scheduling.

    Workers start at the same time, drive equally fast, and wait for the asking process, which
    handles one answer after another.

    >>> simulate(2, units=4, unit_s=3.0, start_s=1.0, serial_s=0.0)
    7.0
    """
    free, asked = [start_s] * workers, 0.0
    for _ in range(units):
        done = heapq.heappop(free) + unit_s
        asked = max(asked, done) + serial_s
        heapq.heappush(free, asked)
    return max(free)


def table(columns: list[str], lines: list[list[Any]]) -> str:
    """Markdown."""
    rule = "|---" * len(columns) + "|"
    return "\n".join([table_line(columns), rule, *(table_line(one) for one in lines)])


def table_line(cells: list[Any]) -> str:
    """Of such a table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def line(name: str, run: dict[str, Any], expected: list[str], seconds: float) -> list[Any]:
    """Of the table of runs."""
    count, took = len(run["episodes"]), run["drive_s"]
    same = sum(a == b for a, b in zip(run["episodes"], expected, strict=True))
    rate, start = f"{count / took:.2f}", f"{run['start_s']:.1f}"
    return [name, start, f"{took:.1f}", rate, f"{seconds / took:.2f}", count, f"{same} of {count}"]


def print_simulation(run: dict[str, Any], arguments: argparse.Namespace, serial_s: float) -> None:
    """From one worker's costs what many of the same would give."""
    units = -(-arguments.episodes // arguments.rows)
    unit_s = run["drive_s"] / units - serial_s
    print(
        f"\nsimulated, not measured: 1000 episodes on workers with a core each, from one worker's "
        f"{run['start_s']:.1f} s to start, {unit_s:.2f} s a unit of {arguments.rows}, "
        f"{1e3 * serial_s:.1f} ms an answer in the asking process\n"
    )
    lines, one = [], None
    for workers in (1, 2, 4, 8, 16, 32, 64):
        took = simulate(workers, -(-1000 // arguments.rows), unit_s, run["start_s"], serial_s)
        one = one or took
        cells = (f"{took:.0f}", f"{1000 / took:.2f}", f"{one / took:.1f}")
        lines.append([workers, *cells])
    print(table(["workers", "s, with start", "episodes/s", "times as fast"], lines))


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    arguments = parse()
    torch.set_num_threads(1)
    try:
        require_ray()
        task = saved_task(arguments.folder)
        measure(arguments, task)
    except (CheckpointError, FileNotFoundError, ImportError, ValueError) as error:
        sys.exit(f"error: {error}")


def measure(arguments: argparse.Namespace, task) -> None:
    """Prints the tables."""
    folder = Path(arguments.folder).absolute()
    env = TaskRows(json.loads((folder / "policy.json").read_text())["env"])
    source, steps = PolicyFactory(str(folder)), arguments.max_steps or task.max_steps
    units = split_units(arguments.episodes, arguments.rows, arguments.seed)
    print(f"{task.name}, {arguments.episodes} episodes of {steps} steps in units of "
          f"{arguments.rows}, 1 thread a process, {os.cpu_count()} cores, load "
          f"{os.getloadavg()[1]:.1f} at the start\n")  # fmt: skip
    columns = ["who", "start s", "drive s", "episodes/s", "times as fast", "results", "the same"]
    print(table(columns, []))
    runs: dict[str, dict[str, Any]] = {}

    def note(name: str, run: dict[str, Any]) -> None:
        runs[name] = run
        expected, seconds = (runs["this process"][key] for key in ("episodes", "drive_s"))
        print(table_line(line(name, run, expected, seconds)), flush=True)

    note("this process", alone(task, source, units, steps))
    for workers in arguments.workers:
        note(f"ray, workers: {workers}", on_ray(env, source, units, steps, workers))
    if arguments.kills:
        run = on_ray(env, source, units, steps, max(arguments.workers), arguments.kills)
        note(f"the same, {run['killed']} of them killed", run)
    first = runs[f"ray, workers: {arguments.workers[0]}"]
    sent = {
        **sent_bytes(env, source, units, steps),
        "answer to a unit": first["answer_bytes"],
    }
    print("\n" + table(["bytes", "number"], [[name, f"{size:,}"] for name, size in sent.items()]))
    if arguments.workers[0] == 1:
        print_simulation(first, arguments, first["serial_s"])
    if arguments.json:
        arguments.json.write_text(json.dumps({"runs": runs, "bytes": sent}, indent=1) + "\n")


if __name__ == "__main__":
    main()
