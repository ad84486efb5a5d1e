"""A database beyond memory: built in a stream, asked, and compared with a scan of all rows.

``python benchmarks/sharded.py --rows 20_000_000 --folder <where there is room>`` prints one JSON
object a stage. Each stage is a process of its own, so that its peak of memory is its own:
``anonymous`` cannot be given back, ``resident`` counts pages of the files that happen to be cached.
Where the machine is shared, CPU time says more than time on the clock.
"""

from __future__ import annotations

import argparse
import json
import logging
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import torch
from tensordict import TensorDict
from torchrl._utils import logger as torchrl_logger

from torchrl_rad import RetrievalSampler, RetrievalTargetModule, ShardedExpertDatabase

torchrl_logger.setLevel(logging.WARNING)

DIMS = 29
EPISODE = 1000  # steps
CHUNK = 200  # episodes that are made at a time
BOX, STEP = 6.0, 0.05  # side of the space walked in; of a walk, in each dim
GAMMA, K, THRESHOLD, AHEAD = 0.97, 500, 0.8, 16
ORACLE = 24  # queries compared with a scan


def walks(seed: int, episodes: int) -> torch.Tensor:
    """Random walks [episodes, EPISODE, DIMS] of small steps, reflected by the box."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.randn(episodes, EPISODE, DIMS, generator=generator).mul_(STEP)
    states[:, 0] = BOX * torch.rand(episodes, DIMS, generator=generator)
    return states.cumsum(1).remainder_(2 * BOX).sub_(BOX).abs_().neg_().add_(BOX)


def rewards(states: torch.Tensor) -> torch.Tensor:
    """One for each step in a corner of the box."""
    return (states[..., :2].amax(-1) < 0.5).float()


def chunks(rows: int):
    """Episodes of the whole data set [E, EPISODE, DIMS], always the same."""
    left = rows // EPISODE
    for seed in range(-(-left // CHUNK)):
        yield walks(seed, min(CHUNK, left - seed * CHUNK))


def driven(calls: int, batch: int) -> torch.Tensor:
    """Consecutive states [calls, batch, DIMS] of walks that are not in the database."""
    return walks(10**6 + batch, batch)[:, :calls].transpose(0, 1).contiguous()


# stages


def build(folder: Path, rows: int, rows_per_shard: int) -> dict:
    sampler = RetrievalSampler("euclidean", [0, 1], K, THRESHOLD)
    database = ShardedExpertDatabase.create(
        folder, GAMMA, sampler=sampler, rows_per_shard=rows_per_shard
    )
    spent: list[float] = []
    for states in timed(chunks(rows), spent):
        count = states[..., 0].numel()
        done = torch.zeros(count, 1, dtype=torch.bool)
        done[EPISODE - 1 :: EPISODE] = True
        end = {"reward": rewards(states).reshape(-1, 1), "done": done}
        database.extend(TensorDict({"observation": states.flatten(0, 1), "next": end}, [count]))
    database.flush()
    return {"rows": len(database), "shards": len(database.shards), "making_data_s": sum(spent)}


def timed(iterator, spent: list[float]):
    """The same, with the seconds that each item took to make."""
    while True:
        begin = perf_counter()
        item = next(iterator, None)
        spent.append(perf_counter() - begin)
        if item is None:
            return
        yield item


def ask(folder: Path, calls: int) -> dict:
    begin = perf_counter()
    database = ShardedExpertDatabase.loads(folder)
    select = RetrievalTargetModule(database, rule="followed", ahead=AHEAD)
    opened = perf_counter() - begin
    results: dict = {"open_s": opened}
    for batch in (1, 128):
        states = driven(min(EPISODE, calls), batch)
        times, works, shares = [], [], []
        for state in states if batch == 1 else states[: max(5, calls // 5)]:
            begin, work = perf_counter(), process_time()
            out = select(TensorDict({"observation": state}, [batch]))
            times.append(1e3 * (perf_counter() - begin))
            works.append(1e3 * (process_time() - work))
            shares.append(float(out["found"].float().mean()))
        if batch == 1:  # the first call makes the search structures
            results["first_query_s"], results["first_query_cpu_s"] = times[0] / 1e3, works[0] / 1e3
            times, works = times[1:], works[1:]
        results[f"batch_{batch}"] = {
            "calls": len(times),
            "found": float(np.mean(shares)),
            "ms": dict(zip(("p50", "p95"), np.percentile(times, [50, 95]), strict=True)),
            "cpu_ms": dict(zip(("p50", "p95"), np.percentile(works, [50, 95]), strict=True)),
        }
    return results


def compare(folder: Path, rows: int) -> dict:
    """Rows chosen against those of a scan of the data set, made anew."""
    states = walks(10**6, ORACLE)[:, EPISODE // 2]
    select = RetrievalTargetModule(
        ShardedExpertDatabase.loads(folder),
        rule="followed",
        ahead=AHEAD,
        out_keys=["target", "found", "similarity", "target_return", "target_index", "offset"],
    )
    out = select(TensorDict({"observation": states}, [ORACLE]))
    truth = scanned(rows, states.double().numpy())
    same = [
        (out["target_index"][i].item(), out["offset"][i].item(), out["similarity"][i].item())
        == (target, target - anchor, float(np.float32(near)))
        if out["found"][i]
        else target == -1
        for i, (target, anchor, near) in enumerate(truth)
    ]
    return {"queries": ORACLE, "equal": sum(same)}


def scanned(rows: int, queries: np.ndarray) -> list[tuple[int, int, float]]:
    """Target, neighbour and its similarity for each query, by looking at every row."""
    best = [np.empty((4, 0)) for _ in queries]  # similarity, row, return, target
    first = 0
    for states in chunks(rows):
        value = returns(rewards(states).double().numpy())
        flat = states.double().flatten(0, 1).numpy()
        for number, query in enumerate(queries):
            square = (flat[:, 0] - query[0]) ** 2 + (flat[:, 1] - query[1]) ** 2
            near = 1.0 / (1.0 + np.sqrt(square))
            least = np.partition(near, -K)[-K]
            row = np.flatnonzero((near >= least) & (near >= THRESHOLD))
            target = row + [ahead_of(value, i) for i in row]
            found = np.stack([near[row], row + first, value.reshape(-1)[row], target + first])
            found = np.concatenate([best[number], found], 1)
            best[number] = found[:, np.lexsort((found[1], -found[0]))[:K]]
        first += len(flat)
    none = np.array([[0.0], [-1], [-np.inf], [-1]])  # where there is no neighbour
    best = [np.concatenate([found, none], 1) for found in best]
    chosen = [found[:, np.lexsort((found[1], -found[0], -found[2]))[0]] for found in best]
    return [(int(target), int(row), near) for near, row, _, target in chosen]


def returns(reward: np.ndarray) -> np.ndarray:
    """Returns float32 [E, T], summed backwards in float64."""
    out, value = np.empty(reward.shape, np.float32), np.zeros(len(reward))
    for step in range(reward.shape[1] - 1, -1, -1):
        value = reward[:, step] + GAMMA * value
        out[:, step] = value
    return out


def ahead_of(value: np.ndarray, row: int) -> int:
    """How far ahead of a row the best of the next ones of its episode is."""
    episode, step = divmod(row, EPISODE)
    return int(value[episode, step : step + AHEAD + 1].argmax())


# measuring


def status(name: str) -> float:
    """A line of /proc/self/status, in MB."""
    text = Path("/proc/self/status").read_text()
    return int(text.split(f"{name}:")[1].split()[0]) / 1e3


def measured(stage, *args) -> dict:
    """What a stage gives, with its time and its peak of memory, sampled every 20 ms."""
    peak, going = [status("RssAnon")], threading.Event()

    def watch():
        while not going.wait(0.02):
            peak[0] = max(peak[0], status("RssAnon"))

    before = status("RssAnon")
    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    begin, work = perf_counter(), process_time()
    result = stage(*args)
    seconds = {"seconds": perf_counter() - begin, "cpu_seconds": process_time() - work}
    going.set()
    memory = {"before": before, "anonymous": peak[0], "resident": status("VmHWM")}
    return {"stage": stage.__name__, **seconds, **result, "peak_MB": memory}


def main(given: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument("--rows-per-shard", type=int, default=1_000_000)
    parser.add_argument("--calls", type=int, default=200)
    parser.add_argument("--folder", type=Path, help="removed afterwards; a temporary one if none")
    parser.add_argument("--stage", choices=("build", "ask", "compare"), help="one of them, here")
    options = parser.parse_args(given)
    torch.set_num_threads(1)
    if options.stage is not None:
        stages = {
            "build": (build, options.rows, options.rows_per_shard),
            "ask": (ask, options.calls),
            "compare": (compare, options.rows),
        }
        stage, *rest = stages[options.stage]
        print(json.dumps(measured(stage, options.folder, *rest)))
        return
    folder = options.folder or Path(tempfile.mkdtemp()) / "database"
    try:
        for stage in ("build", "ask", "compare"):
            command = [sys.executable, __file__, "--stage", stage, "--folder", str(folder)]
            command += ["--rows", str(options.rows), "--calls", str(options.calls)]
            command += ["--rows-per-shard", str(options.rows_per_shard)]
            subprocess.run(command, check=True)
        files = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        print(json.dumps({"disk_MB": files / 1e6}))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
