"""Policies that are built, saved, damaged, moved and loaded."""

from __future__ import annotations

import copy
import json
import os
import pickle
import shutil
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage

from torchrl_rad import (
    DiffuserLitePlanner,
    DiffuserPlanner,
    ExpertDatabase,
    GoalReward,
    RetrievalSampler,
    RetrievalTargetModule,
    StepEstimator,
)
from torchrl_rad.checkpoint import CheckpointError, verify_manifest, write_json, write_manifest
from torchrl_rad.modules.levels import level_changes
from torchrl_rad.policy import (
    FORMAT,
    build_policy,
    fit_scales,
    load_policy,
    save_policy,
    with_goals,
)

PLANNER = {
    "horizon": 9,
    "jumps": [4, 1],
    "width": 16,
    "heads": 2,
    "blocks": 1,
    "steps": 2,
    "candidates": 2,
}
BACKBONE = {"state_dim": 4, "action_dim": 2, "planner": PLANNER}
ABOUT = {
    **BACKBONE,
    "maze": "umaze",
    "target": {"rule": "followed", "ahead": 4},
    "estimator": {"width": 16, "estimate": "mode"},
}
DIFFUSER = {
    **ABOUT,
    "planner": {
        "kind": "diffuser",
        "horizon": 8,
        "width": 8,
        "multiples": [1, 2],
        "steps": 3,
        "candidates": 2,
        "return_model": {"width": 8, "multiples": [1, 2]},
    },
}


def recorded(seed=0, episodes=6, length=12):
    generator = torch.Generator().manual_seed(seed)
    rows = episodes * length
    states = torch.randn(episodes, length + 1, 4, generator=generator).cumsum(1) / 4
    done = torch.zeros(episodes, length, 1, dtype=torch.bool)
    done[:, -1] = True
    following = {
        "observation": states[:, 1:].reshape(rows, 4),
        "reward": torch.rand(rows, 1, generator=generator),
        "done": done.reshape(rows, 1),
    }
    return TensorDict(
        {
            "observation": states[:, :-1].reshape(rows, 4),
            "action": torch.rand(rows, 2, generator=generator),
            "episode": torch.arange(episodes).repeat_interleave(length),
            "return_to_go": torch.rand(rows, generator=generator) * 7,
            "next": following,
        },
        [rows],
    )


def make_database(seed=0):
    sampler = RetrievalSampler("euclidean", dims=[0, 1], k=5, threshold=0.5)
    database = ExpertDatabase(LazyTensorStorage(200), gamma=0.9, sampler=sampler)
    database.extend(recorded(seed).exclude("return_to_go"))
    return database


def make_policy(about=ABOUT, database=None, seed=0):
    torch.manual_seed(seed)
    policy = build_policy(about, database)
    fit_scales(policy, recorded())
    return policy.eval()


def act(policy, seed=5):
    queries = recorded(9)["observation"][:7]
    torch.manual_seed(seed)
    return policy(TensorDict({"observation": queries}, [7]))


def assert_same(policy, other):
    first, second = act(policy), act(other)
    assert first["found"].any()
    for key in ("action", "plan", "target", "target_index", "target_step"):
        assert torch.equal(first[key], second[key]), key


@pytest.fixture
def database():
    return make_database()


@pytest.fixture
def saved(tmp_path, database):
    """A policy, and the folder in which it is saved."""
    policy = make_policy(database=database)
    save_policy(tmp_path / "policy", policy, ABOUT, database)
    return policy, tmp_path / "policy"


# building


def test_parts(database):
    policy = build_policy(ABOUT, database)
    select, estimator, planner = policy
    kinds = (RetrievalTargetModule, StepEstimator, DiffuserLitePlanner)
    assert tuple(type(module) for module in policy) == kinds
    assert select.horizon == estimator.horizon == planner.horizon == 9
    assert (select.rule, select.ahead) == ("followed", 4)
    assert select.database is planner.database is database
    assert planner.candidates == 2 and planner.return_model.tokens == 3
    assert "target_offset" in select.out_keys
    assert estimator.normalizer is planner.normalizer


def test_parts_of_a_diffuser(database):
    before = copy.deepcopy(DIFFUSER)
    policy = make_policy(DIFFUSER, database)
    select, estimator, planner = policy
    assert isinstance(planner, DiffuserPlanner) and DIFFUSER == before
    assert select.horizon == estimator.horizon == planner.horizon == 8
    assert planner.candidates == 2 and planner.return_model.horizon == 8
    assert estimator.normalizer is planner.normalizer is planner.return_model.normalizer
    now, returns = recorded()["observation"], recorded()["return_to_go"]
    torch.testing.assert_close(planner.normalizer.mean, now.mean(0))
    assert planner.return_model.mean.item() == pytest.approx(returns.mean().item())
    out = act(policy)
    assert out["plan"].shape == (7, 8, 4) and out["action"].shape == (7, 2)
    assert torch.equal(out["plan"][:, 0], out["observation"])
    for row in range(7):
        reached = torch.equal(out["plan"][row, out["target_step"][row, 0]], out["target"][row])
        assert reached or not out["found"][row]


def test_diffuser_without_a_return_model(tmp_path):
    planner = {**DIFFUSER["planner"], "candidates": 1, "return_model": None, "sampler": "ddim"}
    about = {**BACKBONE, "planner": planner}
    policy = make_policy(about)
    assert policy[0].return_model is None and not policy[0].targets
    save_policy(tmp_path, policy, about)
    assert torch.equal(act(policy)["action"], act(load_policy(tmp_path))["action"])


def test_unknown_kind_of_planner():
    with pytest.raises(
        ValueError, match=r"is 'dit'; expected one of \['diffuser', 'diffuser_lite'"
    ):
        build_policy({**BACKBONE, "planner": {"kind": "dit"}})


@pytest.mark.parametrize("target", [{}, {"target": None}])
def test_backbone(target):
    policy = build_policy({**BACKBONE, **target})
    (planner,) = policy
    assert not planner.targets
    assert planner.in_keys == ["observation"]


def test_defaults_fit_each_other():
    policy = build_policy({"state_dim": 4, "action_dim": 2, "planner": {}})
    assert policy[0].horizon == 129 and [level.jump for level in policy[0].levels] == [32, 8, 1]
    assert policy[0].return_model is None


def test_the_description_is_left_alone(database):
    before = copy.deepcopy(ABOUT)
    build_policy(ABOUT, database)
    assert ABOUT == before


def test_targets_nearer_than_the_planner_looks(database):
    about = {**ABOUT, "target": {**ABOUT["target"], "horizon": 6}}
    select, estimator, planner = build_policy(about, database)
    assert (select.horizon, estimator.horizon, planner.horizon) == (6, 6, 9)


@pytest.mark.parametrize(
    ("part", "horizon", "message"),
    [
        ("target", 17, "the horizon of 'target' is 17, but the planner was built for 9"),
        ("estimator", 17, "the horizon of 'estimator' is 17, but that of 'target' is 9"),
        ("estimator", 5, "the horizon of 'estimator' is 5, but that of 'target' is 9"),
    ],
)
def test_other_horizon(database, part, horizon, message):
    about = {**ABOUT, part: {**ABOUT[part], "horizon": horizon}}
    with pytest.raises(ValueError) as caught:
        build_policy(about, database)
    assert message in str(caught.value)


def test_no_database():
    with pytest.raises(ValueError, match="retrieves targets: pass the database"):
        build_policy(ABOUT)


@pytest.mark.parametrize(
    "planner, message",
    [
        ({"jumps": [3, 1]}, r"jumps \[3, 1\] do not multiply out to horizon 9"),
        ({"steps": 0}, "at least one inference step"),
        ({"horizon": 1, "jumps": [1]}, "a plan has 2 states or more"),
        ({"candidates": 0}, "candidates is 0"),
    ],
)
def test_planner_that_cannot_be(planner, message):
    with pytest.raises(ValueError, match=message):
        build_policy({**BACKBONE, "planner": {**PLANNER, **planner}})


def test_scales_by_hand(database):
    data = recorded()
    policy = make_policy(database=database)
    planner = policy[-1]
    now, following = data["observation"].double(), data["next", "observation"].double()
    for scale, values in (
        (planner.normalizer, now),
        (planner.inverse_dynamics.difference, following - now),
    ):
        torch.testing.assert_close(scale.mean.double(), values.mean(0), atol=1e-5, rtol=1e-5)
        deviation = values.std(0, unbiased=False)
        torch.testing.assert_close(scale.deviation.double(), deviation, atol=1e-5, rtol=1e-5)
    again = make_policy(BACKBONE)
    assert torch.equal(again[-1].normalizer.mean, planner.normalizer.mean)
    returns = data["return_to_go"]
    assert planner.return_model.mean.item() == pytest.approx(returns.mean().item())
    assert planner.return_model.deviation.item() == pytest.approx(returns.std(correction=0).item())


def test_scales_of_changes(tmp_path):
    about = {**BACKBONE, "planner": {**PLANNER, "relative": True}}
    policy, data = build_policy(about), recorded()
    fit_scales(policy, data)
    planner = policy[-1]
    for level, scale in zip(planner.levels, planner.changes, strict=True):
        expected = level_changes(data["observation"], data["episode"], level)
        assert torch.equal(scale.deviation, expected.deviation)
    save_policy(tmp_path / "policy", policy, about)
    loaded = load_policy(tmp_path / "policy")[-1].changes.state_dict()
    found = planner.changes.state_dict()
    assert all(torch.equal(value, loaded[key]) for key, value in found.items())


def test_scales_of_other_width():
    policy = build_policy({**BACKBONE, "state_dim": 3})
    with pytest.raises(ValueError, match="states have 4 entries; the policy was built for 3"):
        fit_scales(policy, recorded())


# saving and loading


def test_round_trip(saved):
    policy, folder = saved
    assert sorted(path.name for path in folder.iterdir()) == [
        "database",
        "manifest.json",
        "policy.json",
        "weights.safetensors",
    ]
    loaded = load_policy(folder)
    assert isinstance(loaded, TensorDictSequential) and not loaded.training
    assert_same(policy, loaded)
    assert not torch.equal(act(loaded, 5)["action"], act(loaded, 6)["action"])
    assert loaded[0].database is not policy[0].database


def test_diffuser_round_trip(tmp_path, database):
    policy = make_policy(DIFFUSER, database)
    save_policy(tmp_path / "policy", policy, DIFFUSER, database)
    loaded = load_policy(tmp_path / "policy")
    assert_same(policy, loaded)
    assert_same(policy, copy.deepcopy(policy))
    assert_same(policy, pickle.loads(pickle.dumps(policy)))


def test_backbone_round_trip(tmp_path):
    policy = make_policy(BACKBONE)
    save_policy(tmp_path / "deep" / "backbone", policy, BACKBONE)
    loaded = load_policy(tmp_path / "deep" / "backbone")
    assert torch.equal(act(policy)["action"], act(loaded)["action"])
    assert not (tmp_path / "deep" / "backbone" / "database").exists()


def test_description_is_kept(saved):
    about = json.loads((saved[1] / "policy.json").read_text())
    assert {key: about[key] for key in ABOUT} == ABOUT
    assert about["format"] == FORMAT
    assert about["database"] == saved[0][0].database.digest()


def test_with_goals_nothing_is_trained(database):
    policy = make_policy(database=database)
    everything = make_database(seed=3)
    able = with_goals(policy, everything, goal_reward=GoalReward(0.3))
    assert able.in_keys == ["observation", "goal"]
    weights = [p.data_ptr() for p in policy.parameters()]
    assert [p.data_ptr() for p in able.parameters()] == weights
    # rows with other goals; one that nobody reaches
    state = recorded(3)["observation"][:3]
    goal = recorded(3)["next", "observation"][5:8, :2].clone()
    goal[2] = 99.0
    out = able(TensorDict({"observation": state, "goal": goal}, [3]))
    assert out["found"].squeeze(-1).tolist() == [True, True, False]
    assert out["action"].shape == (3, 2) and out["action"].isfinite().all()
    assert able[-1].database is everything and able[-1].candidates == 1
    # the policy that it was made of is as it was
    assert policy[-1].database is database and policy[-1].candidates == 2
    assert act(policy)["found"].any()


def test_a_diffuser_with_goals_is_not_guided(database):
    policy = make_policy(DIFFUSER, database)
    able = with_goals(policy, make_database(seed=3), goal_reward=GoalReward(0.3))
    state, goal = recorded(3)["observation"][:2], recorded(3)["next", "observation"][5:7, :2]
    out = able(TensorDict({"observation": state, "goal": goal}, [2]))
    assert out["found"].all() and out["action"].isfinite().all()
    assert able[-1].guide_scale == 0.0 and able[-1].candidates == 1
    assert policy[-1].guide_scale == 1.0 and policy[-1].candidates == 2


def test_goals_need_targets():
    with pytest.raises(ValueError, match="this policy has no targets"):
        with_goals(make_policy(BACKBONE), make_database())


OTHER_PROCESS = """
import pickle, sys, torch
from tensordict import TensorDict
from torchrl_rad.policy import load_policy
folder, parcel, query = sys.argv[1:]
torch.set_num_threads(1)
queries = torch.load(query)
for policy in (load_policy(folder), pickle.load(open(parcel, "rb"))):
    torch.manual_seed(5)
    out = policy(TensorDict({"observation": queries}, [len(queries)]))
    print([value.hex() for value in out["action"].double().flatten().tolist()])
"""


def test_same_actions_in_another_process(saved, tmp_path):
    policy, folder = saved
    torch.save(recorded(9)["observation"][:7], tmp_path / "query.pt")
    (tmp_path / "policy.pkl").write_bytes(pickle.dumps(policy))
    command = [sys.executable, "-c", OTHER_PROCESS, str(folder)]
    ran = subprocess.run(
        [*command, str(tmp_path / "policy.pkl"), str(tmp_path / "query.pt")],
        capture_output=True, text=True, timeout=240,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as there: two add up in another order on some processors
    expected = str([value.hex() for value in act(policy)["action"].double().flatten().tolist()])
    torch.set_num_threads(threads)
    by_folder, by_pickle = ran.stdout.splitlines()[-2:]
    assert by_folder == expected
    assert by_pickle == expected


def test_pickle_of_a_saved_policy_holds_no_rows(saved):
    policy, folder = saved
    content = pickle.dumps(policy)
    assert str(folder / "database").encode() in content
    assert policy[0].database.path == folder / "database"


def test_deepcopy(saved):
    policy, _ = saved
    copied = copy.deepcopy(policy)
    assert copied[0].database is policy[0].database
    assert copied[2].database is policy[2].database
    assert_same(policy, copied)
    parameter, other = next(policy.parameters()), next(copied.parameters())
    assert parameter is not other and torch.equal(parameter, other)


def test_saved_over_an_older_one(saved, database):
    _, folder = saved
    other = make_policy(database=database, seed=1)
    save_policy(folder, other, ABOUT, database)
    assert_same(other, load_policy(folder))
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_loaded_and_saved_in_its_own_folder(saved):
    policy, folder = saved
    loaded = load_policy(folder)
    sent = pickle.loads(pickle.dumps(loaded))  # reads the rows of that folder
    save_policy(folder, loaded, ABOUT, loaded[0].database)
    assert_same(policy, load_policy(folder))
    assert_same(policy, sent)
    save_policy(folder, sent, ABOUT, sent[0].database)
    assert_same(policy, load_policy(folder))


# what cannot be loaded


def test_no_policy(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        load_policy(tmp_path)
    assert f"{tmp_path} holds no policy: policy.json is missing." in str(caught.value)
    assert "policies/followed" in str(caught.value)


@pytest.mark.parametrize("file", ["weights.safetensors", "database/database.json", "policy.json"])
@pytest.mark.parametrize("fault, message", [("cut", "is cut short"), ("bit", "its sha256 is not")])
def test_damaged(saved, file, fault, message):
    path = saved[1] / file
    content = bytearray(path.read_bytes())
    if fault == "cut":
        content = content[:-5]
    else:
        content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_policy(saved[1])
    assert str(path) in str(caught.value)


def test_damaged_rows(saved):
    rows = max((saved[1] / "database" / "rows").rglob("*.memmap"), key=os.path.getsize)
    content = bytearray(rows.read_bytes())
    content[100] ^= 1
    rows.write_bytes(content)
    with pytest.raises(CheckpointError, match="its sha256 is not the one"):
        load_policy(saved[1])


@pytest.mark.parametrize("name", ["weights.safetensors", "database"])
def test_missing(saved, name):
    path = saved[1] / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(CheckpointError, match="is missing, though manifest.json lists it"):
        load_policy(saved[1])


def swap_database(folder, seed=3):
    """Puts another database in a policy's folder."""
    shutil.rmtree(folder / "database")
    make_database(seed).dumps(folder / "database")


def test_other_database_is_noticed_by_the_manifest(saved):
    swap_database(saved[1])
    with pytest.raises(CheckpointError, match="database/.* is damaged: its sha256"):
        load_policy(saved[1])


def test_other_database(saved):
    policy, folder = saved
    swap_database(folder)
    write_manifest(folder)
    with pytest.raises(CheckpointError) as caught:
        load_policy(folder)
    assert f"{folder / 'database'} is not the database that this policy was saved with" in str(
        caught.value
    )
    assert "sha256 differs" in str(caught.value)
    assert "load_policy(folder, database=...)" in str(caught.value)
    given = make_database(3)
    other = load_policy(folder, database=given)
    assert other[0].database is other[2].database is given
    assert not torch.equal(act(other)["target"], act(policy)["target"])


def test_database_passed_on_purpose(saved):
    policy, folder = saved
    other = make_database(3)
    loaded = load_policy(folder, database=other)
    assert loaded[0].database is other
    weights = policy.state_dict()
    assert all(torch.equal(value, weights[key]) for key, value in loaded.state_dict().items())


def test_saved_without_its_database(tmp_path, database):
    policy = make_policy(database=database)
    save_policy(tmp_path / "policy", policy, ABOUT)
    with pytest.raises(ValueError, match="retrieves targets: pass the database"):
        load_policy(tmp_path / "policy")
    assert_same(policy, load_policy(tmp_path / "policy", database=database))


def rewrite(folder, **changes):
    """A folder whose files are whole, and whose description is another."""
    about = json.loads((folder / "policy.json").read_text())
    write_json(folder / "policy.json", {**about, **changes})
    write_manifest(folder)


def test_other_format(saved):
    rewrite(saved[1], format=FORMAT + 1)
    with pytest.raises(CheckpointError, match=f"has the format {FORMAT + 1}; .* reads {FORMAT}"):
        load_policy(saved[1])


def test_other_normaliser(saved):
    rewrite(saved[1], normalizer="ab12")
    with pytest.raises(CheckpointError, match="have another normaliser than policy.json"):
        load_policy(saved[1])


def test_other_horizon_than_the_weights(saved):
    rewrite(saved[1], planner={**PLANNER, "horizon": 17})
    with pytest.raises(CheckpointError, match="weights.safetensors does not fit this module"):
        load_policy(saved[1])


def test_horizon_that_does_not_match(saved):
    rewrite(saved[1], target={"rule": "followed", "ahead": 4, "horizon": 17})
    with pytest.raises(ValueError, match="the horizon of 'target' is 17"):
        load_policy(saved[1])


# what cannot be saved


@pytest.mark.parametrize("after", [0, 5, 12])
def test_full_disk(saved, database, monkeypatch, after):
    policy, folder = saved
    files = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    sync, calls = os.fsync, []

    def full(handle):
        calls.append(handle)
        if len(calls) > after:
            raise OSError(28, "No space left on device")
        sync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError) as caught:
        save_policy(folder, make_policy(database=database, seed=1), ABOUT, database)
    assert f"the policy was not saved in {folder}" in str(caught.value)
    assert "No space left on device" in str(caught.value)
    monkeypatch.undo()
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == files
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    verify_manifest(folder)
    assert_same(policy, load_policy(folder))
    assert_same(policy, pickle.loads(pickle.dumps(policy)))


def test_a_file_in_the_way(tmp_path, database):
    (tmp_path / "taken").write_text("something else")
    with pytest.raises(CheckpointError, match="the policy was not saved in"):
        save_policy(tmp_path / "taken", make_policy(database=database), ABOUT, database)
    assert (tmp_path / "taken").read_text() == "something else"


if __name__ == "__main__":
    raise SystemExit(pytest.main([__file__]))
