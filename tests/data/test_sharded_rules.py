"""Goals of the query, and one of the best targets: from shards as from one database."""

import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad import GoalReward, RetrievalTargetModule, build_policy
from torchrl_rad.policy import with_goals
from torchrl_rad.retrieval import goals, windowed

from .test_sharded import NAMES, both, queries, tables, walks

RULES = [
    {"rule": "highest"},
    {"rule": "highest", "min_offset": 2},
    {"rule": "followed", "ahead": 2},
]


@pytest.fixture(autouse=True)
def quickly(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda handle: None)  # takes most of the time


def assert_same(plain, many, asked, same=torch.equal, **options):
    answers = []
    for made in (plain, many):
        select = RetrievalTargetModule(made, horizon=6, out_keys=NAMES, **options)
        torch.manual_seed(3)  # of the same draws among the best
        answers.append([select(asked.clone())[name] for name in NAMES])
    for name, one, other in zip(NAMES, *answers, strict=True):
        assert same(one, other), name
    return dict(zip(NAMES, answers[0], strict=True))


# one of the best targets


@settings(max_examples=25, deadline=None)
@given(tables(), st.integers(6, 14), st.sampled_from([1, 4, 100]), st.integers(2, 5), st.data())
def test_one_of_the_best(steps, size, k, among, data):
    width = steps["observation"].shape[1]
    cells = st.lists(st.sampled_from([-1.0, 0.0, 0.5, 2.0]), min_size=width, max_size=width)
    states = torch.tensor(data.draw(st.lists(cells, min_size=1, max_size=4)))
    asked = TensorDict({"observation": states.repeat(5, 1)}, [5 * len(states)])
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(windowed, "WINDOW_ENTRIES", 50)  # few queries at a time
        plain, many = both(steps, Path(folder) / "many", size, gamma=1.0, k=k, threshold=0.4)
        for rule in RULES:
            assert_same(plain, many, asked, among=among, **rule)


@pytest.mark.parametrize("rule", RULES)
def test_several_targets_are_drawn(rule, tmp_path):
    plain, many = both(walks(), tmp_path / "many", threshold=0.2)
    asked = TensorDict({"observation": queries()[:1].expand(60, 3)}, [60])
    targets = assert_same(plain, many, asked, among=3, **rule)["target_index"]
    assert targets.unique().numel() == 3 and (targets >= 0).all()


# goals of the queries


@settings(max_examples=25, deadline=None)
@given(
    tables(),
    st.integers(6, 14),
    st.sampled_from([1, 5, 100]),
    st.booleans(),
    st.sampled_from([None, 3]),
    st.sampled_from([0, goals.SUBSET_ENTRIES]),
    st.data(),
)
def test_goals(steps, size, k, first_visit, longest, entries, data):
    width = steps["observation"].shape[1]
    place = st.lists(st.sampled_from([-1.0, 0.0, 1.0, 2.0]), min_size=width + 1, max_size=width + 1)
    drawn = torch.tensor(data.draw(st.lists(place, min_size=1, max_size=5)))
    asked = TensorDict({"observation": drawn[:, :-1], "goal": drawn[:, -1:]}, [len(drawn)])
    expert = longest and (lambda episode: len(episode) <= longest)
    reward = GoalReward(0.5, first_visit=first_visit, expert=expert)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(goals, "SUBSET_ENTRIES", entries)
        plain, many = both(steps, Path(folder) / "many", size, k=k, threshold=0.3)
        for rule in RULES:
            assert_same(plain, many, asked, goal_key="goal", goal_reward=reward, **rule)


@pytest.mark.parametrize("entries", [0, goals.SUBSET_ENTRIES], ids=["all", "own"])
@pytest.mark.parametrize("dims", [None, [0, 2]])
def test_goals_with_standardised_states(entries, dims, tmp_path, monkeypatch):
    monkeypatch.setattr(goals, "SUBSET_ENTRIES", entries)
    steps = walks()
    steps["observation"][:, 1] *= 40.0
    search = {"normalize": True, "dims": dims, "threshold": 0.3}
    plain, many = both(steps, tmp_path / "many", **search)
    states = queries() * torch.tensor([1.0, 40.0, 1.0])
    states[3, 1] = torch.nan
    asked = TensorDict(
        {"observation": states, "goal": steps["observation"][7::12][:10].repeat(3, 1)}, [30]
    )

    def close(one, other):
        return torch.allclose(one.double(), other.double(), equal_nan=True)

    out = assert_same(plain, many, asked, close, goal_key="goal", **RULES[0])
    assert 0 < out["found"].sum() < 30 and not out["found"][3]


def test_goals_reached_in_a_shard_that_comes_later(tmp_path):
    steps = walks()
    plain, many = both(steps, tmp_path / "many", threshold=0.0)
    select = RetrievalTargetModule(many, horizon=6, goal_key="goal")
    later = walks(4, seed=9)
    later["observation"] += 50.0
    asked = {"observation": later["observation"][:1], "goal": later["observation"][9:10]}
    asked = TensorDict(asked, [1])
    assert not select(asked.clone())["found"].any()
    for made in (plain, many):
        made.extend(later)
    assert select(asked.clone())["found"].all()
    assert_same(plain, many, asked, goal_key="goal")


def test_a_policy_for_goals(tmp_path):
    _, many = both(walks(), tmp_path / "many", threshold=0.0)
    planner = {"horizon": 9, "jumps": [4, 1], "width": 16, "heads": 2, "blocks": 1}
    about = {"state_dim": 3, "action_dim": 1, "planner": planner, "target": {"ahead": 4}}
    policy = with_goals(build_policy(about, many), many)
    asked = TensorDict(
        {"observation": queries()[:1], "goal": many[:]["observation"][9:10, :2]}, [1]
    )
    out = policy(asked)
    assert out["found"].all() and out["action"].isfinite().all()
