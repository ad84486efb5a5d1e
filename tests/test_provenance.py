"""What was followed, read off the steps of an evaluation."""

import csv

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, RetrievalSampler, RetrievalTargetModule
from torchrl_rad.provenance import demonstration_usage, provenance_table, write_provenance

NAMES = ["target", "found", "similarity", "target_return", "target_index", "target_offset"]
NAMES += ["target_source"]


def line(ids=(7, 3), length=6, gap=100.0):
    """Each episode walks along a line of its own; the last step pays."""
    count = len(ids) * length
    place = torch.arange(float(length)).repeat(len(ids))
    start = torch.arange(len(ids)).repeat_interleave(length) * gap
    reward, done = torch.zeros(count, 1), torch.zeros(count, 1, dtype=torch.bool)
    reward[length - 1 :: length], done[length - 1 :: length] = 1.0, True
    steps = {
        "observation": torch.stack([start, place], -1),
        "episode": torch.tensor(ids).repeat_interleave(length),
        "next": {"reward": reward, "done": done},
    }
    sampler = RetrievalSampler("euclidean", k=1, threshold=0.5)
    database = ExpertDatabase(LazyTensorStorage(99), 0.5, sampler=sampler)
    database.extend(TensorDict(steps, [count]))
    return database


def driven():
    """Two rows: one along the demonstrations and off them, one that ends early."""
    database = line()
    one = [[0.0, 0.1], [0.0, 2.1], [100.0, 3.9], [50.0, 0.0]]
    other = [[0.0, 5.0], [0.0, 5.0], [0.0, 0.0], [0.0, 0.0]]
    states = torch.tensor([one, other])
    select = RetrievalTargetModule(database, 9, "followed", ahead=2, out_keys=NAMES)
    steps = select(TensorDict({"observation": states}, [2, 4]))
    steps["target_step"] = steps["target_offset"].clamp_min(1)
    done = torch.tensor([[False, False, False, True], [False, True, False, False]])
    reward = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    steps["next"] = {"done": done[..., None], "reward": reward[..., None]}
    return steps, database


def test_source_by_hand():
    steps, database = driven()
    expected = [[[7, 0], [7, 2], [3, 4], [-1, -1]], [[7, 5], [7, 5], [7, 0], [7, 0]]]
    assert steps["target_source"].tolist() == expected
    assert steps["target_source"].dtype == torch.int64
    # it leads on to the target
    rows, found = database[:], steps["found"][..., 0]
    target = rows[steps["target_index"][found][:, 0]]
    source, offset = steps["target_source"][found], steps["target_offset"][found][:, 0]
    assert torch.equal(target["episode"], source[:, 0])
    assert torch.equal(target["step"], source[:, 1] + offset)


def test_provenance_by_hand():
    steps, _ = driven()
    columns = provenance_table(steps)
    assert columns["row"].tolist() == [0, 0, 0, 0, 1, 1]  # up to its end
    assert columns["step"].tolist() == [0, 1, 2, 3, 0, 1]
    assert columns["found"].tolist() == [True, True, True, False, True, True]
    assert columns["episode"].tolist() == [7, 7, 3, -1, 7, 7]
    assert columns["episode_step"].tolist() == [0, 2, 4, -1, 5, 5]
    assert columns["target_step"].tolist() == [2, 4, 5, -1, 5, 5]
    assert columns["estimated_steps"].tolist() == [2, 2, 1, -1, 1, 1]
    np.testing.assert_allclose(columns["similarity"][:3], 1 / 1.1, rtol=1e-5)
    assert columns["return"].tolist() == [0.125, 0.5, 1.0, 0.0, 1.0, 1.0]


def test_written_as_read(tmp_path):
    steps, _ = driven()
    write_provenance(tmp_path / "followed.csv", steps)
    with open(tmp_path / "followed.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = provenance_table(steps)
    assert len(rows) == 6 and list(rows[0]) == list(columns)
    for name, column in columns.items():
        assert [float(row[name]) for row in rows] == column.astype(float).tolist()


def test_usage_and_pruning():
    steps, database = driven()
    usage = demonstration_usage(steps)
    assert usage == [
        {"episode": 7, "steps": 4, "episodes": 2, "return": 0.5, "success": 0.5},
        {"episode": 3, "steps": 1, "episodes": 1, "return": 0.0, "success": 0.0},
    ]
    assert database.keep(used["episode"] for used in usage[:1]) == 6
    assert database[:]["episode"].unique().tolist() == [7]
    with pytest.raises(KeyError, match=r"episodes \[3\] are not in the database"):
        database.keep([7, 3])


def test_nothing_was_followed():
    steps, _ = driven()
    steps["found"][:] = False
    assert demonstration_usage(steps) == []


def test_steps_without_sources():
    with pytest.raises(KeyError, match="no 'target_source': ask RetrievalTargetModule"):
        provenance_table(driven()[0].exclude("target_source"))
