"""The same evaluation by this process and by Ray's workers."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from torchrl_rad.envs import make_task
from torchrl_rad.experiment import Driver, check_evaluation
from torchrl_rad.policy import load_policy
from torchrl_rad.runs import RunFolder

from ..saved_policy import ENV

CONFIG = {
    "seed": 0,
    "device": "cpu",
    "env": ENV,
    "optim": {"precision": "fp32"},
    "logger": {"progress": False},
    "evaluation": {"episodes": 3, "seed": 10_000, "starts": {"cells": [[1, 1], [3, 1]]}},
}
TASK = dataclasses.replace(make_task(ENV), max_steps=20)


def drive(folder, **changes):
    run = RunFolder(folder.parents[1])
    config = {**CONFIG, **changes}
    driver = Driver(run, config, TASK)
    episodes = driver(folder.name, load_policy(folder))
    driver.close()
    return episodes


def differing(one, other):
    """The keys of entries that are not the same."""
    return [key for key in one.keys(True, True) if not torch.equal(one[key], other[key])]


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_same_evaluation_on_ray(ray, folder):
    evaluation = {**CONFIG["evaluation"], "replan": 2}
    here = drive(folder, collector={"rows": 2}, evaluation=evaluation)
    there = drive(folder, collector={"backend": "ray", "rows": 2}, evaluation=evaluation)
    # the workers' task is that of the config, whose episodes are longer
    assert here.shape == (3, 20) and differing(here, there) == [("next", "done")]


def test_all_in_one_by_default(folder):
    assert (drive(folder) == drive(folder, collector={"rows": 3})).all()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"episodes": 0}, ValueError, "there are 0 episodes"),
        ({"replan": 0}, ValueError, "interval is 0; expected 1 to 4"),
        ({"replan": 5}, ValueError, "interval is 5; expected 1 to 4, the steps of the plan's fin"),
        ({"starts": {"cells": [[1, 1], [0, 0]]}}, ValueError, "cell .0, 0. of .* is a wall"),
        ({"starts": {"cells": []}}, ValueError, "expected cells or states"),
        ({"starts": {"states": ["nowhere.hdf5"]}}, FileNotFoundError, "nowhere.hdf5"),
    ],
)
def test_what_could_not_be_driven(folder, changes, error, message):
    policy, settings = load_policy(folder), CONFIG["evaluation"]
    check_evaluation({**settings, "replan": 4}, TASK, [policy])
    with pytest.raises(error, match=message):
        check_evaluation({**settings, **changes}, TASK, [policy])
