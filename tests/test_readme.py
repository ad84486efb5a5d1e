import re
from pathlib import Path

import pytest
import torch

from torchrl_rad import (
    ExpertDatabase,
    RetrievalSampler,
    build_policy,
    pointmaze_dataset,
    save_policy,
)
from torchrl_rad.policy import fit_scales

ROOT = Path(__file__).parents[1]
IMPORTS = """
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl_rad import *
"""


def blocks(language):
    text = (ROOT / "README.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_targets_for_your_own_policy(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_RAD_CACHE", str(tmp_path))
    (block,) = [block for block in blocks("python") if "RetrievalTargetModule(" in block]
    assert len(block.strip().splitlines()) <= 10
    names: dict = {}
    exec(IMPORTS + block, names)
    batch = names["batch"]
    assert batch["target"].shape == (4, 100, 4) and batch["action"].shape == (4, 100, 2)
    hit = batch["found"].squeeze(-1)
    assert hit.any()
    rows = names["database"][:]["observation"]
    index = batch["target_index"].squeeze(-1)
    assert torch.equal(batch["target"][hit], rows[index[hit]])
    assert torch.equal(batch["target"][~hit], batch["observation"][~hit])
    names["collector"].shutdown()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_any_goal(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_RAD_CACHE", str(tmp_path))
    planner = {"width": 16, "heads": 2, "blocks": 1, "steps": 1}
    about = {"state_dim": 4, "action_dim": 2, "planner": planner, "estimator": {"width": 8}}
    about["target"] = {"rule": "followed", "ahead": 16, "horizon": 33}
    database = ExpertDatabase(sampler=RetrievalSampler("euclidean", dims=[0, 1]))
    database.extend(pointmaze_dataset("umaze", steps=3000, progress=False))
    policy = build_policy(about, database)
    fit_scales(policy, database[:])
    save_policy(tmp_path / "policies" / "followed", policy, about, database)
    (block,) = [block for block in blocks("python") if "with_goals(" in block]
    assert len(block.strip().splitlines()) <= 10
    names: dict = {}
    exec(IMPORTS + block.replace("<run folder>", str(tmp_path)), names)
    assert names["arrived"].shape == (3,) and names["steps"].shape == (3, 300)
    assert names["steps"]["found"][:, 0].all()
    names["env"].close()


def test_two_commands_set_up_everything():
    first, second = [block for block in blocks("bash") if "python3 -m venv" in block]
    assert "recipes/dl_rad.py" in first and "pytest" in second
    assert first.count("\n") == second.count("\n") == 1


def test_what_the_readme_names_exists():
    text = (ROOT / "README.md").read_text()
    for path in re.findall(r"\]\(([\w./-]+)\)", text):
        assert (ROOT / path).exists(), path
    for script in re.findall(r"recipes/\w+\.py", text):
        assert (ROOT / script).exists(), script
