"""A sharded database answers what one in memory answers, whatever the cut into shards."""

import copy
import json
import os
import pickle
import shutil
import tempfile
import threading
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import (
    CheckpointError,
    ExpertDatabase,
    RetrievalSampler,
    RetrievalTargetModule,
    ShardedExpertDatabase,
    build_policy,
    load_policy,
    reaches_goal,
    save_policy,
    similarity_threshold,
)
from torchrl_rad.data import shard_homes, sharded
from torchrl_rad.modules.target_variants import PlainTargetModule

from ..oracle import target_of
from ..walks import episodes, random_walks

NAMES = ["target", "found", "similarity", "target_return", "target_index", "target_offset",
         "target_source"]  # fmt: skip
RULES = [
    {"rule": "highest"},
    {"rule": "highest", "tolerance": 1.0},
    {"rule": "highest", "min_offset": 2},
    {"rule": "followed", "ahead": 2},
]
rules = pytest.mark.parametrize("rule", RULES, ids=["highest", "tolerant", "offset", "followed"])
SEARCH = {"metric": "euclidean", "k": 20, "threshold": 0.5}


def walks(count=12, length=10, width=3, seed=0):
    """Random walks with a reward now and then."""
    return random_walks(count, length, width, seed, unpaid=0.8)


def queries(count=30, width=3):
    return torch.randn(count, width, generator=torch.Generator().manual_seed(5)) * 0.8


def both(steps, folder, rows_per_shard=25, parts=3, gamma=0.9, workers=None, **search):
    """A plain and a sharded database of the same episodes, added in some parts."""
    search = {**SEARCH, **search}
    plain = ExpertDatabase(
        LazyTensorStorage(len(steps) + 100), gamma=gamma, sampler=RetrievalSampler(**search)
    )
    many = ShardedExpertDatabase.create(
        folder, gamma, sampler=RetrievalSampler(**search), rows_per_shard=rows_per_shard,
        workers=workers,
    )  # fmt: skip
    ends = (steps["next", "done"][:, 0].nonzero()[:, 0] + 1).tolist()
    cuts = sorted({ends[len(ends) * part // parts - 1] for part in range(1, parts + 1)} - {0})
    for begin, end in zip([0, *cuts], cuts, strict=False):
        assert torch.equal(plain.extend(steps[begin:end]), many.extend(steps[begin:end]))
    return plain, many


def assert_same_answers(plain, many, states, rule, exact=True):
    answers = []
    for made in (plain, many):
        select = RetrievalTargetModule(made, horizon=6, out_keys=NAMES, **rule)
        answers.append(select(TensorDict({"observation": states}, states.shape[:1])))
    for name in NAMES:
        one, other = (answer[name] for answer in answers)
        assert one.dtype == other.dtype
        if exact or name != "similarity":
            assert torch.equal(one, other), name
        else:
            torch.testing.assert_close(one, other)
    return answers[0]


# the same answers


@st.composite
def tables(draw):
    """Episodes on a coarse grid, so that states, similarities and returns tie."""
    lengths = draw(st.lists(st.integers(1, 6), min_size=1, max_size=8))
    rows, width = sum(lengths), draw(st.integers(1, 4))
    cells = st.lists(st.integers(-2, 2), min_size=rows * width, max_size=rows * width)
    states = torch.tensor(draw(cells), dtype=torch.float32).reshape(rows, width)
    rewards = draw(st.lists(st.integers(0, 2), min_size=rows, max_size=rows))
    return episodes(states, lengths, torch.tensor(rewards, dtype=torch.float32))


@settings(max_examples=25, deadline=None)
@given(
    tables(),
    st.integers(6, 14),
    st.integers(1, 3),
    st.sampled_from(["euclidean", "cosine"]),
    st.sampled_from([1, 3, 8, 100]),
    st.sampled_from([0.0, 0.4, 1.0]),
    st.data(),
)
def test_equals_one_database_and_the_oracle(steps, size, parts, metric, k, threshold, data):
    width = steps["observation"].shape[1]
    cells = st.lists(st.sampled_from([-1.0, 0.0, 0.5, 2.0]), min_size=width, max_size=width)
    states = torch.tensor(data.draw(st.lists(cells, min_size=1, max_size=4)))
    search = {"metric": metric, "k": k, "threshold": threshold}
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(shard_homes, "SPARE", 0)  # few rows are looked at first
        patch.setattr(os, "fsync", lambda handle: None)  # takes most of the time
        plain, many = both(steps, Path(folder) / "many", size, parts, gamma=1.0, **search)
        rows, table = many[:], plain[:].exclude("index")
        assert all((rows.get(key) == table.get(key)).all() for key in table.keys(True, True))
        columns = {name: value.tolist() for name, value in table.exclude("next").items()}
        found, expected = many.retrieve(states), plain.retrieve(states)
        for name in ("index", "similarity", "valid", "observation", "episode", "return_to_go"):
            assert torch.equal(found[name], expected[name]), name
        for rule in RULES:
            out = assert_same_answers(plain, many, states, rule)
            limits = {"ahead": 2} if rule["rule"] == "followed" else {"horizon": 6, **rule}
            limits.pop("rule", None)
            for number, state in enumerate(states.tolist()):
                truth = target_of(state, columns, search, rule["rule"], **limits)
                assert out["target_index"][number].item() == truth["target_index"]
                assert out["target_offset"][number].item() == truth["target_offset"]


@rules
@pytest.mark.parametrize(
    "metric, dims", [("euclidean", None), ("euclidean", [0, 2]), ("cosine", None)]
)
def test_normalised_by_all_rows(rule, metric, dims, tmp_path):
    steps = walks()
    steps["observation"][:, 1] *= 40.0
    search = {"metric": metric, "normalize": True, "dims": dims, "threshold": 0.3}
    plain, many = both(steps, tmp_path / "many", **search)
    states = queries() * torch.tensor([1.0, 40.0, 1.0])
    out = assert_same_answers(plain, many, states, rule, exact=False)
    assert out["found"].any()
    plain.extend(steps[:20]), many.extend(steps[:20])  # another mean
    assert_same_answers(plain, many, states, rule, exact=False)


@rules
def test_batch_of_one_equals_batch_of_many(rule, tmp_path):
    _, many = both(walks(), tmp_path / "many")
    select = RetrievalTargetModule(many, horizon=6, out_keys=NAMES, **rule)
    whole = select(TensorDict({"observation": queries()}, [30]))
    for number, state in enumerate(queries()):
        alone = select(TensorDict({"observation": state}, []))
        assert all(torch.equal(alone[name], whole[name][number]) for name in NAMES)


@rules
def test_queries_without_an_answer(rule, tmp_path):
    plain, many = both(walks(), tmp_path / "many")
    states = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [99.0, 0, 0], [0.1, 0, 0]])
    out = assert_same_answers(plain, many, states, rule)
    assert out["found"][:, 0].tolist() == [False, False, False, True]
    assert_same_answers(plain, many, states[:0], rule)
    assert_same_answers(plain, many, states[:2], rule)


def test_empty(tmp_path):
    many = ShardedExpertDatabase.create(tmp_path / "many")
    assert len(many) == 0 and many.shards == []
    out = RetrievalTargetModule(many)(TensorDict({"observation": queries()}, [30]))
    assert not out["found"].any() and (out["target_index"] == -1).all()
    for ask in (lambda: many.retrieve(queries()), lambda: many.width):
        with pytest.raises(RuntimeError, match="the database is empty: extend it with episodes"):
            ask()
    with pytest.raises(RuntimeError, match="database is empty"):
        many.sample(3)
    many.flush()
    assert len(copy.deepcopy(many)) == 0 and len(pickle.loads(pickle.dumps(many))) == 0


@pytest.mark.parametrize("rule", ["random", "nearest", "none"])
def test_targets_without_a_thought_for_return(rule, tmp_path):
    answers = []
    for made in both(walks(), tmp_path / "many"):
        torch.manual_seed(0)
        answers.append(PlainTargetModule(made, rule)(TensorDict({"observation": queries()}, [30])))
    assert (answers[0] == answers[1]).all()


def test_rows_by_number(tmp_path):
    plain, many = both(walks(), tmp_path / "many")
    for index in (0, -1, 47, [3, 99, 50, 3], torch.tensor([[5, 60], [110, 0]]), slice(20, 60, 7)):
        one, other = plain[index].exclude("index"), many[index]
        assert one.batch_size == other.batch_size and (one == other.select(*one.keys())).all()
    index = torch.tensor([[5, 60], [110, 0]])
    for key in ("step", "episode", ("next", "reward")):
        assert torch.equal(many.columns[key][index], plain[:].get(key)[index])
    with pytest.raises(IndexError, match="rows 5 to 120 of 120"):
        many[[5, 120]]
    batch = many.sample(50)
    assert (plain[batch["index"]].exclude("index") == batch.exclude("index")).all()
    assert similarity_threshold(many, walks(3, seed=1)) == similarity_threshold(
        plain, walks(3, seed=1)
    )


def test_settings_of_the_search_may_change(tmp_path):
    plain, many = both(walks(), tmp_path / "many")
    for made in (plain, many):
        made.sampler.k, made.sampler.threshold = 3, 0.7
    assert_same_answers(plain, many, queries(), RULES[-1])
    assert_same_answers(plain, pickle.loads(pickle.dumps(many)), queries(), RULES[-1])


def test_a_policy_acts_as_with_one_database(tmp_path):
    description = {
        "state_dim": 3,
        "action_dim": 2,
        "target": {"rule": "followed", "horizon": 9, "ahead": 4},
        "planner": {"kind": "diffuser_lite", "horizon": 9, "jumps": (4, 1), "width": 32,
                    "heads": 2, "blocks": 1, "noise": "zero"},
    }  # fmt: skip
    answers = []
    for made in both(walks(), tmp_path / "many"):
        torch.manual_seed(0)
        policy = build_policy(description, made).eval()
        answers.append(policy(TensorDict({"observation": queries()}, [30])))
    names = ("target", "plan", "action", "target_source")
    assert answers[0]["found"].any()
    assert all(torch.equal(answers[0][name], answers[1][name]) for name in names)
    save_policy(tmp_path / "policy", policy, description, made)
    again = load_policy(tmp_path / "policy")
    assert isinstance(again[0].database, ShardedExpertDatabase)
    assert again[0].database.digest() == made.digest()
    assert torch.equal(
        again(TensorDict({"observation": queries()}, [30]))["plan"], answers[1]["plan"]
    )
    made.extend(walks(3))  # goes on where it is, not in the copy
    assert len(made) == 150 and len(load_policy(tmp_path / "policy")[0].database) == 120


# filling


def test_shards_are_filled_and_closed(tmp_path):
    many = ShardedExpertDatabase.create(tmp_path / "many", rows_per_shard=25)
    assert many.extend(walks(2)).tolist() == list(range(20)) and many.shards == []
    assert many.extend(walks(1)).tolist() == list(range(20, 30)) and len(many.shards) == 1
    many.extend(walks(4))  # 20 + 20 + 20 + 10
    assert [len(ExpertDatabase.loads(path)) for path in many.shards] == [20, 20, 20]
    assert len(many) == 70 and many[:]["episode"].unique().tolist() == list(range(7))
    many.flush(), many.flush()
    assert [path.name for path in many.shards] == [f"shard-{n:06d}" for n in range(4)]
    exact = ShardedExpertDatabase.create(tmp_path / "exact", rows_per_shard=20)
    exact.extend(walks(4))
    assert len(exact.shards) == 2  # closed as soon as full


def test_expert_rule_and_ids(tmp_path):
    many = ShardedExpertDatabase.create(tmp_path / "many", expert=reaches_goal(), rows_per_shard=25)
    steps = episodes(torch.arange(9.0)[:, None], [3, 3, 3], torch.tensor([0, 0, 1.0] + [0] * 6))
    steps["episode"] = torch.tensor([7] * 3 + [8] * 3 + [11] * 3)
    many.extend(steps)
    assert many[:]["episode"].tolist() == [7] * 3
    many.extend(steps)
    many.flush()
    many.extend(steps)
    assert many[:]["episode"].tolist() == [7] * 3 + [8] * 3 + [9] * 3
    again = ShardedExpertDatabase.loads(tmp_path / "many")
    assert repr(again.expert) == "reaches_goal()"
    with pytest.raises(ValueError, match="none of the 2 episodes is an expert's"):
        again.extend(steps[3:])


def test_nothing_of_a_bad_batch_is_added(tmp_path):
    many = ShardedExpertDatabase.create(tmp_path / "many", rows_per_shard=25)
    many.extend(walks(3))
    bad = walks(4)
    bad["observation"][35, 0] = torch.nan
    with pytest.raises(ValueError, match="NaN or Inf in 1 row.*episode 3 at step 5"):
        many.extend(bad)
    with pytest.raises(ValueError, match="'observation' is torch.float32 .T, 2., but the database"):
        many.extend(walks(3, width=2))
    with pytest.raises(ValueError, match="an episode has 26 steps, a shard room for 25; create"):
        many.extend(torch.cat([walks(1), walks(1, 26)]))
    with pytest.raises(NotImplementedError, match="takes whole episodes"):
        many.add(walks(1)[0])
    with pytest.raises(NotImplementedError, match="rows of a sharded database do not change"):
        many.relabel(torch.zeros(30))
    with pytest.raises(TypeError, match="expected a TensorDict of steps, got list"):
        many.extend([walks(1)])
    assert len(many) == 30


def test_bad_settings(tmp_path):
    with pytest.raises(ValueError, match="rows_per_shard is 0; expected 1 or more"):
        ShardedExpertDatabase.create(tmp_path / "many", rows_per_shard=0)
    with pytest.raises(ValueError, match="gamma is 2"):
        ShardedExpertDatabase.create(tmp_path / "many", gamma=2)
    many = ShardedExpertDatabase.create(tmp_path / "many")
    with pytest.raises(FileExistsError, match="this one has content. Open it with loads"):
        ShardedExpertDatabase.create(tmp_path / "many")
    with pytest.raises(ValueError, match="workers is 'threads'; expected one of"):
        ShardedExpertDatabase.loads(tmp_path / "many", workers="threads")
    with pytest.raises(ValueError, match="count is 0; at least one worker"):
        ShardedExpertDatabase.loads(tmp_path / "many", workers="process", count=0)
    many.extend(walks(3))
    with pytest.raises(ValueError, match="the query has 2 entries, a state of the database 3"):
        many.retrieve(torch.zeros(4, 2))
    many.sampler.dims = [0, 5]
    with pytest.raises(ValueError, match=r"dims are \[0, 5\], but a state has 3 entries"):
        many.retrieve(torch.zeros(4, 3))


# served while it grows


def test_a_reader_sees_shards_as_they_are_closed(tmp_path):
    plain, writer = both(walks(), tmp_path / "many")
    reader = ShardedExpertDatabase.loads(tmp_path / "many")
    assert len(reader) == 120 - 20  # ten episodes, of two a shard, and two that are in none yet
    select = RetrievalTargetModule(reader, horizon=6, rule="followed", ahead=2, out_keys=NAMES)
    select(TensorDict({"observation": queries()}, [30]))
    assert not reader.refresh()
    for made in (plain, writer):
        made.extend(walks(5, seed=3))
    writer.flush()
    assert_same_answers(plain, reader, queries(), {"rule": "followed", "ahead": 2})
    assert len(reader) == 170
    writer.extend(walks(2, seed=4))
    writer.flush()
    assert reader.refresh() and not reader.refresh()


def test_queries_while_another_thread_adds(tmp_path):
    many = ShardedExpertDatabase.create(
        tmp_path / "many", sampler=RetrievalSampler(**SEARCH), rows_per_shard=30
    )
    many.extend(walks(2))
    reader = ShardedExpertDatabase.loads(tmp_path / "many")
    going, wrong = threading.Event(), []

    def ask():
        while not going.is_set():
            for made in (many, reader):
                try:
                    select = RetrievalTargetModule(made, horizon=6)
                    out = select(TensorDict({"observation": queries()}, [30]))
                    if len(made) and not out["target"].isfinite().all():
                        wrong.append("not finite")
                except Exception as error:  # noqa: BLE001
                    wrong.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    for seed in range(12):
        many.extend(walks(1, seed=seed))
    going.set()
    thread.join()
    assert not wrong and len(many) == 140


def test_a_half_written_shard_is_never_seen(tmp_path, monkeypatch):
    plain, many = both(walks(), tmp_path / "many")

    class Killed(BaseException):
        pass

    def die(*args):
        raise Killed

    rule = {"rule": "followed", "ahead": 2}
    with monkeypatch.context() as patch:  # the shard is there, the list is not yet
        patch.setattr(sharded.ShardList, "write", die)
        with pytest.raises(Killed):
            many.flush()
    assert_same_answers(plain, many, queries(), rule)
    assert (tmp_path / "many" / "shard-000005").exists()
    stage = tmp_path / "many" / ".tmp-shard-000005-half"  # of a kill while files were written
    stage.mkdir()
    after = ShardedExpertDatabase.loads(tmp_path / "many")
    assert len(after) == 100 and after.extend(walks(2, seed=9)).tolist() == list(range(100, 120))
    after.flush()
    assert not stage.exists() and len(ShardedExpertDatabase.loads(tmp_path / "many")) == 120
    assert torch.equal(after[100:]["observation"], walks(2, seed=9)["observation"])
    with pytest.raises(RuntimeError, match="another process has added .* attach"):
        many.flush()


def test_attached_databases(tmp_path):
    plain, _ = both(walks(), tmp_path / "unused")
    many = ShardedExpertDatabase.create(tmp_path / "many", 0.9, sampler=RetrievalSampler(**SEARCH))
    for number, part in enumerate(walks().split(40)):
        filled = ExpertDatabase(LazyTensorStorage(40), gamma=0.9)
        filled.extend(part)
        filled.dumps(tmp_path / f"part-{number}")
        many.attach(tmp_path / f"part-{number}")
    for made in (many, ShardedExpertDatabase.loads(tmp_path / "many")):
        assert made[:]["episode"].tolist() == plain[:]["episode"].tolist()
        assert_same_answers(plain, made, queries(), {"rule": "highest"})
    many.dumps(tmp_path / "copy")
    for number in range(3):
        shutil.rmtree(tmp_path / f"part-{number}")
    copied = ShardedExpertDatabase.loads(tmp_path / "copy")
    assert copied.digest() and (copied[:] == plain[:].exclude("index")).all()
    assert_same_answers(plain, copied, queries(), {"rule": "highest"})


# damaged, foreign, elsewhere


def test_shards_that_do_not_belong_together(tmp_path):
    _, many = both(walks(), tmp_path / "many")
    other = ExpertDatabase(LazyTensorStorage(100), gamma=0.5)
    other.extend(walks(3))
    other.dumps(tmp_path / "gamma")
    with pytest.raises(CheckpointError, match="has gamma 0.5, the other shards have 0.9"):
        many.attach(tmp_path / "gamma")
    other = ExpertDatabase(LazyTensorStorage(100), gamma=0.9)
    other.extend(walks(3, width=2))
    other.dumps(tmp_path / "width")
    with pytest.raises(CheckpointError, match="have 2 entries, those of the other shards 3"):
        many.attach(tmp_path / "width")
    with pytest.raises(FileNotFoundError, match="holds no database"):
        many.attach(tmp_path / "nowhere")
    length = len(many)
    for name in ("gamma", "width"):  # in the place of a shard
        shutil.rmtree(many.shards[1])
        shutil.copytree(tmp_path / name, many.shards[1])
        with pytest.raises(CheckpointError, match="the other shards"):
            ShardedExpertDatabase.loads(tmp_path / "many")
    assert len(many) == length  # what is open stays


def test_a_missing_or_damaged_shard(tmp_path):
    _, many = both(walks(), tmp_path / "many")
    shard = many.shards[2]
    shard.rename(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="shard-000002 is missing, though shards.json lists"):
        ShardedExpertDatabase.loads(tmp_path / "many")
    shutil.copytree(many.shards[1], shard)
    (shard / "rows" / "step.memmap").write_bytes(b"short")
    with pytest.raises(CheckpointError, match="missing, damaged or cut short"):
        ShardedExpertDatabase.loads(tmp_path / "many")
    listed = tmp_path / "many" / "shards.json"
    for text in ("{", "[]", '{"format": 99}', '{"format": 1, "config": {}, "shards": [{}]}'):
        listed.write_text(text)
        with pytest.raises(CheckpointError, match="shards.json"):
            ShardedExpertDatabase.loads(tmp_path / "many")
    with pytest.raises(
        FileNotFoundError, match="holds no sharded database: shards.json is missing"
    ):
        ShardedExpertDatabase.loads(tmp_path)


def test_another_database_in_its_place(tmp_path):
    _, many = both(walks(), tmp_path / "many")
    many.flush()
    content = json.loads((tmp_path / "many" / "shards.json").read_text())
    (tmp_path / "many" / "shards.json").write_text(
        json.dumps({**content, "shards": content["shards"][1:]})
    )
    with pytest.raises(RuntimeError, match="holds another database than when it was opened"):
        many.retrieve(queries())


def test_copies_pass_the_folder(tmp_path):
    plain, many = both(walks(), tmp_path / "many")
    assert copy.deepcopy(many) is many and copy.copy(many) is many
    select = RetrievalTargetModule(many, rule="followed", horizon=6, ahead=2)
    assert copy.deepcopy(select).database is many and not list(select.state_dict())
    sent = pickle.dumps(select)
    assert len(sent) < 20_000
    again = pickle.loads(sent).database
    assert len(again) == 120  # what was in no shard yet went into one
    assert_same_answers(plain, again, queries(), {"rule": "followed", "ahead": 2})
    assert again.digest() == many.digest()
    shutil.move(tmp_path / "many", tmp_path / "moved")
    with pytest.raises(FileNotFoundError, match="on another machine needs it under the same path"):
        pickle.loads(sent)


# elsewhere


def assert_workers_serve(workers, folder):
    plain, many = both(walks(), folder, workers=workers)
    states = torch.cat([queries(), torch.full((1, 3), torch.nan)])
    for rule in RULES:
        assert_same_answers(plain, many, states, rule)
    for made in (plain, many):
        made.extend(walks(6, seed=3))  # more shards for the same workers
    assert_same_answers(plain, many, states, RULES[-1])
    return plain, many, states


def assert_a_hidden_shard_is_named(many, states):
    many.extend(walks(2, seed=8))
    many.flush()
    many.shards[-1].rename(many.folder / "elsewhere")  # before the workers have opened it
    with pytest.raises(CheckpointError, match=f"{many.shards[-1].name} is missing.* shared drive"):
        many.retrieve(states)
    many.close()


def test_shards_in_several_processes(tmp_path):
    plain, many, states = assert_workers_serve("process", tmp_path / "many")
    for process in many.sampler.homes[0].pool._processes.values():
        process.kill()
    with pytest.raises(RuntimeError, match="a process that searches shards ended: it was killed"):
        many.retrieve(states)
    many.sampler.count = 1
    assert_same_answers(plain, many, states, RULES[-1])  # by a new one
    assert_a_hidden_shard_is_named(many, states)


def test_shards_in_ray_actors(ray, tmp_path, monkeypatch):
    _, many, states = assert_workers_serve("ray", tmp_path / "many")
    with monkeypatch.context() as ended:
        ended.setattr(ray, "kill", lambda actor: pytest.fail("Ray has ended"))
        ended.setattr(ray, "is_initialized", lambda: False)
        many.sampler.homes[0].close()
    assert_a_hidden_shard_is_named(many, states)


def test_ray_is_an_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ray", None)
    _, many = both(walks(), tmp_path / "many", workers="ray")
    with pytest.raises(ImportError, match=r'pip install "torchrl_rad\[ray\]"'):
        many.retrieve(queries())
