import copy
import pickle
import threading
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Composite, LazyMemmapStorage, LazyTensorStorage, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, SerialEnv, TransformedEnv
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_rad import (
    ExpertDatabase,
    GoalReward,
    RetrievalSampler,
    RetrievalTargetModule,
    first_hit_within,
)
from torchrl_rad.modules import target

from ..oracle import target_of
from ..walks import episodes, random_walks

NAMES = ["target", "found", "similarity", "target_return", "target_index", "target_offset"]
RULES = [{"rule": "highest"}, {"rule": "highest", "tolerance": 0.3}, {"rule": "followed"}]
rules = pytest.mark.parametrize("rule", RULES, ids=["highest", "tolerant", "followed"])


def walks(count=12, length=25, width=3, seed=0):
    """Random walks with a reward now and then."""
    return random_walks(count, length, width, seed, unpaid=0.9)


def database(data=None, storage=LazyTensorStorage, capacity=1000, gamma=0.9, **search):
    search = {"metric": "euclidean", "k": 20, "threshold": 0.6, **search}
    made = ExpertDatabase(storage(capacity), gamma=gamma, sampler=RetrievalSampler(**search))
    if data is not None:
        made.extend(data)
    return made


def module(made, **settings):
    return RetrievalTargetModule(made, **{"horizon": 17, "ahead": 8, "out_keys": NAMES, **settings})


def ask(select, states, key="observation"):
    states = torch.as_tensor(states)
    return select(TensorDict({key: states}, states.shape[:-1]))


def queries(count=40, width=3):
    return torch.randn(count, width, generator=torch.Generator().manual_seed(5)) * 0.8


# what is written


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
@rules
def test_equals_oracle_on_walks(storage, metric, rule):
    made = database(walks(), storage, metric=metric)
    out = ask(module(made, **rule), queries())
    columns = {name: value.tolist() for name, value in made[:].exclude("next").items()}
    limits = {"ahead": 8} if rule["rule"] == "followed" else {"horizon": 17}
    limits |= {name: rule[name] for name in ("tolerance",) if name in rule}
    search = {"metric": metric, "k": 20, "threshold": 0.6}
    assert 0 < out["found"].sum() < 40 or metric == "cosine"
    for number, state in enumerate(queries().tolist()):
        expected = target_of(state, columns, search, rule["rule"], **limits)
        got = {name: out[name][number].tolist() for name in NAMES}
        assert got["target"] == expected["target"]
        assert got["target_index"] == [expected["target_index"]]
        assert got["target_offset"] == [expected["target_offset"]]
        assert got["similarity"] == pytest.approx([expected["similarity"]])


def test_by_hand():
    # rows 0..2 lead to a reward at once, rows 3..5 pay now
    states, rewards = [[0.0], [1.0], [2.0], [0.25], [5.0], [6.0]], [0.0, 0.0, 2.0, 1.0, 0.0, 0.0]
    made = database(episodes(states, [3, 3], rewards), gamma=0.5, threshold=0.8)
    assert made[:]["return_to_go"].tolist() == [0.5, 1.0, 2.0, 1.0, 0.0, 0.0]
    out = ask(module(made, horizon=3, rule="highest"), [[0.125]])
    # row 2 through row 0, two steps off; rows 0 and 3 are as similar
    assert {name: out[name].item() for name in NAMES} == {
        "target": 2.0, "found": True, "similarity": pytest.approx(1 / 1.125),
        "target_return": 2.0, "target_index": 2, "target_offset": 2,
    }  # fmt: skip
    out = ask(module(made, horizon=3, ahead=2, rule="followed"), [[0.125]])
    assert (out["target_index"].item(), out["target_offset"].item()) == (3, 0)
    out = ask(module(made, horizon=3, rule="highest"), [[9.0]])
    assert {name: out[name].item() for name in NAMES} == {
        "target": 9.0, "found": False, "similarity": 0.25,  # row 5 is nearest
        "target_return": 0.0, "target_index": -1, "target_offset": 0,
    }  # fmt: skip


@rules
@pytest.mark.parametrize("backend", ["tree", "scan"])
def test_batch_of_one_equals_batch_of_many(rule, backend):
    select = module(database(walks(), backend=backend), **rule)
    many = ask(select, queries())
    for number, state in enumerate(queries()):
        alone = ask(select, state)
        assert all(torch.equal(alone[name], many[name][number]) for name in NAMES)


@rules
@pytest.mark.parametrize("most", [1, 7, 39])
def test_large_batches_are_asked_in_parts(rule, most, monkeypatch):
    select = module(database(walks()), **rule)
    whole = ask(select, queries())
    monkeypatch.setattr(target, "QUERIES", most)
    parts = ask(select, queries())
    assert all(torch.equal(whole[name], parts[name]) for name in NAMES)


@rules
@pytest.mark.parametrize("shape", [[], [1], [40], [4, 10], [2, 5, 4], [0], [2, 0]])
def test_any_batch_shape(rule, shape):
    select = module(database(walks()), **rule)
    states = queries()[: torch.Size(shape).numel()]
    flat, out = ask(select, states), ask(select, states.reshape(*shape, 3))
    types = [torch.float32, torch.bool, torch.float32, torch.float32, torch.int64, torch.int64]
    for name, dtype in zip(NAMES, types, strict=True):
        width = 3 if name == "target" else 1
        assert out[name].shape == (*shape, width) and out[name].dtype == dtype
        assert torch.equal(out[name].reshape(-1, width), flat[name])


@rules
def test_offset_leads_from_the_neighbour_to_the_target(rule):
    made = database(walks())
    out = ask(module(made, **rule), queries())[torch.arange(40)]
    out = out[out["found"].squeeze(-1)]
    index, offset = out["target_index"].squeeze(-1), out["target_offset"].squeeze(-1)
    rows, anchor = made[:][index], made[:][index - offset]
    assert (offset >= 0).all() and (offset <= 16).all() and offset.max() > 3
    assert torch.equal(rows["episode"], anchor["episode"])
    assert torch.equal(rows["step"] - anchor["step"], offset)
    assert torch.equal(rows["observation"], out["target"])
    assert torch.equal(rows["return_to_go"][:, None], out["target_return"])
    distance = (anchor["observation"] - out["observation"]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(out["similarity"], 1 / (1 + distance))


def test_offset_is_written_on_demand_only():
    select = RetrievalTargetModule(database(walks()), horizon=17)
    out = ask(select, queries())
    assert select.out_keys == NAMES[:5] and "target_offset" not in out.keys()


@rules
def test_rows_without_a_neighbour_fall_back(rule):
    made = database(walks())
    far = torch.full((1, 3), 40.0)
    nearest = made.sampler.nearest(made.storage, far)[1].max().float()
    out = ask(module(made, **rule), torch.cat([queries()[:1] * 0, far]))
    assert out["found"].tolist() == [[True], [False]]
    assert out["target"][1].tolist() == [40.0] * 3
    assert out["target_index"][1] == -1 and out["target_offset"][1] == 0
    assert out["target_return"][1] == 0 and out["similarity"][1] == nearest


@rules
@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("dims", [None, [0, 1]])
def test_states_that_are_none_fall_back(rule, bad, dims):
    select = module(database(walks(), dims=dims), **rule)
    states = queries()[:4]
    clean = ask(select, states)
    broken = states.clone()
    broken[1, 2] = bad
    out = ask(select, broken)
    assert out["found"][1].item() is False and out["target_index"][1] == -1
    assert out["target"][1].tolist() == [*states[1, :2].tolist(), 0.0]
    assert out["similarity"][1] == -torch.inf and out["target_return"][1] == 0
    others = torch.tensor([0, 2, 3])
    assert all(torch.equal(out[name][others], clean[name][others]) for name in NAMES)


@rules
def test_empty_database_falls_back(rule):
    out = ask(module(database(), **rule), [[1.0, torch.nan], [2.0, 3.0]])
    assert out["target"].tolist() == [[1.0, 0.0], [2.0, 3.0]] and not out["found"].any()
    assert out["target_index"].tolist() == [[-1], [-1]]
    assert out["similarity"].tolist() == [[-torch.inf]] * 2
    assert out["target_return"].tolist() == out["target_offset"].tolist() == [[0], [0]]


@rules
def test_notices_changes(rule):
    made = database(walks())
    select = module(made, **rule)
    far = torch.full((3,), 40.0)
    assert not ask(select, far)["found"]
    made.extend(episodes(far.expand(2, 3), [2], [0.0, 5.0]))
    out = ask(select, far)
    assert (out["target_index"], out["target_return"]) == (301, 5.0) or rule["rule"] == "followed"
    made.empty()
    assert not ask(select, far)["found"]
    made.extend(episodes(far.expand(1, 3), [1]))
    assert ask(select, far)["target_index"] == 0
    made.storage[:]["observation"][:] = 30.0
    made.sampler.invalidate()
    assert not ask(select, far)["found"] and ask(select, far - 10)["found"]


@rules
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_other_types_of_state(rule, dtype):
    out = ask(module(database(walks()), **rule), queries().to(dtype))
    expected = ask(module(database(walks()), **rule), queries().to(dtype).float())
    assert out["target"].dtype == dtype and out["similarity"].dtype == torch.float32
    assert torch.equal(out["target_index"], expected["target_index"])
    assert torch.equal(out["target"], expected["target"].to(dtype)) and out["found"].any()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@rules
@pytest.mark.parametrize("rows_on", ["cpu", "cuda"])
def test_states_on_another_device(rule, rows_on):
    made = database(storage=partial(LazyTensorStorage, device=rows_on))
    made.extend(walks())
    out = ask(module(made, **rule), queries().cuda())
    expected = ask(module(database(walks()), **rule), queries())
    for name in NAMES:
        assert out[name].device.type == "cuda"
        torch.testing.assert_close(out[name].cpu(), expected[name])
    assert torch.equal(out["target_index"].cpu(), expected["target_index"])


def test_nothing_is_added_between_the_search_and_the_reading(monkeypatch):
    made = database(walks())
    select = module(made)
    free = []

    def watched(function):
        def call(*args):
            other = threading.Thread(target=lambda: free.append(made._replay_lock.acquire(False)))
            other.start()
            other.join()
            return function(*args)

        return call

    monkeypatch.setattr(made.sampler, "best", watched(made.sampler.best))
    monkeypatch.setattr(select, "_read", watched(select._read))
    ask(select, queries())
    assert free == [False, False]  # extend, which takes this lock, would have to wait


# keys and errors


def test_nested_and_renamed_keys():
    made = database(walks())
    renamed = [("goal", "state"), "ok", ("goal", "near"), "worth", "row", ("goal", "steps")]
    select = module(made, in_keys=[("agent", "state")], out_keys=renamed)
    out = ask(select, queries(), ("agent", "state"))
    plain = ask(module(made), queries())
    assert set(out.keys(True, True)) == {("agent", "state"), *renamed}
    assert all(torch.equal(out[key], plain[n]) for key, n in zip(renamed, NAMES, strict=True))
    by_keyword = select(agent_state=queries())
    assert all(torch.equal(a, plain[n]) for a, n in zip(by_keyword, NAMES, strict=True))


def test_called_by_keyword_or_position():
    select = module(database(walks()))
    plain = ask(select, queries())
    for results in (select(observation=queries()), select(queries())):
        assert all(torch.equal(r, plain[name]) for r, name in zip(results, NAMES, strict=True))


def test_missing_key():
    with pytest.raises(KeyError, match="'observation' is missing in the tensordict"):
        ask(module(database(walks())), queries(), "state")


def test_wrong_width():
    with pytest.raises(ValueError, match="the query has 2 entries, a state of the database 3"):
        ask(module(database(walks())), queries(width=2))


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"rule": "best"}, "rule is 'best'; expected 'highest' or 'followed'"),
        ({"horizon": 1}, "horizon is 1; .* use 2 or more"),
        ({"tolerance": -0.1}, "tolerance is -0.1; it must not be negative"),
        ({"tolerance": float("nan")}, "tolerance is nan; it must not be negative"),
        ({"rule": "followed", "ahead": 17}, "ahead is 17; expected 0 to horizon - 1 = 16"),
        ({"rule": "followed", "ahead": -1}, "ahead is -1; expected 0 to horizon - 1"),
        ({"min_offset": 17}, "min_offset is 17; expected 0 to horizon - 1 = 16"),
        ({"min_offset": -1}, "min_offset is -1"),
        ({"retrieval_interval": 0}, "retrieval_interval is 0; expected 1 or more"),
        ({"in_keys": ["a", "b"]}, "expected one in_key and five to seven out_keys"),
        ({"out_keys": ["a"]}, "expected one in_key and five to seven out_keys"),
    ],
)
def test_wrong_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        module(database(), **settings)


def test_a_short_horizon_needs_no_ahead_for_the_paper_s_rule():
    assert RetrievalTargetModule(database(), horizon=4).ahead == 16


def test_repr_names_the_rule():
    assert "rule='followed', horizon=17" in repr(module(database(), rule="followed"))


# copies and weights


def actor(width=3, actions=2):
    net = nn.Sequential(nn.Linear(2 * width, actions), nn.Tanh())
    return TensorDictModule(_Joined(net), in_keys=["observation", "target"], out_keys=["action"])


class _Joined(nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, *parts):
        return self.net(torch.cat(parts, -1))


def test_no_part_of_the_weights():
    select = module(database(walks()))
    ask(select, queries())  # with everything cached
    policy = TensorDictSequential(select, actor())
    assert not list(select.parameters()) and not list(select.buffers())
    assert set(policy.state_dict()) == {
        "module.1.module.net.0.weight",
        "module.1.module.net.0.bias",
    }
    assert len(list(TensorDict.from_module(policy).keys(True, True))) == 2
    assert policy.to(torch.float64)[0] is select


def test_deepcopy_shares_the_database():
    made = database(walks())
    select = module(made)
    ask(select, queries())
    other = copy.deepcopy(TensorDictSequential(select, actor()))[0]
    assert other is not select and other.database is made
    assert other._columns is None  # what was made from it is not copied
    made.extend(episodes(torch.full((1, 3), 40.0), [1]))
    assert ask(other, torch.full((3,), 40.0))["target_index"] == 300


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pickles_small():
    made = database(walks(200, 50), capacity=10_000)
    select = module(made, rule="followed")
    out = ask(select, queries())
    sent = pickle.dumps(select)
    assert len(sent) < 4000
    other = pickle.loads(sent)
    again = ask(other, queries())
    assert other.database is not made and all(torch.equal(out[n], again[n]) for n in NAMES)


# a target kept for several steps


# one of the best


@pytest.mark.parametrize("among", [2, 5])
@pytest.mark.parametrize("rule", [RULES[0], RULES[2]], ids=["highest", "followed"])
def test_one_of_the_best_is_drawn(rule, among):
    made, state = database(walks()), queries(1)
    found = made.retrieve(state)
    best = module(made, **rule)
    best.select(state)
    ranked, rows = best._columns.rule, found["index"][0][found["valid"][0]]
    # the targets of all neighbours, best first: by brute force over what each leads to
    order = sorted((-int(ranked.rank[i]), int(ranked.target[i])) for i in rows.tolist())
    allowed = list(dict.fromkeys(target for _, target in order))[:among]
    assert len(allowed) == among
    torch.manual_seed(0)
    out = ask(module(made, **rule, among=among), state.expand(3000, -1))
    count = out["target_index"][:, 0].bincount()
    assert sorted(count.nonzero()[:, 0].tolist()) == sorted(allowed)
    assert (count[allowed] - 3000 / among).abs().max() < 160
    shift = out["target_index"] - out["target_offset"]
    assert torch.isin(shift[:, 0], rows).all()
    assert out["found"].all()


def test_among_more_than_there_are():
    made = database(walks(), k=1)
    expected, out = (ask(module(made, among=n), queries()) for n in (1, 7))
    assert all(torch.equal(out[name], expected[name]) for name in NAMES)
    assert 0 < out["found"].sum() < len(queries())


@pytest.mark.parametrize("settings", [{"among": 0}, {"among": 2, "tolerance": 0.1},
                                      {"among": 2, "goal_key": "goal"}])  # fmt: skip
def test_among_is_refused(settings):
    with pytest.raises(ValueError, match="among is .; expected 1, or more without a tolerance"):
        module(database(), **settings)


# a goal of its own for each row


def ask_goals(select, states, goals):
    entries = {"observation": torch.as_tensor(states), "goal": torch.as_tensor(goals)}
    return select(TensorDict(entries, [len(states)]))


def test_goals_by_hand():
    # there and back: 0 1 2 3 4 5, then 5 4 3 2 1 0
    states = torch.cat([torch.arange(6.0), torch.arange(5.0, -1.0, -1.0)])[:, None]
    made = database(episodes(states, [6, 6]), k=4, threshold=0.5, gamma=0.5)
    reward = GoalReward(radius=0.1)
    settings = {"rule": "followed", "ahead": 2, "goal_key": "goal", "goal_reward": reward}
    select = module(made, **settings)
    assert select.in_keys == ["observation", "goal"]
    out = ask_goals(select, [[2.0], [2.0], [2.0], [2.0]], [[5.0], [0.0], [3.0], [7.0]])
    # to 5 along the first episode; to 0 along the second; 3 is one step on; 7 was never reached
    assert out["target_index"].squeeze(-1).tolist() == [4, 10, 2, -1]
    assert out["found"].squeeze(-1).tolist() == [True, True, True, False]
    assert out["target"].squeeze(-1).tolist() == [4.0, 1.0, 2.0, 2.0]
    # the last row of an episode is where it ends, and its reward that of the state after it
    assert out["target_return"].squeeze(-1).tolist() == [1.5, 1.5, 1.0, 0.0]
    assert out["target_offset"].squeeze(-1).tolist() == [1, 0, 0, 0]


def test_goals_that_are_none():
    select = module(database(walks()), goal_key="goal")
    near = walks()["observation"][20:24, :2]
    goals = near.clone()
    goals[1, 0], goals[2, 1] = torch.nan, torch.inf
    out = ask_goals(select, walks()["observation"][:4], goals)
    assert out["found"].squeeze(-1).tolist() == [True, False, False, True]
    state = walks()["observation"][:4].clone()
    state[0, 0] = torch.nan
    out = ask_goals(select, state, near)
    assert out["found"].squeeze(-1).tolist() == [False, True, True, True]
    assert out["target"].isfinite().all() and out["similarity"][0] == -torch.inf


def test_goals_without_a_row_or_a_database():
    empty = module(database(), goal_key="goal")
    assert not ask_goals(empty, [[1.0, 2.0]], [[1.0]])["found"].any()
    select = module(database(walks()), goal_key="goal")
    out = ask_goals(select, torch.zeros(0, 3), torch.zeros(0, 2))
    assert out["target"].shape == (0, 3) and out["found"].shape == (0, 1)


def test_goals_of_another_width_or_missing():
    select = module(database(walks()), goal_key="goal")
    with pytest.raises(ValueError, match="a goal has 4 entries, compared with entries"):
        ask_goals(select, torch.zeros(1, 3), torch.zeros(1, 4))
    with pytest.raises(ValueError, match=r"goals are \[3, 2\], of \[1\] states; expected"):
        select(TensorDict({"observation": torch.zeros(1, 3), "goal": torch.zeros(3, 2)}, []))
    with pytest.raises(KeyError, match="'goal' is missing in the tensordict"):
        ask(select, [[0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="tolerance is 0.5; with a goal_key it must be 0"):
        module(database(), goal_key="goal", tolerance=0.5)
    with pytest.raises(ValueError, match="goal_reward is given without a goal_key"):
        module(database(), goal_reward=GoalReward())


def test_the_expert_rule_follows_the_goal():
    # three episodes along one line, whose states pass 3 after 3, 1 and 6 steps
    states = torch.cat([torch.arange(0.0, 9.0), torch.arange(2.0, 11.0), torch.arange(-3.0, 6.0)])
    steps = episodes(states[:, None], [9, 9, 9], (states[:, None] > 1e9).float())
    made = database(capacity=99, k=3, threshold=0.0, gamma=0.5)
    made.extend(steps)
    made.expert = first_hit_within(2, 4)
    goals, reward = [[3.0]], GoalReward(radius=0.1)
    out = ask_goals(module(made, goal_key="goal", goal_reward=reward), [[1.0]], goals)
    assert out["found"] and out["target_index"] < 9
    # only the third one is an expert's by another rule
    reward = GoalReward(radius=0.1, expert=first_hit_within(5, 9))
    out = ask_goals(module(made, goal_key="goal", goal_reward=reward), [[1.0]], goals)
    assert out["target_index"] >= 18
    made.expert = lambda episode: bool((episode["observation"] > 9).any())  # sees all of a step
    out = ask_goals(module(made, goal_key="goal", goal_reward=GoalReward(0.1)), [[1.0]], goals)
    assert 9 <= out["target_index"] < 18


def test_goals_see_a_database_change():
    made = database(walks())
    select, state = module(made, goal_key="goal"), torch.zeros(1, 3)
    far = torch.full((1, 2), 50.0)
    assert not ask_goals(select, state, far)["found"].any()
    steps = episodes(torch.linspace(0, 50, 60)[:, None].expand(60, 3), [60])
    made.extend(steps)
    assert ask_goals(select, state, far)["found"].all()
    made.forget([int(made[:]["episode"][-1])])
    assert not ask_goals(select, state, far)["found"].any()


@pytest.mark.parametrize("most", [1, 7, 39])
def test_many_goals_are_asked_in_parts(most, monkeypatch):
    select, states = module(database(walks()), goal_key="goal"), walks(seed=1)["observation"][:40]
    goals = walks(seed=2)["observation"][:40, :2]
    expected = ask_goals(select, states, goals)
    monkeypatch.setattr(target, "QUERIES", most)
    out = ask_goals(select, states, goals)
    assert all(torch.equal(out[name], expected[name]) for name in NAMES)
    assert 0 < expected["found"].sum() < 40


class Line(EnvBase):
    """Counts its steps from 0 and ends after ``limit`` of them."""

    def __init__(self, limit):
        super().__init__()
        self.limit, self.count = limit, 0
        self.observation_spec = Composite(observation=Unbounded((1,)))
        self.action_spec = Unbounded((1,))
        self.reward_spec = Unbounded((1,))

    def _state(self):
        done = torch.tensor([self.count >= self.limit])
        state = torch.tensor([float(self.count)])
        return {"observation": state, "done": done, "terminated": done.clone()}

    def _reset(self, tensordict):
        self.count = 0
        return TensorDict(self._state(), [])

    def _step(self, tensordict):
        self.count += 1
        return TensorDict({**self._state(), "reward": torch.zeros(1)}, [])

    def _set_seed(self, seed):
        pass


def still(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 1))


def places(count=30):
    """Each state is an episode of its own, and its own target."""
    return database(episodes(torch.arange(float(count))[:, None], [1] * count), k=1)


def lines(select, *limits):
    env = SerialEnv(len(limits), [partial(Line, limit) for limit in limits])
    return TransformedEnv(env, Compose(InitTracker(), select.make_tensordict_primer()))


def test_a_collector_fills_the_database_that_it_asks_with_goals():
    reward = GoalReward(radius=0.1)
    made = database(capacity=200, k=3, threshold=0.5)
    select = module(made, rule="followed", ahead=4, goal_key="goal", goal_reward=reward)
    to = TensorDictModule(lambda state: torch.full_like(state, 5.0), ["observation"], ["goal"])
    act = TensorDictModule(torch.zeros_like, ["observation"], ["action"])
    env = TransformedEnv(SerialEnv(2, [partial(Line, 12)] * 2), InitTracker())
    policy = TensorDictSequential(to, select, act)
    collector = Collector(env, policy, frames_per_batch=24, total_frames=96)
    stop, faults, found = threading.Event(), [], []

    def ask_beside():
        other = copy.copy(select)
        while not stop.is_set():
            out = ask_goals(other, [[2.0], [2.0]], [[5.0], [99.0]])
            found.append(bool(out["found"][0]))
            right = not out["found"][1] and (not found[-1] or float(out["target"][0]) == 4.0)
            faults.extend([] if right else [out])

    thread = threading.Thread(target=ask_beside)
    thread.start()
    shares = []
    for number, batch in enumerate(collector):
        shares.append(float(batch["found"].float().mean()))
        made.extend(batch.select("observation", ("next", "reward"), ("next", "done")).reshape(-1))
        assert len(made) == 24 * (number + 1)
    stop.set()
    thread.join()
    collector.shutdown()
    assert not faults and found[-1]
    # nothing was known in the first batch; then what it had recorded itself
    assert shares == [0.0, 1.0, 1.0, 1.0]


def test_each_row_keeps_its_target_by_its_own_clock():
    select = module(places(), retrieval_interval=3)
    policy = TensorDictSequential(select, still)
    out = lines(select, 5, 4).rollout(12, policy, break_when_any_done=False, auto_reset=True)
    assert out["observation"].squeeze(-1).tolist() == [
        [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1],
        [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3],
    ]
    assert out["target"].squeeze(-1).tolist() == [
        [0, 0, 0, 3, 3, 0, 0, 0, 3, 3, 0, 0],
        [0, 0, 0, 3, 0, 0, 0, 3, 0, 0, 0, 3],
    ]
    assert out["found"].all() and torch.equal(out["target"].long(), out["target_index"])


def test_a_kept_target_comes_nearer():
    # one episode that pays at its end, four rows from the start
    made = database(episodes(torch.arange(5.0)[:, None], [5], [0.0, 0.0, 0.0, 0.0, 1.0]), k=1)
    select = module(made, retrieval_interval=3)
    out = lines(select, 9).rollout(4, TensorDictSequential(select, still))
    assert out["target_index"].flatten().tolist() == [4, 4, 4, 4]
    assert out["target_offset"].flatten().tolist() == [4, 3, 2, 1]
    assert out["similarity"].flatten().tolist() == [1.0] * 4
    assert out["target_return"].flatten().tolist() == [1.0] * 4
    passed = module(places(1), retrieval_interval=3)
    out = lines(passed, 9).rollout(3, TensorDictSequential(passed, still))
    assert out["target_offset"].flatten().tolist() == [0, 0, 0]


def test_interval_of_one_needs_nothing_kept():
    env = TransformedEnv(SerialEnv(2, partial(Line, 5)))
    policy = TensorDictSequential(module(places()), still)
    out = env.rollout(4, policy)
    assert torch.equal(out["target"], out["observation"])


def kept(select, states, is_init, before=None):
    """One step by hand; returns the tensordict and what is kept after it."""
    count = len(states)
    before = torch.zeros(count, 5, dtype=torch.float64) if before is None else before
    tensordict = TensorDict(
        {
            "observation": torch.as_tensor(states),
            "is_init": torch.tensor(is_init)[:, None],
            "retrieval": {"kept": before},
        },
        [count],
    )
    out = select(tensordict)
    return out, out["next", "retrieval", "kept"]


def test_only_a_target_is_kept():
    select = module(places(), retrieval_interval=5)
    # out of reach: asked again at the next step
    out, after = kept(select, [[99.0], [1.0]], [True, True])
    assert out["target_index"].tolist() == [[-1], [1]]
    out, after = kept(select, [[2.0], [2.0]], [False, False], after)
    assert out["target_index"].tolist() == [[2], [1]]
    # a state that is none has no target, kept or not
    out, after = kept(select, [[3.0], [torch.nan]], [False, False], after)
    assert out["target_index"].tolist() == [[2], [-1]] and out["target"][1] == 0
    out, after = kept(select, [[4.0], [4.0]], [False, False], after)
    assert out["target_index"].tolist() == [[2], [4]]


def test_what_was_never_asked_is_not_kept():
    # as the primer left it, without a reset: row 0 is no target
    out, after = kept(module(places(), retrieval_interval=5), [[7.0]], [False])
    assert out["target_index"] == 7 and after.tolist() == [[7.0, 1.0, 0.0, 1.0, 0.0]]


def test_rows_that_are_gone_are_not_kept():
    made = places()
    select = module(made, retrieval_interval=5)
    _, after = kept(select, [[20.0]], [True])
    made.empty()
    out, _ = kept(select, [[20.0]], [False], after)
    assert not out["found"] and out["target"] == 20.0 and out["similarity"] == -torch.inf
    made.extend(episodes([[20.0]], [1]))
    out, _ = kept(select, [[20.0]], [False], after)
    assert out["target_index"] == 0


def test_missing_what_is_kept():
    with pytest.raises(KeyError, match=r"needs 'is_init'.*add InitTracker.*make_tensordict_primer"):
        ask(module(places(), retrieval_interval=2), [[1.0]])


# in TorchRL's collectors


def mock_policy(made):
    return TensorDictSequential(module(made, rule="followed", ahead=2), actor(7, 7))


def mock_database(**settings):
    torch.manual_seed(0)
    return database(episodes(torch.randn(60, 7), [20] * 3, torch.rand(60)), threshold=0, **settings)


def check(batch, made):
    assert batch["found"].all() and batch["action"].abs().max() <= 1
    rows = made[:][batch["target_index"].flatten()]
    assert torch.equal(rows["observation"], batch["target"].flatten(0, -2))


def test_direct_collector_sees_a_database_grow():
    made = mock_database()
    made.sampler.load_state_dict({**made.sampler.config, "threshold": 0.999})
    policy = mock_policy(made)
    collector = Collector(
        ContinuousActionVecMockEnv, policy, frames_per_batch=6, total_frames=12,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    batches = iter(collector)
    first = next(batches).clone()
    assert not first["found"].any()
    seen = first["next", "observation"][-1:] + 1e-6
    made.sampler.load_state_dict({**made.sampler.config, "threshold": 0.01})
    made.extend(episodes(seen, [1], [1e6]))
    second = next(batches)
    collector.shutdown()
    assert second["found"].all() and (second["target_index"] == 60).any()
    check(second, made)


def test_collector_adds_the_primer():
    select = module(places(), retrieval_interval=3)
    collector = Collector(
        partial(Line, 5), TensorDictSequential(select, still), frames_per_batch=8, total_frames=8,
        auto_register_policy_transforms=True,
    )  # fmt: skip
    batch = next(iter(collector))
    collector.shutdown()
    assert batch["target"].flatten().tolist() == [0, 0, 0, 3, 3, 0, 0, 0]


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("by_factory", [False, True], ids=["policy", "factory"])
def test_collector_with_a_worker_process(by_factory, tmp_path):
    made = mock_database()
    made.dumps(tmp_path / "database")

    def factory(path=str(tmp_path / "database")):  # opens the rows in the worker
        return mock_policy(ExpertDatabase.loads(path, memmap=True))

    given = {"policy_factory": factory} if by_factory else {"policy": mock_policy(made)}
    collector = MultiSyncCollector(
        [ContinuousActionVecMockEnv], **given, frames_per_batch=6, total_frames=12,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    try:
        batches = [batch.clone() for batch in collector]
    finally:
        collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        check(batch, made)


def test_a_primer_only_where_something_is_kept():
    database = ExpertDatabase(LazyTensorStorage(10))
    assert not hasattr(RetrievalTargetModule(database), "make_tensordict_primer")
    assert hasattr(RetrievalTargetModule(database, retrieval_interval=2), "make_tensordict_primer")
