import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, PlainTargetModule, RetrievalSampler, RetrievalTargetModule
from torchrl_rad.modules.target_variants import KEYS

RULES = ("random", "nearest", "none")


def database(count=20, width=3, seed=0):
    sampler = RetrievalSampler("euclidean", k=3, threshold=0.4)
    made = ExpertDatabase(LazyTensorStorage(100), gamma=0.9, sampler=sampler)
    generator = torch.Generator().manual_seed(seed)
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[4::5] = True
    steps = {"reward": torch.rand(count, 1, generator=generator), "done": done}
    states = torch.randn(count, width, generator=generator)
    made.extend(TensorDict({"observation": states, "next": steps}, [count]))
    return made


def ask(select, states):
    return select(TensorDict({"observation": states}, states.shape[:-1]))


def queries(count=40, width=3):
    return 1.5 * torch.randn(count, width, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("shape", [(), (7,), (2, 3), (0,)])
@pytest.mark.parametrize("rule", RULES)
def test_writes_what_the_target_rule_writes(rule, shape):
    made = database()
    states = torch.randn(*shape, 3)
    out = ask(PlainTargetModule(made, rule), states)
    own = ask(RetrievalTargetModule(made, out_keys=KEYS), states)
    for key in KEYS:
        assert out[key].shape == own[key].shape and out[key].dtype == own[key].dtype, key


def test_nearest_by_brute_force():
    made, states = database(), queries()
    out = ask(PlainTargetModule(made, "nearest"), states)
    rows = made[:]
    gap = torch.cdist(states.double(), rows["observation"].double())
    best = gap.min(-1)
    hit = 1 / (1 + best.values) >= 0.4
    assert 0 < hit.sum() < len(hit)
    assert torch.equal(out["found"][:, 0], hit)
    assert torch.equal(out["target_index"][:, 0], torch.where(hit, best.indices, -1))
    target = torch.where(hit[:, None], rows["observation"][best.indices], states)
    assert torch.equal(out["target"], target)
    assert torch.allclose(out["similarity"][:, 0].double(), 1 / (1 + best.values), atol=1e-6)
    value = torch.where(hit, rows["return_to_go"][best.indices], 0.0)
    assert torch.equal(out["target_return"][:, 0], value)
    source = torch.stack([rows["episode"], rows["step"]], -1)[best.indices]
    assert torch.equal(out["target_source"], torch.where(hit[:, None], source, -1))
    assert (out["target_offset"] == 0).all()


def test_random_takes_every_row_and_no_other():
    made = database()
    torch.manual_seed(0)
    out = ask(PlainTargetModule(made, "random"), torch.zeros(2000, 3))
    assert out["found"].all()
    count = out["target_index"][:, 0].bincount(minlength=20)
    assert len(count) == 20 and (count > 50).all()
    assert torch.equal(out["target"], made[:]["observation"][out["target_index"][:, 0]])


def test_none_finds_nothing():
    states = queries()
    out = ask(PlainTargetModule(database(), "none"), states)
    assert not out["found"].any() and torch.equal(out["target"], states)
    assert (out["target_index"] == -1).all() and out["similarity"].isfinite().all()


@pytest.mark.parametrize("rule", RULES)
def test_states_that_are_none_and_an_empty_database(rule):
    states = torch.zeros(3, 3)
    states[1, 2], states[2, 0] = torch.nan, torch.inf
    out = ask(PlainTargetModule(database(), rule), states)
    assert not out["found"][1:].any() and out["target"].isfinite().all()
    empty = ExpertDatabase(LazyTensorStorage(9))
    out = ask(PlainTargetModule(empty, rule), states)
    assert not out["found"].any() and (out["target_source"] == -1).all()


def test_shares_the_database():
    made = database()
    assert copy.deepcopy(PlainTargetModule(made, "nearest")).database is made
    assert not PlainTargetModule(made, "random").state_dict()


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"rule": "best"}, "rule is 'best'; expected 'random', 'nearest' or 'none'"),
        ({"rule": "none", "out_keys": ["target"]}, "expected one in_key and 7 out_keys"),
    ],
)
def test_settings_that_are_none(settings, message):
    with pytest.raises(ValueError, match=message):
        PlainTargetModule(database(), **settings)
