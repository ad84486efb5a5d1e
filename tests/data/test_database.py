"""Filling, asking and sharing an expert database."""

import copy
import multiprocessing
import pickle
import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ListStorage
from torchrl.data.replay_buffers import Sequence
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_rad.data import (
    ExpertDatabase,
    episode_length,
    first_hit_within,
    reaches_goal,
    top_share_by_return,
)
from torchrl_rad.retrieval import RetrievalSampler

STORAGES = [LazyTensorStorage, LazyMemmapStorage]


def make_steps(rewards, offset=0.0, width=1):
    """Episodes of the given rewards; states count up by 1 from ``offset`` over all rows."""
    reward = torch.tensor([r for episode in rewards for r in episode], dtype=torch.float32)
    done = torch.cat([torch.arange(len(e)) == len(e) - 1 for e in rewards])
    state = torch.arange(len(reward), dtype=torch.float32)[:, None].repeat(1, width) + offset
    return TensorDict(
        {
            "observation": state,
            "action": torch.zeros(len(reward), 2),
            "next": {"reward": reward[:, None], "done": done[:, None]},
        },
        [len(reward)],
    )


def make_database(rewards, storage=LazyTensorStorage, capacity=100, **kwargs):
    sampler = kwargs.pop("sampler", None) or RetrievalSampler("euclidean", k=3, threshold=0.0)
    database = ExpertDatabase(storage(capacity), sampler=sampler, **kwargs)
    database.extend(make_steps(rewards))
    return database


# filling


@pytest.mark.parametrize("storage", STORAGES)
def test_columns_by_hand(storage):
    database = make_database([[0, 0, 1], [2, 4]], storage, gamma=0.5)
    rows = database[:]
    assert rows["episode"].tolist() == [0, 0, 0, 1, 1]
    assert rows["step"].tolist() == [0, 1, 2, 0, 1]
    assert rows["remaining"].tolist() == [2, 1, 0, 1, 0]
    assert rows["return_to_go"].tolist() == [0.25, 0.5, 1.0, 4.0, 4.0]
    for key in ("episode", "step", "remaining"):
        assert rows[key].dtype == torch.int64 and rows[key].shape == (5,)
    assert rows["return_to_go"].dtype == torch.float32
    assert rows["action"].shape == (5, 2)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.lists(st.floats(-10, 10, width=32), min_size=1, max_size=12), min_size=1, max_size=5
    ),
    st.floats(0, 1),
)
def test_return_to_go_recursion(rewards, gamma):
    rows = make_database(rewards, gamma=gamma)[:]
    value, reward = rows["return_to_go"].double(), rows["next", "reward"][:, 0].double()
    following = torch.cat([value[1:], value.new_zeros(1)])
    following = torch.where(rows["remaining"] == 0, 0.0, following)
    torch.testing.assert_close(value, reward + gamma * following, rtol=1e-5, atol=1e-4)


def test_return_is_summed_in_float64():
    # in float32 the thousand small rewards vanish beside the large one
    rows = make_database([[1e-4] * 1000 + [3e4]], capacity=2000, gamma=1.0)[:]
    assert rows["return_to_go"][0].item() == pytest.approx(30000.1, abs=2e-3)


def test_input_is_left_as_it_is():
    steps = make_steps([[0, 1], [1]])
    before = steps.clone()
    ExpertDatabase(LazyTensorStorage(5), expert=episode_length(2)).extend(steps)
    assert set(steps.keys(True, True)) == set(before.keys(True, True))
    assert (steps == before).all()


def test_extend_in_several_goes_equals_one():
    rewards = [[0, 1], [1, 0, 2], [3]]
    whole = make_database(rewards)
    parts = ExpertDatabase(LazyTensorStorage(100), sampler=RetrievalSampler("euclidean", k=3))
    assert parts.extend(make_steps(rewards[:1])).tolist() == [0, 1]
    assert parts.extend(make_steps(rewards[1:], offset=2.0)).tolist() == [2, 3, 4, 5]
    columns = ("observation", "episode", "step", "remaining", "return_to_go")
    assert (whole[:].select(*columns) == parts[:].select(*columns)).all()


def test_clashing_episode_ids_are_shifted():
    database = ExpertDatabase(LazyTensorStorage(20))
    steps = make_steps([[0, 1], [1]])
    steps["episode"] = torch.tensor([7, 7, 9])
    database.extend(steps)
    database.extend(steps)
    database.extend(steps.clone().set("episode", torch.tensor([3, 3, 4])))  # free: kept
    assert database[:]["episode"].tolist() == [7, 7, 9, 10, 10, 12, 3, 3, 4]
    assert database[:]["remaining"].tolist() == [1, 0, 0] * 3


def test_ids_given_outrank_done():
    steps = make_steps([[0, 1, 2, 3]])
    steps["episode"] = torch.tensor([[5], [5], [6], [6]])
    database = ExpertDatabase(LazyTensorStorage(20), gamma=1.0)
    database.extend(steps)
    assert database[:]["return_to_go"].tolist() == [1, 1, 5, 3]
    assert database[:]["episode"].tolist() == [5, 5, 6, 6]


@pytest.mark.parametrize(
    ("rule", "kept"),
    [
        (None, [0, 1, 2]),
        (episode_length(2), [0, 2]),
        (reaches_goal() & episode_length(2), [2]),
        (reaches_goal() | episode_length(2), [0, 1, 2]),
        (~episode_length(2), [1]),
        (first_hit_within(2, 3), [2]),
        (top_share_by_return(0.3), [1]),
        (lambda episode: len(episode) == 3, [1]),
    ],
)
def test_expert_rule(rule, kept):
    database = make_database([[0, 0], [1, 1, 1], [0, 2]], expert=rule)
    assert sorted(set(database[:]["episode"].tolist())) == kept
    assert (database[:]["step"] == 0).sum() == len(kept)


def test_nested_state_key():
    sampler = RetrievalSampler("euclidean", k=1, threshold=0.0, key=("agent", "state"))
    database = ExpertDatabase(LazyTensorStorage(5), sampler=sampler)
    steps = make_steps([[0, 1, 0]])
    steps.rename_key_("observation", ("agent", "state"))
    database.extend(steps)
    assert database.width == 1
    hits = database.retrieve(torch.tensor([[1.9]]))
    assert hits["index"].tolist() == [[2]] and hits["agent", "state"].tolist() == [[[2.0]]]


# what a collector gives


def collected(rows, length):
    """[rows, length] as a collector gives it; every row holds two trajectories."""
    half = length // 2
    ids = torch.arange(2 * rows).reshape(rows, 2).repeat_interleave(half, 1)
    done = torch.zeros(rows, length, 1, dtype=torch.bool)
    done[:, [half - 1, length - 1]] = True
    state = torch.arange(rows * length, dtype=torch.float32).reshape(rows, length, 1)
    return TensorDict(
        {
            "observation": state,
            "action": torch.zeros(rows, length, 1),
            "is_init": torch.zeros(rows, length, 1, dtype=torch.bool),
            "collector": {"traj_ids": ids},
            "next": {
                "observation": state + 1,
                "reward": torch.ones(rows, length, 1),
                "done": done,
                "terminated": done.clone(),
            },
        },
        [rows, length],
    )


def test_collected_batch():
    database = ExpertDatabase(LazyTensorStorage(100), gamma=1.0)
    database.extend(collected(2, 6).reshape(-1))
    assert database[:]["episode"].tolist() == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3
    assert database[:]["return_to_go"].tolist() == [3, 2, 1] * 4
    database.extend(collected(2, 6).reshape(-1))
    assert database[:]["episode"].unique().tolist() == list(range(8))


def test_collected_batch_that_is_cut():
    batch = collected(2, 6)[:, :5].reshape(-1)
    match = r"begins at row 3 has no end.*last row, 4.*trajs_per_batch"
    with pytest.raises(ValueError, match=match):
        ExpertDatabase(LazyTensorStorage(100)).extend(batch)
    # without ids, the cut episode would have run on into the next row's
    assert ExpertDatabase(LazyTensorStorage(100)).extend(batch[:3]).tolist() == [0, 1, 2]


def test_collected_batch_that_is_not_flat():
    with pytest.raises(ValueError, match=r"got \[2, 6\]\. Pass td\.reshape\(-1\)"):
        ExpertDatabase(LazyTensorStorage(100)).extend(collected(2, 6))


@pytest.mark.filterwarnings("ignore")
def test_collector_fills_it():
    torch.manual_seed(0)
    sampler = RetrievalSampler("euclidean", k=3, threshold=0.0)
    database = ExpertDatabase(LazyTensorStorage(100), gamma=1.0, sampler=sampler)
    env = TransformedEnv(ContinuousActionVecMockEnv(), StepCounter(max_steps=4))
    collector = Collector(
        SerialEnv(2, lambda: env),
        frames_per_batch=8,
        total_frames=24,
        trajs_per_batch=2,
        traj_format="cat",
        replay_buffer=database,
    )
    for batch in collector:
        assert batch is None
    collector.shutdown()
    rows = database[:]
    lengths = rows["episode"].unique_consecutive(return_counts=True)[1]
    assert len(lengths) >= 4 and len(rows["episode"].unique()) == len(lengths)
    assert torch.equal(rows["remaining"] == 0, rows["next", "done"][:, 0])
    hits = database.retrieve(rows["observation"])
    assert torch.equal(hits["index"][:, 0], torch.arange(len(rows)))


# bad input


def test_list_of_episodes():
    with pytest.raises(TypeError, match=r"got list; join .* torch\.cat"):
        ExpertDatabase(LazyTensorStorage(9)).extend([make_steps([[1]])])


def test_single_steps_are_refused():
    with pytest.raises(NotImplementedError, match=r"whole episodes.*extend\(\)"):
        ExpertDatabase(LazyTensorStorage(9)).add(make_steps([[1]])[0])


def test_empty_table():
    with pytest.raises(ValueError, match="a table with no step"):
        ExpertDatabase(LazyTensorStorage(9)).extend(make_steps([[1]])[:0])


@pytest.mark.parametrize("key", ["observation", ("next", "reward")])
def test_missing_key(key):
    with pytest.raises(KeyError, match=f"steps need the entry .*{key[-3:]}.*next.done"):
        ExpertDatabase(LazyTensorStorage(9)).extend(make_steps([[1]]).exclude(key))


def test_no_way_to_tell_episodes_apart():
    with pytest.raises(KeyError, match="to tell episodes apart"):
        ExpertDatabase(LazyTensorStorage(9)).extend(make_steps([[1]]).exclude(("next", "done")))


def test_episode_without_end():
    with pytest.raises(ValueError, match="begins at row 2 has no end.*whole episodes"):
        ExpertDatabase(LazyTensorStorage(9)).extend(make_steps([[1, 1], [1, 1]])[:3])


def test_scattered_episode():
    steps = make_steps([[1, 1, 1]])
    steps["episode"] = torch.tensor([4, 5, 4])
    with pytest.raises(ValueError, match="episode 4 do not lie together"):
        ExpertDatabase(LazyTensorStorage(9)).extend(steps)


@pytest.mark.parametrize("key", ["observation", "action", ("next", "reward")])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_not_finite(key, value):
    steps = make_steps([[1, 1], [1, 1, 1]])
    steps["episode"] = torch.tensor([8, 8, 9, 9, 9])
    steps[key][3, -1] = value
    database = ExpertDatabase(LazyTensorStorage(9))
    with pytest.raises(ValueError, match=r"NaN or Inf in 1 row.*episode 9 at step 1; remove"):
        database.extend(steps)
    assert len(database) == 0


def test_wrong_width():
    database = make_database([[1, 1]])
    with pytest.raises(ValueError, match=r"'observation' is torch.float32 \[T, 3\].*\[N, 1\]"):
        database.extend(make_steps([[1, 1]], width=3))
    assert len(database) == 2


def test_wrong_dtype():
    steps = make_steps([[1, 1]])
    with pytest.raises(ValueError, match=r"must be floating point \[T, S\]; got torch.int64"):
        ExpertDatabase(LazyTensorStorage(9)).extend(
            steps.clone().set("observation", torch.ones(2, 1, dtype=torch.int64))
        )
    database = make_database([[1, 1]])
    with pytest.raises(ValueError, match=r"torch.float64.*holds torch.float32.*convert it"):
        database.extend(steps.set("observation", torch.ones(2, 1, dtype=torch.float64)))
    assert len(database) == 2


def test_wrong_shape():
    steps = make_steps([[1, 1]])
    with pytest.raises(ValueError, match=r"floating point \[T, S\]; got torch.float32 \[2, 1, 1\]"):
        ExpertDatabase(LazyTensorStorage(9)).extend(
            steps.clone().set("observation", torch.ones(2, 1, 1))
        )
    with pytest.raises(ValueError, match=r"one number a step, \[T, 1\]; got \[2, 2\]"):
        ExpertDatabase(LazyTensorStorage(9)).extend(
            steps.clone().set(("next", "reward"), torch.ones(2, 2))
        )
    with pytest.raises(ValueError, match="'episode' must be one whole number a step"):
        ExpertDatabase(LazyTensorStorage(9)).extend(steps.clone().set("episode", torch.ones(2)))


def test_other_columns_than_before():
    database = make_database([[1, 1]])
    steps = make_steps([[1]]).exclude("action").set(("next", "extra"), torch.zeros(1))
    with pytest.raises(KeyError, match=r"\['action'\] missing, \['next.extra'\] new"):
        database.extend(steps)
    assert len(database) == 2 and database.retrieve(torch.zeros(1))["valid"].sum() == 2


def test_no_expert_left():
    rule = first_hit_within(200, 300)
    with pytest.raises(ValueError, match=r"none of the 2 episodes.*first_hit_within\(200, 300\)"):
        make_database([[1], [0, 1]], expert=rule)


@pytest.mark.parametrize("storage", STORAGES)
def test_over_capacity(storage):
    database = make_database([[1, 1, 1]], storage, capacity=5)
    with pytest.raises(ValueError, match="3 rows do not fit: .* room for 5, of which 3 are taken"):
        database.extend(make_steps([[1, 1, 1]]))
    assert database[:]["observation"].flatten().tolist() == [0, 1, 2]
    database.extend(make_steps([[1, 1]]))
    assert len(database) == 5


@pytest.mark.parametrize("gamma", [-0.1, 1.01, float("nan")])
def test_gamma_out_of_range(gamma):
    with pytest.raises(ValueError, match=r"gamma is .*\[0, 1\]"):
        ExpertDatabase(LazyTensorStorage(9), gamma=gamma)


def test_foreign_sampler():
    with pytest.raises(TypeError, match="must be a RetrievalSampler, got RandomSampler"):
        ExpertDatabase(LazyTensorStorage(9), sampler=RandomSampler())


@pytest.mark.parametrize("storage", [ListStorage(9), 9, make_steps([[1]])])
def test_foreign_storage(storage):
    with pytest.raises(TypeError, match="storage must be a LazyTensorStorage .*, got "):
        ExpertDatabase(storage)


# asking


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (2, 1, 2), (0,)])
def test_retrieve_shapes(storage, shape):
    database = make_database([[0, 1, 0]], storage)
    hits = database.retrieve(torch.ones(*shape, 1))
    assert hits.batch_size == (*shape, 3)
    assert hits["index"].shape == hits["similarity"].shape == hits["valid"].shape == (*shape, 3)
    assert hits["index"].dtype == torch.int64
    assert hits["similarity"].dtype == torch.float32
    assert hits["valid"].dtype == torch.bool
    assert hits["observation"].shape == (*shape, 3, 1)
    assert hits["next", "reward"].shape == (*shape, 3, 1)


def test_retrieve_for_no_query():
    database = make_database([[0, 1]], sampler=RetrievalSampler("cosine", k=3, backend="scan"))
    hits = database.retrieve(torch.ones(0, 1))
    assert hits.batch_size == (0, 3) and hits["observation"].shape == (0, 3, 1)


@pytest.mark.parametrize("storage", STORAGES)
def test_retrieve_contents(storage):
    sampler = RetrievalSampler("euclidean", k=3, threshold=0.5)
    database = make_database([[0, 0, 1], [2, 4]], storage, gamma=0.5, sampler=sampler)
    hits = database.retrieve(torch.tensor([[3.0], [0.25], [100.0]]))
    # row 3 is met exactly, rows 2 and 4 are 1 away: similarity 0.5, the lower row first
    assert hits["index"].tolist() == [[3, 2, 4], [0, 1, -1], [-1, -1, -1]]
    assert hits["valid"].tolist() == [[True] * 3, [True, True, False], [False] * 3]
    torch.testing.assert_close(hits["similarity"][0], torch.tensor([1.0, 0.5, 0.5]))
    torch.testing.assert_close(hits["similarity"][1, :2], torch.tensor([0.8, 1 / 1.75]))
    assert hits["return_to_go"].tolist() == [[4, 1, 4], [0.25, 0.5, 0.25], [0.25] * 3]
    assert hits["remaining"].tolist()[0] == [1, 0, 0]
    assert hits["episode"].tolist()[0] == [1, 0, 1]
    assert hits["observation"][0].flatten().tolist() == [3, 2, 4]


def test_k_larger_than_database():
    sampler = RetrievalSampler("euclidean", k=10, threshold=0.0)
    hits = make_database([[0, 1]], sampler=sampler).retrieve(torch.tensor([[0.9]]))
    assert hits["index"].tolist() == [[1, 0] + [-1] * 8]
    assert hits["valid"].sum() == 2 and hits.batch_size == (1, 10)


def test_query_that_is_not_finite():
    database = make_database([[0, 1]])
    hits = database.retrieve(torch.tensor([[float("nan")], [1.0], [float("inf")]]))
    assert hits["valid"].any(-1).tolist() == [False, True, False]
    assert hits["index"][0].tolist() == [-1] * 3


def test_query_of_another_width():
    with pytest.raises(ValueError, match="the query .* 2 entries, .*database 1"):
        make_database([[0, 1]]).retrieve(torch.ones(1, 2))


def test_asking_an_empty_database():
    database = ExpertDatabase(LazyTensorStorage(9))
    with pytest.raises(RuntimeError, match="empty: extend it with episodes"):
        database.retrieve(torch.ones(1))
    with pytest.raises(RuntimeError, match="empty: extend it with episodes"):
        database.sample(2)
    with pytest.raises(RuntimeError, match="empty: extend it with episodes"):
        _ = database.width


def test_emptied_and_filled_again():
    database = make_database([[0, 1, 0]])
    assert database.retrieve(torch.tensor([2.0]))["index"][0] == 2
    database.empty()
    assert len(database) == 0
    database.extend(make_steps([[1, 1]], offset=1.0))
    assert database.retrieve(torch.tensor([2.0]))["index"].tolist() == [1, 0, -1]


def test_later_rows_are_found():
    database = make_database([[0, 1]])
    assert database.retrieve(torch.tensor([5.0]))["index"][0] == 1
    database.extend(make_steps([[0, 1]], offset=5.0))
    assert database.retrieve(torch.tensor([5.0]))["index"][0] == 2
    database[2] = database[2].set("observation", torch.tensor([50.0]))
    assert database.retrieve(torch.tensor([50.0]))["index"][0] == 2


@pytest.mark.parametrize("storage", STORAGES)
def test_samples_rows_uniformly(storage):
    database = make_database([[0, 1, 2], [3]], storage)
    database.set_rng(torch.Generator().manual_seed(0))
    batch = database.sample(4000)
    assert batch.batch_size == (4000,)
    assert torch.equal(batch["observation"][:, 0].long(), batch["index"])
    counts = batch["index"].bincount(minlength=4).double()
    # 16.3: chi-square with 3 degrees of freedom, one in a thousand
    assert ((counts - 1000).square() / 1000).sum() < 16.3


def test_sample_unit_adds_windows():
    database = ExpertDatabase(
        LazyTensorStorage(10), sample_unit=Sequence(2, episode_boundary="pad"), batch_size=6
    )
    database.extend(make_steps([[0, 1], [2, 3]]))
    windows = database.sample().reshape(-1, 2)
    assert windows.batch_size == (6, 2)
    assert (windows["episode"] == windows["episode"][:, :1]).all()


@pytest.mark.parametrize("storage", STORAGES)
def test_state_dict_brings_rows_and_drops_what_was_known_of_others(storage):
    database, other = make_database([[1, 1, 1]], storage), make_database([[0, 2, 0]], storage)
    other[:]["observation"].add_(10.0)
    assert database.retrieve(torch.tensor([10.0]))["index"].tolist() == [2, 1, 0]
    database.load_state_dict(other.state_dict())
    assert database.digest() == other.digest()
    assert database.retrieve(torch.tensor([10.0]))["index"].tolist() == [0, 1, 2]


# identity


def test_digest_tells_contents_apart():
    base = make_database([[0, 1], [2]])
    assert base.digest() == make_database([[0, 1], [2]]).digest()
    assert base.digest() == make_database([[0, 1], [2]], LazyMemmapStorage, 50).digest()
    others = [
        make_database([[0, 1], [3]]),
        make_database([[0, 1, 2]]),
        make_database([[0, 1], [2]], gamma=0.5),
        make_database([[0, 1], [2]], expert=~episode_length(9)),
        make_database([[0, 1], [2]], sampler=RetrievalSampler("euclidean", k=4, threshold=0.0)),
        ExpertDatabase(LazyTensorStorage(100), sampler=base.sampler),
    ]
    changed = make_database([[0, 1], [2]])
    changed[1] = changed[1].set("action", torch.tensor([0.0, 1.0]))
    digests = {base.digest(), changed.digest(), *(other.digest() for other in others)}
    assert len(digests) == 8


def test_copies_share():
    database = make_database([[0, 1]])
    assert copy.deepcopy(database) is database and copy.copy(database) is database
    assert copy.deepcopy({"a": [database]})["a"][0] is database


def test_pickle_opens_memory_mapped_rows():
    database = make_database([[0, 1], [2]], gamma=0.5, batch_size=3, expert=~episode_length(7))
    data = pickle.dumps(database)
    assert len(data) < 1000  # a path, not rows
    other = pickle.loads(data)
    assert type(other.storage._storage["observation"]).__name__ == "MemoryMappedTensor"
    assert other.digest() == database.digest()
    assert other.sample().batch_size == (3,)
    assert (other.retrieve(torch.ones(2, 1)) == database.retrieve(torch.ones(2, 1))).all()
    with pytest.raises(ValueError, match="1 rows do not fit: .*memmap=True cannot grow"):
        other.extend(make_steps([[1]]))


def test_pickle_follows_changes(tmp_path):
    database = make_database([[0, 1]])
    database.dumps(tmp_path / "saved")
    assert str(tmp_path).encode() in pickle.dumps(database)
    database.extend(make_steps([[1]]))
    assert str(tmp_path).encode() not in pickle.dumps(database)
    assert len(pickle.loads(pickle.dumps(database))) == 3


def test_pickle_of_an_empty_database():
    database = ExpertDatabase(LazyTensorStorage(7), gamma=0.3, expert=episode_length(2))
    other = pickle.loads(pickle.dumps(database))
    assert len(other) == 0 and other.gamma == 0.3 and other.storage.max_size == 7
    assert repr(other.expert) == "episode_length(2)"


def _nearest(database, query, queue):
    queue.put(database.retrieve(query)["index"].tolist())


def test_another_process_opens_it():
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    worker = context.Process(
        target=_nearest, args=(make_database([[0, 1, 0]]), torch.tensor([1.8]), queue)
    )
    worker.start()
    try:
        assert queue.get(timeout=120) == [2, 1, 0]
    finally:
        worker.join()


# threads


@pytest.mark.parametrize("storage", STORAGES)
def test_queries_see_whole_episodes(storage):
    length, episodes = 50, 40
    sampler = RetrievalSampler("euclidean", k=length * episodes, threshold=0.0, backend="scan")
    database = ExpertDatabase(storage(length * episodes), sampler=sampler, gamma=1.0)
    database.extend(make_steps([[1.0] * length]))
    stop, seen, faults = threading.Event(), set(), []

    def ask():
        while not stop.is_set():
            hits = database.retrieve(torch.zeros(1))
            hits = hits[hits["valid"]]
            seen.add(len(hits))
            if (hits["return_to_go"] != hits["remaining"] + 1).any() or len(hits) % length:
                faults.append(len(hits))

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for _ in range(episodes - 1):
        database.extend(make_steps([[1.0] * length]))
    stop.set()
    for thread in threads:
        thread.join()
    assert not faults and seen
    assert len(database) == length * episodes


@pytest.mark.parametrize("ask", ["retrieve", "digest", "sample"])
def test_nothing_is_read_between_a_new_length_and_its_rows(ask):
    answers = []

    class Slow(LazyTensorStorage):
        asker = None

        def _get_new_len(self, *args):
            super()._get_new_len(*args)
            if self.asker is not None:  # the storage is longer now, its new rows are not written
                self.asker.start()
                self.asker.join(0.5)
                answers.append("too early" if not self.asker.is_alive() else "waits")

    argument = {"retrieve": torch.zeros(1), "digest": None, "sample": 4}[ask]
    sampler = RetrievalSampler("euclidean", k=3, threshold=0.0)
    database = ExpertDatabase(Slow(10), gamma=1.0, sampler=sampler)
    database.extend(make_steps([[1, 1]], offset=5.0))

    def run():
        answers.append(getattr(database, ask)(*(() if argument is None else (argument,))))

    database.storage.asker = threading.Thread(target=run)
    database.extend(make_steps([[1]]))
    database.storage.asker.join()
    assert answers[0] == "waits"
    if ask == "retrieve":
        assert answers[1]["index"].tolist() == [2, 0, 1]
    elif ask == "digest":
        assert answers[1] == database.digest()


def test_nothing_is_written_during_a_query():
    writers = []

    class Interrupted(RetrievalSampler):
        def search(self, storage, query):
            writer = threading.Thread(target=database.extend, args=(make_steps([[1]]),))
            writer.start()
            writer.join(0.5)
            writers.append((writer, len(storage)))
            return super().search(storage, query)

    sampler = Interrupted("euclidean", k=3, threshold=0.0)
    database = ExpertDatabase(LazyTensorStorage(10), sampler=sampler)
    database.extend(make_steps([[1, 1]]))
    assert database.retrieve(torch.zeros(1))["index"].tolist() == [0, 1, -1]
    ((writer, length),) = writers
    writer.join()
    assert length == 2 and len(database) == 3


def test_threads_that_fill_get_ids_of_their_own():
    database = ExpertDatabase(LazyTensorStorage(1000))

    def fill():
        for _ in range(10):
            database.extend(make_steps([[0.0, 1.0]]))

    threads = [threading.Thread(target=fill) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert database[:]["episode"].tolist() == [i // 2 for i in range(80)]


def test_lock_holds_writers_off():
    database = make_database([[0, 1]])
    writer = threading.Thread(target=database.extend, args=(make_steps([[1]]),))
    with database.lock:
        writer.start()
        writer.join(0.2)
        assert writer.is_alive() and len(database) == 2
        assert len(database.retrieve(torch.zeros(1))) == 3  # its owner may ask
    writer.join()
    assert len(database) == 3


if __name__ == "__main__":
    pytest.main([__file__])
