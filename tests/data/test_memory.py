"""Databases larger than memory: what is read of a memory-mapped one does not become private."""

import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler

ROWS, WIDTH = 400_000, 60  # 96 MB of states

ASK = """
import ctypes
import sys
import torch
from tensordict import TensorDict
from torchrl_rad import ExpertDatabase, RetrievalTargetModule

def private():
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is not used
    for line in open("/proc/self/status"):
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1e3

def ask(folder, backend):
    database = ExpertDatabase.loads(folder, memmap=True)
    database.sampler.backend = backend
    select = RetrievalTargetModule(database, horizon=33)
    for step in range(20):
        state = database[100 + step]["observation"] + 0.001
        out = select(TensorDict({"observation": state[None]}, [1]))
        assert out["found"].all() and torch.isfinite(out["target"]).all()

torch.set_num_threads(1)
ask(sys.argv[1], sys.argv[3])  # libraries take memory of their own at the first use
before = private()
ask(sys.argv[2], sys.argv[3])
print(private() - before)
"""


def save(folder, rows):
    generator = torch.Generator().manual_seed(0)
    state = (0.01 * torch.randn(rows, WIDTH, generator=generator)).cumsum(0)
    done = torch.zeros(rows, 1, dtype=torch.bool)
    done[499::500] = True
    steps = {"observation": state, "next": {"reward": state[:, :1], "done": done}}
    sampler = RetrievalSampler("euclidean", k=50, threshold=0.1)
    database = ExpertDatabase(LazyTensorStorage(rows), gamma=0.97, sampler=sampler)
    database.extend(TensorDict(steps, [rows]))
    database.dumps(folder)
    return database[:].bytes() / 1e6


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("backend", ["auto", "scan"])
def test_a_memory_mapped_database_stays_on_disk(backend, tmp_path):
    save(tmp_path / "small", 5000)
    megabytes = save(tmp_path / "large", ROWS)
    command = [sys.executable, "-c", ASK, tmp_path / "small", tmp_path / "large", backend]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    grown = float(ran.stdout.split()[-1])
    # scores and what the rule precomputes take some 100 bytes a row; a copy of the states 240
    assert grown < megabytes / 2
