"""Workers of TorchRL's Ray collector: the same episodes, each once, whoever dies."""

from __future__ import annotations

import dataclasses
import gc
import os
import pickle
import signal
import threading
import time
from functools import partial

import pytest
import torch
from torchrl.collectors.distributed import RayCollector
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase
from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.data.saved import database_stamp
from torchrl_rad.experiment import (
    PolicyFactory,
    RayEpisodes,
    TaskRows,
    split_units,
)

from ..saved_policy import ENV

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")
ROWS, STEPS, SEED = 2, 30, 7
TASK = TaskRows(ENV)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def two(ray, folder):
    """Two workers."""
    workers = RayEpisodes(TASK, PolicyFactory(str(folder)), workers=2, unit_rows=ROWS)
    yield workers
    workers.close()


def here(source, units, steps=STEPS):
    """The episodes of units, driven by this process."""
    held = TASK.open()
    episodes = held.drive(units, source(), steps, progress=False)
    held.close()
    return episodes


def there(workers, source, units, steps=STEPS):
    return workers.drive(units, source, steps, progress=False)


def alive(ray):
    """Process ids of the workers that have started."""
    actors = ray._private.state.actors().values()
    return [a["Pid"] for a in actors if a["State"] == "ALIVE" and a["Pid"]]


def collectors():
    """How many Ray collectors there are."""
    return sum(type(thing) is RayCollector for thing in gc.get_objects())


def test_same_episodes_as_in_one_process(two, folder):
    source, units = PolicyFactory(str(folder)), split_units(5, ROWS, SEED)
    episodes = there(two, source, units)
    assert (episodes == here(source, units)).all()
    assert (episodes[[4, 2, 3, 0, 1]] == there(two, source, units[::-1])).all()
    assert not torch.equal(episodes["action"][0], episodes["action"][2])


def test_one_worker(ray, folder, two):
    source, units = PolicyFactory(str(folder)), split_units(5, ROWS, SEED)
    expected = there(two, source, units)
    pids = alive(ray)
    assert len(pids) == 2
    os.kill(pids[0], signal.SIGKILL)  # the other drives all
    assert (there(two, source, units) == expected).all()


def test_killed_workers(ray, two, folder):
    source, units = PolicyFactory(str(folder)), split_units(24, ROWS, SEED)
    expected = here(source, units)
    killed = []

    def kill():
        for _ in range(2):
            time.sleep(0.5)
            if pids := alive(ray):
                killed.append(pids[0])
                os.kill(pids[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    episodes = there(two, source, units)
    killer.join()
    assert killed and len(episodes) == 24
    assert (episodes == expected).all()


def test_a_database_that_grows(ray, two, folder, tmp_path):
    database = ExpertDatabase.loads(folder / "database")
    first, units = tmp_path / "database", split_units(4, ROWS, SEED)
    database.dumps(first)
    before = PolicyFactory(str(folder), str(first), database_stamp(first))
    steps = there(two, before, units)
    assert (steps == there(two, PolicyFactory(str(folder)), units)).all()

    only = int(database[:]["episode"][0])
    database.keep([only])
    database.dumps(first)
    after = dataclasses.replace(before, stamp=database_stamp(first))
    grown = there(two, after, units)
    assert (grown == here(after, units)).all()
    sources = grown["target_source"][..., 0]
    assert set(sources.unique().tolist()) <= {-1, only}
    # a worker that starts anew reads what is there now
    os.kill(alive(ray)[0], signal.SIGKILL)
    assert (there(two, after, units) == grown).all()
    with pytest.raises(CheckpointError, match="sees another content of .* its stamp is"):
        two.drive(units, before, STEPS, progress=False)


def test_what_a_worker_refuses(two, folder, tmp_path):
    source, units = PolicyFactory(str(folder)), split_units(2, ROWS, SEED)
    unseen = PolicyFactory(str(tmp_path / "policy"))
    with pytest.raises(FileNotFoundError, match=r"a worker on .* does not see .*policy. Put it"):
        two.drive(units, unseen, STEPS, progress=False)
    other = dataclasses.replace(source, versions={**source.versions, "torchrl_rad": "9.9"})
    with pytest.raises(CheckpointError, match=r"has torchrl_rad .*, but .* has torchrl_rad 9\.9;"):
        two.drive(units, other, STEPS, progress=False)
    # the workers go on
    assert len(there(two, source, units)) == 2


def test_a_worker_that_cannot_start(ray, tmp_path):
    unseen = PolicyFactory(str(tmp_path / "policy"))
    before = collectors()
    with pytest.raises(CheckpointError, match="lost for good: FileNotFoundError: a worker on") as e:
        RayEpisodes(TASK, unseen, workers=1, unit_rows=ROWS)
    assert ray.is_initialized()
    # one left over would start Ray anew when it is collected after Ray's end
    assert e.tb is not None and collectors() == before


def test_more_workers_than_cpus(ray, folder):
    source = PolicyFactory(str(folder))
    with pytest.raises(ValueError, match="collector.workers is 4, but Ray has 3 CPUs"):
        RayEpisodes(TASK, source, workers=4, unit_rows=ROWS)
    with pytest.raises(ValueError, match="collector.workers is 0"):
        RayEpisodes(TASK, source, workers=0, unit_rows=ROWS)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_torchrl_s_own_collector_fills_a_database(ray, folder):
    collector = RayCollector(
        [partial(TASK.task().make_env, 1)],
        policy_factory=[PolicyFactory(str(folder))],
        collector_kwargs={"trust_policy": True, "traj_format": "cat"},
        trajs_per_batch=1,
        frames_per_batch=300,
        total_frames=300,
        remote_configs={"num_cpus": 1},
        weight_sync_schemes={},
    )
    database = ExpertDatabase(LazyTensorStorage(1000))
    (steps,) = collector
    collector.shutdown()
    database.extend(steps)
    assert len(database) == 300 and database[:]["target"].shape == (300, 4)


def test_what_is_sent_is_small(ray, folder):
    source, (unit,) = PolicyFactory(str(folder)), split_units(ROWS, ROWS, SEED)
    sent = ray.cloudpickle.dumps((TASK, source, unit))
    rows = sum(path.stat().st_size for path in (folder / "database" / "rows").rglob("*"))
    assert len(sent) < 2000 < rows
    assert pickle.loads(sent) == (TASK, source, unit)


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
