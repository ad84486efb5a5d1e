from functools import partial

import pytest
import torch
from tensordict import TensorDict

from torchrl_rad import GoalReward, first_hit_within
from torchrl_rad.data.episodes import return_to_go, step_and_remaining
from torchrl_rad.data.experts import select_episodes
from torchrl_rad.envs import relabel_goal
from torchrl_rad.retrieval import goals as module
from torchrl_rad.retrieval.goals import GoalTable


def rows(lengths=(40, 1, 60), width=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    count = sum(lengths)
    state = 0.3 * torch.randn(count + 1, width, generator=generator).cumsum(0)
    step, remaining = step_and_remaining(torch.tensor(lengths))
    following = {"observation": state[1:]}
    columns = {"observation": state[:-1], "next": following, "step": step, "remaining": remaining}
    return TensorDict(columns, [count]), torch.tensor(lengths)


@pytest.mark.parametrize("gamma", [0.0, 0.3, 0.97, 1.0])
def test_returns_are_those_of_relabelled_steps(gamma):
    steps, lengths = rows()
    table = GoalTable([steps], "observation", gamma, GoalReward())
    goals = steps["next", "observation"][::7]
    number, returns = table.look_up(goals)
    every = torch.arange(len(steps))
    for goal, i in zip(goals, number, strict=True):
        reward = relabel_goal(steps, goal)["next", "reward"]
        expected = return_to_go(reward, lengths, gamma)
        value, end = returns.value_and_end(every, i.expand(len(steps)))
        torch.testing.assert_close(value, expected, atol=0, rtol=1e-6)
        assert torch.equal(end, every + steps["remaining"])
        reached = [bool(r.any()) for r in reward.split(lengths.tolist())]
        assert returns.experts[i].tolist() == reached
        share = sum(n for n, r in zip(lengths.tolist(), reached, strict=True) if r) / len(steps)
        assert returns.share[i] == pytest.approx(share)


def test_first_visits_by_hand():
    state = torch.tensor([[0.0], [1.0], [2.0], [1.0], [0.0]])
    step, remaining = step_and_remaining(torch.tensor([5]))
    steps = TensorDict({"observation": state, "step": step, "remaining": remaining}, [5])
    # the states after the rows: 1, 2, 1, 0, and that of the last row itself, 0
    table = GoalTable([steps], "observation", 0.5, GoalReward(0.1, first_visit=True))
    number, returns = table.look_up(torch.tensor([[1.0]]))
    value, end = returns.value_and_end(torch.arange(5), number.expand(5))
    assert value.tolist() == [1.0, 0.5, 1.0, 0.0, 0.0]
    assert end.tolist() == [0, 2, 2, 4, 4]


def test_dims_and_a_goal_of_another_width():
    steps, _ = rows(width=3)
    reward = GoalReward(0.5, dims=[2])
    found = reward(steps["observation"], torch.tensor([0.0]))
    assert torch.equal(found, steps["observation"][:, 2].abs() <= 0.5)
    table = GoalTable([steps], "observation", 0.9, reward)
    with pytest.raises(ValueError, match=r"a goal has 2 entries, compared with entries \[2\] of a"):
        table.look_up(torch.zeros(1, 2))
    with pytest.raises(ValueError, match="a goal has 4 entries"):
        GoalReward()(steps["observation"], torch.zeros(4))
    with pytest.raises(ValueError, match="radius is nan"):
        GoalReward(float("nan"))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
def test_a_goal_that_nobody_reaches(bad):
    steps, _ = rows()
    table = GoalTable([steps], "observation", 0.9, GoalReward())
    number, returns = table.look_up(torch.tensor([[0.0, bad], [0.0, bad]]))
    assert returns.share[number].tolist() == [0.0, 0.0]
    every = torch.arange(len(steps))
    value, _ = returns.value_and_end(every, number[:1].expand(len(steps)))
    assert not value.any()


def test_expert_rules_follow_the_goal():
    steps, lengths = rows()
    rule = first_hit_within(1, 10)
    table = GoalTable([steps], "observation", 0.9, GoalReward(), partial(select_episodes, rule))
    goals = steps["next", "observation"][::5]
    number, returns = table.look_up(goals)
    seen = set()
    for goal, i in zip(goals, number, strict=True):
        relabelled = relabel_goal(steps, goal).split(lengths.tolist())
        assert returns.experts[i].tolist() == [rule(episode) for episode in relabelled]
        seen.update(returns.experts[i].tolist())
    assert seen == {True, False}


def test_each_goal_is_searched_once(monkeypatch):
    steps, _ = rows()
    table = GoalTable([steps], "observation", 0.9, GoalReward())
    seen, reached = [], GoalReward.reached
    monkeypatch.setattr(
        GoalReward,
        "reached",
        lambda self, places, goal: seen.append(1) or reached(self, places, goal),
    )
    goals = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    first = table.look_up(goals)
    assert len(seen) == 2
    again = table.look_up(goals)
    assert len(seen) == 2 and again[1] is first[1] and torch.equal(first[0], again[0])
    table.look_up(goals[:1])
    assert len(seen) == 2


def test_old_goals_are_given_up(monkeypatch):
    monkeypatch.setattr(module, "GOALS", 3)
    steps, _ = rows()
    table = GoalTable([steps], "observation", 0.9, GoalReward())
    for i in range(10):
        table.look_up(torch.tensor([[float(i), 0.0], [0.0, 0.0]]))
        assert len(table.goals) <= 3 and (0.0, 0.0) in table.goals
