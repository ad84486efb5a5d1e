import pickle
import threading
import time
import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyMemmapStorage, LazyTensorStorage

from torchrl_rad import (
    ExpertDatabase,
    RetrievalSampler,
    RetrievalTargetModule,
    episode_length,
    return_to_go,
)
from torchrl_rad.data.growth import evicted, stored_lengths

storages = pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])


def episodes(lengths, seed=0, reward=None, ids=None):
    """Whole episodes of random states."""
    generator = torch.Generator().manual_seed(seed)
    count = sum(lengths)
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    if reward is None:
        reward = torch.rand(count, generator=generator)
    following = {"reward": torch.as_tensor(reward).reshape(-1, 1).float(), "done": done}
    steps = {"observation": torch.randn(count, 3, generator=generator), "next": following}
    if ids is not None:
        steps["episode"] = torch.repeat_interleave(torch.tensor(ids), torch.tensor(lengths))
    return TensorDict(steps, [count])


def database(lengths=(4, 3, 5), storage=LazyTensorStorage, capacity=50, **settings):
    search = {"metric": "euclidean", "k": 5, "threshold": 0.0, **settings.pop("search", {})}
    sampler = RetrievalSampler(**search)
    made = ExpertDatabase(storage(capacity), 0.9, sampler=sampler, **settings)
    made.extend(episodes(lengths))
    return made


def equal(one, other):
    """The same rows, wherever they lie."""
    keys = set(one.keys(True, True)) - {"index"}
    assert keys == set(other.keys(True, True)) - {"index"}
    return all(torch.equal(one[key], other[key]) for key in keys)


# another reward


@storages
@pytest.mark.parametrize("column", [False, True])
def test_relabelled_is_as_if_filled_with_that_reward(storage, column):
    made, steps = database(storage=storage), episodes((4, 3, 5))
    reward = (steps["observation"][:, :1] > 0).float()
    made.relabel(reward[:, 0] if column else lambda rows: rows["observation"][:, :1] > 0)
    steps["next", "reward"] = reward
    fresh = ExpertDatabase(LazyTensorStorage(50), 0.9)
    fresh.extend(steps)
    assert equal(made[:], fresh[:]) and reward.any() and not reward.all()


def test_the_reward_of_before_is_kept_and_comes_back():
    made = database()
    before = made[:].clone()
    made.relabel(torch.ones(12), keep="first")
    assert torch.equal(made[:]["first", "reward"], before["next", "reward"])
    assert torch.equal(made[:]["first", "return_to_go"], before["return_to_go"])
    made.relabel(("first", "reward"))
    assert equal(made[:].exclude("first"), before)
    # the same name again
    made.relabel(torch.zeros(12), keep="first")
    assert torch.equal(made[:]["first", "return_to_go"], before["return_to_go"])


def test_relabelled_rows_are_saved_sent_and_extended(tmp_path):
    made = database()
    made.dumps(tmp_path / "old")
    digest = made.digest()
    made.relabel(torch.ones(12), keep="first")
    assert made.digest() != digest
    other = pickle.loads(pickle.dumps(made))  # what lies there is old
    assert equal(other[:], made[:]) and other.path != tmp_path / "old"
    made.dumps(tmp_path / "new")
    loaded = ExpertDatabase.loads(tmp_path / "new")
    assert loaded.digest() == made.digest() and equal(loaded[:], made[:])
    loaded.extend(episodes((2,), seed=1))
    rows = loaded[:][12:]
    assert torch.equal(rows["first", "reward"], rows["next", "reward"])
    assert torch.equal(rows["first", "return_to_go"], rows["return_to_go"])


def test_a_memory_mapped_file_stays_as_it_is(tmp_path):
    database().dumps(tmp_path / "rows")
    opened = ExpertDatabase.loads(tmp_path / "rows", memmap=True)
    digest = opened.digest()
    opened.relabel(torch.full((12,), 7.0))
    assert opened[:]["next", "reward"].unique() == 7 and opened.digest() != digest
    assert ExpertDatabase.loads(tmp_path / "rows").digest() == digest


def test_a_policy_in_use_follows_the_new_reward():
    made = database(lengths=(2, 2))
    names = ["target", "found", "similarity", "target_return", "target_index"]
    select = RetrievalTargetModule(made, 2, out_keys=names)
    query = TensorDict({"observation": torch.zeros(1, 3)}, [1])
    for best in (3, 0, 2):
        reward = torch.zeros(4)
        reward[best] = 1.0
        made.relabel(reward)
        out = select(query.clone())
        assert out["target_index"] == best and out["target_return"] == 1.0


def test_a_million_rows_take_seconds():
    # as many rows, not as much time: returns go by steps of an episode, not by rows
    lengths = [1000] * 300
    rows = episodes(lengths)
    made = ExpertDatabase(LazyTensorStorage(300_000), 0.9)
    made.extend(rows)
    reward = torch.rand(300_000)
    made.relabel(reward)
    expected = return_to_go(reward, torch.tensor(lengths), 0.9)
    assert torch.equal(made[:]["return_to_go"], expected)


@pytest.mark.parametrize(
    "reward, error, message",
    [
        (torch.ones(11), ValueError, r"is \[11\]; expected one a row, \[12, 1\] or \[12\]"),
        (torch.ones(12, 2), ValueError, r"the reward is \[12, 2\]"),
        (lambda rows: torch.ones(3), ValueError, r"the reward is \[3\]"),
        (lambda rows: 1.0, TypeError, "must be a tensor, a function of the rows or the name"),
        (3, TypeError, "got int"),
        ("other", KeyError, r"other.* is no entry of the database; it has.*observation"),
        (("first", "reward"), KeyError, "is no entry"),
        (torch.full((12,), torch.nan), ValueError, r"episode 0"),
        (torch.tensor([0.0] * 8 + [torch.inf] + [0.0] * 3), ValueError, r"episode 2.*step 1"),
    ],
)
def test_a_reward_that_is_none(reward, error, message):
    made = database()
    before, version = made[:].clone(), made.version
    with pytest.raises(error, match=message):
        made.relabel(reward)
    assert equal(made[:], before) and made.version == version


def test_a_name_that_is_taken():
    made = database()
    for name in ("observation", "next", "episode"):
        with pytest.raises(ValueError, match=f"keep is '{name}', which is a column"):
            made.relabel(torch.ones(12), keep=name)
    with pytest.raises(RuntimeError, match="empty"):
        ExpertDatabase().relabel(torch.ones(1))


# demonstrations that go


@storages
@pytest.mark.parametrize("gone", [[1], [0], [2], [0, 2], [], [0, 1, 2]])
def test_forgotten_is_as_if_never_added(storage, gone, tmp_path):
    made, steps = database(storage=storage), episodes((4, 3, 5), ids=[0, 1, 2])
    assert made.forget(gone) == sum((4, 3, 5)[i] for i in gone)
    keep = ~torch.isin(steps["episode"], torch.tensor(gone, dtype=torch.int64))
    assert len(made) == keep.sum()
    if not len(made):
        return
    fresh = ExpertDatabase(LazyTensorStorage(50), 0.9, sampler=made.sampler)
    fresh.extend(steps[keep])
    assert equal(made[:], fresh[:]) and made.digest() == fresh.digest()
    hits = made.retrieve(steps["observation"])
    assert torch.isin(hits["episode"], made[:]["episode"].unique()).all()
    made.dumps(tmp_path / "rows")
    loaded = ExpertDatabase.loads(tmp_path / "rows")
    assert set(loaded[:]["episode"].tolist()) == {0, 1, 2} - set(gone)


@storages
def test_no_file_holds_what_was_forgotten(storage, tmp_path):
    where = {"scratch_dir": tmp_path / "scratch"} if storage is LazyMemmapStorage else {}
    made = ExpertDatabase(storage(50, **where))
    steps = episodes((4, 3), ids=[0, 1])
    secret = 123.456
    steps["observation"][:4] = secret
    made.extend(steps)
    made.dumps(tmp_path / "rows")
    made.forget([0])
    made.dumps(tmp_path / "rows")
    pattern = torch.full((1,), secret).numpy().tobytes()
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files and not any(pattern in path.read_bytes() for path in files)


def test_unknown_episodes_are_named_and_nothing_goes():
    made = database()
    with pytest.raises(KeyError, match=r"episodes \[7, 9\] are not in the database"):
        made.forget([1, 7, 9])
    assert len(made) == 12
    with pytest.raises(KeyError, match=r"episodes \[1\] are not"):
        ExpertDatabase().forget([1])


def test_a_memory_mapped_database_forgets_nothing(tmp_path):
    database().dumps(tmp_path / "rows")
    opened = ExpertDatabase.loads(tmp_path / "rows", memmap=True)
    with pytest.raises(RuntimeError, match=r"opened with memmap=True cannot change; open it with"):
        opened.forget([1])
    assert len(opened) == 12


def test_an_episode_that_is_being_followed():
    made = database(lengths=(3, 3))
    names = ["target", "found", "similarity", "target_return", "target_index"]
    select = RetrievalTargetModule(made, 3, retrieval_interval=9, out_keys=names)
    state = made[:]["observation"][:1].clone()

    def step(kept, first):
        entries = {"observation": state, "is_init": torch.tensor([[first]]), "retrieval": kept}
        out = select(TensorDict(entries, [1]))
        return out, {"kept": out["next", "retrieval", "kept"]}

    made.relabel(torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0, 1.0]))
    out, kept = step({"kept": torch.zeros(1, 5, dtype=torch.float64)}, True)
    assert out["target_index"] == 2
    again, kept = step(kept, False)
    assert again["target_index"] == 2
    made.forget([0])
    after, _ = step(kept, False)
    assert after["found"] and torch.equal(after["target"][0], made[:]["observation"][2])
    assert after["target_return"] == 1.0


# room


def test_oldest_and_worst_give_way():
    oldest = database(lengths=(4, 3, 5), capacity=12, evict="oldest")
    oldest.extend(episodes((2,), seed=1, ids=[9]))
    assert oldest[:]["episode"].unique().tolist() == [1, 2, 9]
    worst = database(lengths=(4, 3, 5), capacity=12, evict="lowest_return")
    worst.relabel(torch.tensor([1.0] * 4 + [0.0] * 3 + [1.0] * 5))
    worst.extend(episodes((2,), seed=1, ids=[9]))
    assert worst[:]["episode"].unique().tolist() == [0, 2, 9]
    # more than one goes where one is not enough
    oldest.extend(episodes((9,), seed=2, ids=[11]))
    assert oldest[:]["episode"].unique().tolist() == [9, 11] and len(oldest) == 11


@pytest.mark.parametrize("rule", ["oldest", "lowest_return"])
def test_evicted_frees_what_is_needed_and_no_episode_more(rule):
    made = database(lengths=(4, 3, 5, 1, 2))
    rows = made[:]
    for needed in range(1, 16):
        gone = evicted(rows, needed, rule)
        lengths = stored_lengths(rows).tolist()
        parts = [part.unique().tolist() for part in gone.split(lengths)]
        assert all(len(part) == 1 for part in parts) and gone.sum() >= needed
        chosen = [i for i, part in enumerate(parts) if part[0]]
        start = (rows["step"] == 0).nonzero()[:, 0]
        value = rows["return_to_go"][start].tolist()
        order = sorted(range(5), key=value.__getitem__ if rule == "lowest_return" else None)
        assert sorted(order[: len(chosen)]) == chosen
        assert sum(lengths[i] for i in order[: len(chosen) - 1]) < needed


def test_what_never_fits_is_refused_and_nothing_goes():
    made = database(capacity=12, evict="oldest")
    with pytest.raises(ValueError, match="13 rows do not fit: the storage has room for 12"):
        made.extend(episodes((6, 7), seed=1))
    assert len(made) == 12
    with pytest.raises(ValueError, match="1 rows do not fit"):
        database(capacity=12).extend(episodes((1,), seed=1))
    with pytest.raises(ValueError, match="evict is 'newest'; expected one of"):
        ExpertDatabase(evict="newest")


def test_eviction_is_saved(tmp_path):
    made = database(capacity=12, evict="oldest")
    made.dumps(tmp_path / "rows")
    loaded = ExpertDatabase.loads(tmp_path / "rows")
    loaded.extend(episodes((2,), seed=1))
    assert len(loaded) == 10


# growing


def test_an_episode_that_comes_twice_is_named():
    made = database(lengths=(4, 3))
    with pytest.warns(UserWarning, match=r"1 episodes .* episode 5 has the states of episode 1"):
        made.extend(torch.cat([episodes((2,), 3, ids=[4]), episodes((4, 3), ids=[8, 5])[4:]]))
    assert made.forget([5]) == 3
    twice = torch.cat([episodes((2,), 9, ids=[6]), episodes((2,), 9, ids=[7])])
    with pytest.warns(UserWarning, match=r"1 episodes .* episode 7 has the states of episode 6"):
        made.extend(twice)
    with pytest.warns(UserWarning, match=r"1 episodes .* episode 7 has the states of episode 6"):
        ExpertDatabase(LazyTensorStorage(9)).extend(twice)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made.extend(episodes((4, 3), seed=7))


@pytest.mark.parametrize("backend", ["auto", "tree", "scan"])
@pytest.mark.parametrize("settings", [{}, {"dims": [0, 2]}, {"normalize": True}])
def test_grown_answers_as_one_that_was_filled_at_once(backend, settings):
    search = {"backend": backend, **settings}
    made = database(lengths=(30,) * 10, capacity=2000, search=search)
    select = RetrievalTargetModule(made, 9)
    parts = [made[:].select("observation", "next", "episode").clone()]
    for number in range(8):
        query = torch.randn(6, 3, generator=torch.Generator().manual_seed(number))
        made.retrieve(query)  # the search structure is built
        parts.append(episodes((3, 20), seed=100 + number))
        parts[-1]["episode"] = torch.tensor([0] * 3 + [1] * 20) + 1000 + 2 * number
        made.extend(parts[-1])
        whole = ExpertDatabase(
            LazyTensorStorage(2000), 0.9, sampler=RetrievalSampler(**made.sampler.config)
        )
        whole.extend(torch.cat(parts))
        one, other = made.retrieve(query), whole.retrieve(query)
        assert equal(one, other) and torch.equal(one["index"], other["index"])
        batch = TensorDict({"observation": query}, [6])
        expected = RetrievalTargetModule(whole, 9)(batch.clone())
        assert equal(select(batch.clone()), expected)


def test_the_search_structure_is_kept_while_it_grows():
    made = database(lengths=(30,) * 10, capacity=2000)
    first = made.sampler.build(made.storage)
    made.extend(episodes((20,), seed=1))
    second = made.sampler.build(made.storage)
    assert second.first is first and second is made.sampler.build(made.storage)
    made.extend(episodes((20,), seed=2))
    assert made.sampler.build(made.storage).first is first
    made.extend(episodes((200,), seed=3))
    third = made.sampler.build(made.storage)
    assert len(third.rows) == 540 and not hasattr(third, "first")
    # rows that were there change: all anew
    made.extend(episodes((20,), seed=4))
    made[0] = made[:][0].clone()
    assert not hasattr(made.sampler.build(made.storage), "first")


def test_expert_rule_and_refused_episodes_leave_the_rows_alone():
    made = database(lengths=(2, 2), expert=episode_length(2))
    made.retrieve(torch.zeros(1, 3))
    broken = episodes((2,), seed=1)
    broken["observation"][1, 0] = torch.nan
    for bad in (episodes((3,), seed=1), broken, episodes((2,), seed=1)[:1]):
        with pytest.raises(ValueError):
            made.extend(bad)
    assert len(made) == 4
    made.extend(episodes((3, 2), seed=1))
    assert len(made) == 6 and made.retrieve(torch.zeros(1, 3))["index"].max() == 5


def test_served_while_it_grows_and_forgets():
    made = database(lengths=(10,) * 5, capacity=400, evict="oldest")
    names = ["target", "found", "similarity", "target_return", "target_index", "target_offset"]
    select = RetrievalTargetModule(made, 5, out_keys=names)
    made.relabel(torch.ones(50))
    faults, stop, asked = [], threading.Event(), [0]

    def serve():
        generator = torch.Generator().manual_seed(0)
        while not stop.is_set():
            query = torch.randn(4, 3, generator=generator)
            with made.lock:  # what was chosen and what there is, of one moment
                out = select(TensorDict({"observation": query}, [4]))
                rows = made[:]
                index = out["target_index"][:, 0]
                target, value = rows["observation"][index], rows["return_to_go"][index]
                left = rows["remaining"]
                whole = bool((left.diff()[left[:-1] > 0] == -1).all()) and left[-1] == 0
            asked[0] += 1
            if not (torch.equal(out["target"], target) and whole):
                faults.append("rows of different moments")
            if not torch.equal(out["target_return"][:, 0], value):
                faults.append("returns of different moments")

    threads = [threading.Thread(target=serve) for _ in range(2)]
    for thread in threads:
        thread.start()
    for number in range(60):
        made.extend(episodes((7, 9), seed=number + 10, ids=[1000 + 2 * number, 1001 + 2 * number]))
        if number % 5 == 0:
            made.forget([int(made[:]["episode"][0])])
        if number % 7 == 0:
            made.relabel(torch.rand(len(made)))
        while asked[0] < number:  # every state of the database is asked about
            time.sleep(0.001)
    stop.set()
    for thread in threads:
        thread.join()
    assert not faults and asked[0] >= 59 and len(made) <= 400


def test_extended_while_it_is_saved(tmp_path):
    made = database(lengths=(10,) * 5, capacity=5000)
    stop = threading.Event()

    def grow():
        number = 0
        while not stop.is_set():
            number += 1
            made.extend(episodes((5,), seed=number, ids=[10_000 + number]))
            time.sleep(0.001)

    thread = threading.Thread(target=grow)
    thread.start()
    sizes = []
    for number in range(5):
        made.dumps(tmp_path / str(number))
        loaded = ExpertDatabase.loads(tmp_path / str(number))
        sizes.append(len(loaded))
        assert (loaded[:]["remaining"][-1] == 0) and len(loaded) % 5 == 0
        assert loaded.digest() == ExpertDatabase.loads(tmp_path / str(number)).digest()
    stop.set()
    thread.join()
    assert sizes == sorted(sizes)
