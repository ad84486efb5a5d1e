"""A learned value as a column of the data."""

import copy

import pytest
import torch
from tensordict import TensorDict

from torchrl_rad.checkpoint import CheckpointError
from torchrl_rad.learned_value import learn_value
from torchrl_rad.runs import RunFolder

CONFIG = {
    "seed": 0,
    "loss": {"gamma": 0.9, "expectile": 0.9, "value_steps": 20},
    "logger": {"progress": False},
}
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")


def steps(count=60):
    generator = torch.Generator().manual_seed(0)
    state, after, action = (torch.randn(count, n, generator=generator) for n in (3, 3, 2))
    end = torch.zeros(count, 1, dtype=torch.bool)
    end[9::10] = True
    following = {"observation": after, "reward": end.float(), "done": end, "terminated": end}
    return TensorDict({"observation": state, "action": action.tanh(), "next": following}, [count])


OVER = steps()["next", "terminated"]


def test_learned_once_for_a_run(tmp_path):
    run = RunFolder.create(tmp_path / "run", CONFIG)
    value = learn_value(run, CONFIG, steps(), OVER)
    assert value.shape == (60,) and value.dtype == torch.float32 and value.isfinite().all()
    written = (run.path / "value.csv").read_text()
    assert "value/loss_qvalue" in written
    torch.manual_seed(99)
    assert torch.equal(learn_value(run, CONFIG, steps(), OVER), value)
    assert (run.path / "value.csv").read_text() == written


def test_resumed_as_if_never_stopped(tmp_path, monkeypatch):
    whole = learn_value(RunFolder.create(tmp_path / "whole", CONFIG), CONFIG, steps(), OVER)
    run = RunFolder.create(tmp_path / "run", CONFIG)
    from torchrl_rad.training import Objective

    update, calls = Objective.update, []

    def stop(self, batch):
        calls.append(0)
        if len(calls) == 9:
            raise KeyboardInterrupt
        return update(self, batch)

    monkeypatch.setattr(Objective, "update", stop)
    with pytest.raises(KeyboardInterrupt):
        learn_value(run, CONFIG, steps(), OVER)
    monkeypatch.setattr(Objective, "update", update)
    assert torch.equal(learn_value(run, CONFIG, steps(), OVER), whole)


def test_not_gone_on_with_under_other_settings(tmp_path):
    run = RunFolder.create(tmp_path / "run", CONFIG)
    learn_value(run, CONFIG, steps(), OVER)
    other = copy.deepcopy(CONFIG)
    other["loss"]["gamma"] = 0.5
    with pytest.raises(CheckpointError, match="gamma"):
        learn_value(run, other, steps(), OVER)
