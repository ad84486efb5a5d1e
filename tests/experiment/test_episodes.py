"""Units of episodes: how they are split, seeded, driven and joined."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_rad.envs import AntMazeTask, OGBenchTask, make_task
from torchrl_rad.experiment import (
    HeldRows,
    PolicyFactory,
    TaskRows,
    collect_episodes,
    collector_settings,
    join_units,
    split_units,
)

from ..saved_policy import ENV

TASK = make_task(ENV)


def test_start_states_do_not_depend_on_the_split(folder):
    policy, held = PolicyFactory(str(folder))(), HeldRows(TASK)
    whole, split = (
        held.drive(split_units(5, rows, 7), policy, 4, progress=False) for rows in (None, 2)
    )
    assert torch.equal(whole["observation"][:, 0], split["observation"][:, 0])
    env = TASK.make_env(5)
    assert (collect_episodes(env, policy, 4, 7, progress=False) == whole).all()
    held.close()
    env.close()


def test_rows_are_kept_while_they_are_the_same():
    held = HeldRows(TASK)
    first, second, last = (held(unit) for unit in split_units(3, 1, 7))
    assert first is second is last
    held.close()


def test_rows_that_differ_keep_their_numbers():
    cells = [(1, 1), (3, 1), (1, 3)]
    assert (TASK.variants(), TASK.variants(cells)) == (1, 3)
    assert AntMazeTask("ant", "AntMaze_Medium-v4", (6, 6)).variants(cells) == 3
    assert OGBenchTask("og", "antmaze-medium-stitch-v0").variants() == 5
    held, whole = HeldRows(TASK, cells), TASK.make_env(4, seed=7, starts=cells)
    states = []
    for unit in split_units(4, 2, 7):
        env = held(unit)
        env.set_seed(unit.seed)
        states.append(env.reset()["observation"])
    assert torch.equal(torch.cat(states), whole.reset()["observation"])
    held.close()
    whole.close()


def test_a_short_unit_repeats_its_end():
    parts = []
    for steps in (2, 3):
        reward = torch.arange(1.0, steps + 1).expand(1, steps).unsqueeze(-1)
        parts.append(TensorDict({"next": {"reward": reward}}, [1, steps]))
    joined = join_units(parts)["next", "reward"].squeeze(-1)
    assert joined.tolist() == [[1.0, 2.0, 2.0], [1.0, 2.0, 3.0]]


@pytest.mark.parametrize("episodes, rows", [(0, None), (3, 0)])
def test_no_units(episodes, rows):
    with pytest.raises(ValueError, match="both are at least 1"):
        split_units(episodes, rows, 7)


# who drives


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"backend": "rpc"}, "collector.backend is 'rpc'; expected 'direct' or 'ray'"),
        ({"workers": 2}, "collector.workers is 2, but backend=direct is one process"),
        ({"rows": 0}, "collector.rows is 0; expected at least 1"),
    ],
)
def test_settings_that_are_none(settings, message):
    with pytest.raises(ValueError, match=message):
        collector_settings(settings)


def test_units_of_ten_on_ray(monkeypatch):
    monkeypatch.setattr("torchrl_rad.experiment.driving.require_ray", lambda: None)
    assert collector_settings({"backend": "ray", "workers": 4})["rows"] == 10


def test_without_ray(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    with pytest.raises(ImportError, match=r'pip install "torchrl_rad\[ray\]"'):
        collector_settings({"backend": "ray"})


def test_rows_by_config():
    rows = TaskRows(ENV, {"cells": [[1, 1]]})
    held = rows.open()
    assert held.task == TASK and held.starts == [(1, 1)]


def test_a_policy_reads_its_database_from_the_files(folder):
    policy = PolicyFactory(str(folder))()
    rows = policy[0].database[:]
    assert type(rows["observation"]).__name__ == "MemoryMappedTensor"
    assert PolicyFactory(str(folder), replan=1)() is not policy
    assert PolicyFactory(str(folder), replan=1) == PolicyFactory(str(folder))
