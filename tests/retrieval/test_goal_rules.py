import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_rad import ExpertDatabase, GoalReward, RetrievalSampler, RetrievalTargetModule
from torchrl_rad.retrieval import goal_rules, goals
from torchrl_rad.retrieval.goal_rules import goal_neighbours
from torchrl_rad.retrieval.goals import GoalTable

from ..oracle import for_goal, neighbours, ranking, target_of


@pytest.fixture(scope="module", autouse=True, params=[0, goals.SUBSET_ENTRIES], ids=["all", "own"])
def searched(request):
    """All rows are searched, or for each goal those of its demonstrations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(goals, "SUBSET_ENTRIES", request.param)
        yield request.param > 0


NAMES = ["target", "found", "similarity", "target_return", "target_index", "target_offset"]
RULES = {
    "none": None,
    "late": lambda reward: reward.index(1.0) > 0,
    "short": lambda reward: len(reward) < 5,
}


@st.composite
def databases(draw):
    """Several short episodes on a few places, with or without the state after the last step."""
    lengths = draw(st.lists(st.integers(1, 7), min_size=1, max_size=5))
    place = st.lists(st.sampled_from([-1.0, -0.5, 0.0, 0.5]), min_size=2, max_size=2)
    count = sum(lengths)
    states = draw(st.lists(place, min_size=count, max_size=count))
    end = torch.tensor(lengths).cumsum(0) - 1
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[end] = True
    following = [states[i] if done[i] else states[i + 1] for i in range(count)]
    rows = {"reward": torch.zeros(count, 1), "done": done}
    if draw(st.booleans()):
        for i in end.tolist():
            following[i] = draw(place)
        rows["observation"] = torch.tensor(following)
    search = {
        "metric": "euclidean",
        "k": draw(st.sampled_from([1, 2, 5, 50])),
        "threshold": draw(st.sampled_from([0.0, 0.5, 2 / 3, 1.0])),
    }
    gamma = draw(st.sampled_from([0.0, 0.5, 0.9, 1.0]))
    sampler = RetrievalSampler(**search)
    database = ExpertDatabase(LazyTensorStorage(40), gamma=gamma, sampler=sampler)
    database.extend(TensorDict({"observation": torch.tensor(states), "next": rows}, [count]))
    return database, following, search


def expert_of(name):
    """The rule of the oracle, asked about an episode's TensorDict."""
    rule = RULES[name]
    return rule and (lambda episode: rule(episode["next", "reward"][:, 0].tolist()))


def assert_equals_oracle(made, asked, width, radius, expert, first_visit, rule, **limits):
    database, following, search = made
    queries, goals = [list(a[:2]) for a in asked], [list(a[2 : 2 + width]) for a in asked]
    reward = GoalReward(radius, first_visit=first_visit, expert=expert_of(expert))
    module = RetrievalTargetModule(
        database, rule=rule, goal_key="goal", goal_reward=reward, out_keys=NAMES,
        **{"horizon": 20, **limits},
    )  # fmt: skip
    batch = TensorDict({"observation": torch.tensor(queries), "goal": torch.tensor(goals)})
    batch.batch_size = [len(queries)]
    out = module(batch)
    columns = {name: value.tolist() for name, value in database[:].exclude("next").items()}
    for number, (state, goal) in enumerate(zip(queries, goals, strict=True)):
        own, rows = for_goal(
            columns, following, goal, radius, database.gamma, first_visit, RULES[expert]
        )
        own["return_to_go"] = torch.tensor(own["return_to_go"]).tolist()  # float32
        expected = target_of(state, own, search, rule, **limits)
        if expected["found"]:
            expected["target_index"] = rows[expected["target_index"]]
        else:  # the most similar of all
            expected["similarity"] = ranking(state, columns["observation"], "euclidean")[0][0]
        expected["similarity"] = torch.tensor(expected["similarity"]).item()
        got = {name: out[name][number].tolist() for name in NAMES}
        assert got.pop("target") == expected.pop("target"), (number, width)
        assert {name: value for name, (value,) in got.items()} == expected, (number, width)


places = st.sampled_from([-1.0, -0.5, 0.0, 0.5])
asked = st.lists(
    st.tuples(places, places, places, places), min_size=1, max_size=4
)  # x, y of the state and of the goal


@settings(max_examples=100, deadline=None)
@given(
    made=databases(),
    asked=asked,
    width=st.integers(1, 2),
    radius=st.sampled_from([0.0, 0.5, 0.75]),
    expert=st.sampled_from(sorted(RULES)),
    first_visit=st.booleans(),
    ahead=st.integers(0, 8),
)
def test_followed_equals_oracle(made, asked, width, radius, expert, first_visit, ahead):
    limits = {"rule": "followed", "ahead": ahead}
    assert_equals_oracle(made, asked, width, radius, expert, first_visit, **limits)


@settings(max_examples=150, deadline=None)
@given(
    made=databases(),
    asked=asked,
    width=st.integers(1, 2),
    radius=st.sampled_from([0.0, 0.5, 0.75]),
    expert=st.sampled_from(sorted(RULES)),
    first_visit=st.booleans(),
    horizon=st.integers(2, 8),
    least=st.integers(0, 3),
)
def test_highest_equals_oracle(made, asked, width, radius, expert, first_visit, horizon, least):
    limits = {"rule": "highest", "horizon": horizon, "min_offset": min(least, horizon - 1)}
    assert_equals_oracle(made, asked, width, radius, expert, first_visit, **limits)


def walk(episodes=20, length=30, seed=0, gamma=0.9, **search):
    generator = torch.Generator().manual_seed(seed)
    state = torch.rand(episodes, 1, 2, generator=generator) * 4
    state = state + (0.2 * torch.randn(episodes, length + 1, 2, generator=generator)).cumsum(1)
    done = torch.zeros(episodes, length, 1, dtype=torch.bool)
    done[:, -1] = True
    following = {
        "observation": state[:, 1:],
        "reward": torch.zeros(episodes, length, 1),
        "done": done,
    }
    steps = TensorDict({"observation": state[:, :-1], "next": following}, [episodes, length])
    search = {"metric": "euclidean", "k": 7, "threshold": 0.6, **search}
    database = ExpertDatabase(
        LazyTensorStorage(episodes * length), gamma, sampler=RetrievalSampler(**search)
    )
    database.extend(steps.reshape(-1))
    return database, state[:, 1:].flatten(0, 1)


@pytest.mark.parametrize("more", [0.0, 1.5, 100.0])
@pytest.mark.parametrize("threshold", [0.0, 0.6, 0.9])
def test_neighbours_are_of_demonstrations(monkeypatch, more, threshold):
    """However few rows are looked at first."""
    monkeypatch.setattr(goal_rules, "MORE", more)
    database, _ = walk(threshold=threshold)
    table = GoalTable([database[:]], "observation", 0.9, GoalReward(0.5))
    wanted = torch.rand(6, 2, generator=torch.Generator().manual_seed(1)) * 4
    number, returns = table.look_up(wanted)
    query = database[:]["observation"][::100] + 0.01
    queries, goal = query.repeat(len(wanted), 1), number.repeat_interleave(len(query))
    asked = (database.sampler, database.storage, queries, table, returns, goal)
    rows, near, valid = goal_neighbours(*asked)
    assert rows.shape == near.shape == valid.shape == (len(queries), 7)
    answers = [
        list(zip(near[i][valid[i]].tolist(), rows[i][valid[i]].tolist(), strict=True))
        for i in range(len(queries))
    ]
    reached = 0
    for number, state in enumerate(queries.double().tolist()):
        experts = returns.experts[goal[number]][returns.episode]
        if not experts.any():
            assert answers[number] == []
            continue
        reached += 1
        index = experts.nonzero()[:, 0]
        own = database[:]["observation"].double()[index].tolist()
        expected = neighbours(state, own, "euclidean", 7, threshold)
        assert answers[number] == [(s, index[i].item()) for s, i in expected]
    assert 0 < reached


def test_a_row_alone_is_as_in_a_batch():
    database, following = walk(threshold=0.0)
    module = RetrievalTargetModule(
        database, 9, "followed", ahead=4, goal_key="goal", out_keys=NAMES
    )
    state, goal = database[:]["observation"][::37], following[5 :: len(following) // 17][:17]
    batch = TensorDict({"observation": state, "goal": goal}, [17])
    together = module(batch.clone())
    for i in range(17):
        alone = module(batch[i : i + 1].clone())
        assert all(torch.equal(alone[name][0], together[name][i]) for name in NAMES)
    assert together["found"].any()


def test_the_goal_of_another_row_does_not_show():
    database, following = walk(threshold=0.0)
    module = RetrievalTargetModule(database, 9, goal_key="goal", out_keys=NAMES)
    state = database[:]["observation"][:1].expand(2, 2)
    goals = torch.stack([following[29], torch.tensor([99.0, 99.0])])
    out = module(TensorDict({"observation": state, "goal": goals}, [2]))
    assert out["found"].squeeze(-1).tolist() == [True, False]
    assert torch.equal(out["target"][1], state[1]) and out["target_index"][1] == -1
    assert out["target_return"][1] == 0.0 and 0 < out["similarity"][1] <= 1


def test_few_rows_are_held_for_goals():
    database, following = walk()
    table = GoalTable([database[:]], "observation", 0.9, GoalReward(0.5))
    _, returns = table.look_up(following[::60])
    sizes = (returns.share * len(following)).round().long().tolist()
    made, most = [], sizes[0] + sizes[1]

    def make(rows):
        made.append(len(rows))
        return database.sampler.subset(database.storage, rows)

    for i in (0, 1, 0, 1):
        table.subset(i, make, most)
    assert made == sizes[:2]
    table.subset(2, make, most)
    assert made == sizes[:3]
    assert sum(len(rows) for rows, _ in table.subsets.values()) <= most
