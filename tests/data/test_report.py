import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.data.experts import episode_length, top_share_by_return
from torchrl_rad.data.report import DataReport, describe_rows, report


def table(lengths=(4, 3, 5), width=3, seed=0):
    """Clean data; the ids are 10, 11, ... so that an id is not mistaken for a position."""
    generator = torch.Generator().manual_seed(seed)
    lengths = torch.tensor(lengths)
    total = int(lengths.sum())
    ends = lengths.cumsum(0) - 1
    states = torch.randn(total, width, generator=generator)
    following = states.roll(-1, 0)
    following[ends] = torch.randn(len(lengths), width, generator=generator)
    done = torch.zeros(total, 1, dtype=torch.bool)
    done[ends] = True
    return TensorDict(
        {
            "observation": states,
            "action": torch.rand(total, 2, generator=generator) * 2 - 1,
            "episode": torch.arange(10, 10 + len(lengths)).repeat_interleave(lengths),
            "next": {
                "observation": following,
                "reward": torch.rand(total, 1, generator=generator),
                "terminated": torch.zeros_like(done),
                "truncated": done,
                "done": done.clone(),
            },
        },
        [total],
    )


def only_fault(td, **kwargs):
    found = report(td, **kwargs)
    assert len(found.faults) == 1, found.faults
    assert not found.ok and found.faults[0] in str(found)
    return found.faults[0]


def test_clean_data():
    td = table()
    found = report(td)
    assert found.ok and found.faults == [] and found.warnings == []
    assert (found.episodes, found.steps) == (3, 12)
    assert found.length == (3.0, 4.0, 5.0)
    sums = [part.double().sum().item() for part in td["next", "reward"].split([4, 3, 5])]
    assert found.returns == pytest.approx((min(sums), sum(sums) / 3, max(sums)))
    assert found.duplicate_episodes == 0 and found.duplicate_rows == 0.0
    assert found.constant_observation == [] and found.constant_action == []
    assert found.expert_share is None and found.coverage is None


def test_text():
    text = str(report(table(), expert=lambda e: len(e) > 3, starts=torch.zeros(1, 1)))
    assert text.startswith("12 steps in 3 episodes: no faults")
    assert "3 / 4 / 5 (min / mean / max)" in text
    assert "66.7 %" in text and "start states covered" in text
    assert str(DataReport(faults=["a", "b"])).splitlines()[0].endswith("2 faults")


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("key", ["action", ("next", "reward")])
def test_not_finite(key, bad):
    td = table()
    td[key][5, 0] = bad
    assert only_fault(td) == f"NaN or Inf in {key!r} at 1 row: episode 11 step 1"


def test_nan_in_a_state_is_not_also_a_broken_chain():
    td = table()
    td["observation"][6] = torch.nan
    td["next", "observation"][5] = torch.nan
    assert report(td).faults == [
        "NaN or Inf in 'observation' at 1 row: episode 11 step 2",
        "NaN or Inf in ('next', 'observation') at 1 row: episode 11 step 1",
    ]


def test_done_without_a_reason():
    td = table()
    td["next", "truncated"][6] = False
    assert only_fault(td) == "done is not terminated | truncated at 1 row: episode 11 step 2"


def test_a_reason_without_done():
    td = table()
    td["next", "done"][3] = False
    assert only_fault(td) == "done is not terminated | truncated at 1 row: episode 10 step 3"


def test_done_in_the_middle():
    td = table()
    td["next", "done"][8] = td["next", "terminated"][8] = True
    assert only_fault(td) == "an episode goes on after done at 1 row: episode 12 step 1"


def test_no_end():
    td = table()
    td["next", "done"][11] = td["next", "truncated"][11] = False
    assert only_fault(td) == "an episode does not end with done at 1 row: episode 12 step 4"


def test_rows_that_do_not_lie_together():
    td = table((4, 3, 5))
    td["episode"] = torch.tensor([10] * 4 + [11] * 3 + [10] * 5)
    expected = "the rows of an episode do not lie together: episode 10 comes back at row 7"
    assert only_fault(td) == expected
    assert report(td).episodes == 2


def test_broken_chain():
    td = table()
    td["next", "observation"][4, 1] += 0.1
    expected = "('next', 'observation') is not the next row's observation at 1 row: "
    assert only_fault(td) == expected + "episode 11 step 0"


def test_rounding_is_no_broken_chain():
    td = table()
    td["next", "observation"] *= 1 + 1e-6
    assert report(td).ok


def test_repeated_episode():
    td = table((4, 4, 3))
    copy = td[:4].clone()
    copy["episode"] = torch.full((4,), 20)
    both = torch.cat([td, copy])
    expected = "episode 20 repeats episode 10 from step 0 on (4 steps)"
    assert only_fault(both) == f"episodes with identical content: {expected}"
    found = report(both)
    assert found.duplicate_episodes == 1
    assert found.duplicate_rows == pytest.approx(4 / 15)


def test_repeated_rows_are_no_repeated_episode():
    td = table((4, 4))
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        td[key][4:6] = td[key][0:2]
    td["next", "observation"][5] = td["observation"][6]
    found = report(td)
    assert found.duplicate_episodes == 0
    assert found.duplicate_rows == pytest.approx(1 / 8)


def test_the_order_of_rows_tells_episodes_apart():
    td = table((3,))
    flip = td[[2, 1, 0]].clone()
    flip["episode"] += 1
    found = report(torch.cat([td, flip]))
    assert found.duplicate_rows == 0.5 and found.duplicate_episodes == 0


def test_zero_has_no_sign():
    td = torch.cat([table((2,)), table((2,))])
    td["episode"] = torch.tensor([0, 0, 1, 1])
    td["action"][:2, 0], td["action"][2:, 0] = 0.0, -0.0
    assert report(td).duplicate_episodes == 1


def test_one_constant_feature_is_a_warning():
    td = table()
    td["action"][:, 1] = 0.5
    found = report(td)
    assert found.ok and found.constant_action == [1] and found.constant_observation == []
    assert found.warnings == ["'action' never changes in dimensions [1] of 2"]


@pytest.mark.parametrize("key", ["observation", "action"])
def test_nothing_changes(key):
    td = table()
    td[key] = torch.zeros_like(td[key])
    if key == "observation":
        td["next", key] = td[key].clone()
    assert only_fault(td) == f"{key!r} is the same in all 12 rows"


def test_wrong_dtype_and_shape():
    td = table()
    td["observation"] = td["observation"].double()
    td["next", "reward"] = td["next", "reward"].squeeze(-1)
    td["next", "done"] = td["next", "done"].to(torch.uint8)
    assert report(td).faults == [
        "'observation' is torch.float64, expected torch.float32",
        "('next', 'reward') has shape [12], expected [T, 1]",
        "('next', 'done') is torch.uint8, expected torch.bool",
    ]


def test_next_observation_of_another_width():
    td = table()
    td["next", "observation"] = td["next", "observation"][:, :2]
    assert "but ('next', 'observation') has [12, 2]" in only_fault(td)


def test_actions_outside():
    td = table()
    td["action"][7, 1] = -1.5
    found = report(td)
    assert found.ok and found.actions_outside == pytest.approx(1 / 12)
    assert found.warnings == ["actions outside [-1, 1] at 1 row: episode 12 step 0"]


def test_no_rewards():
    td = table()
    td["next", "reward"].zero_()
    found = report(td)
    assert found.returns == (0.0, 0.0, 0.0)
    assert found.warnings == ["every reward is 0: label the data before retrieving from it"]


def test_expert_share():
    seen = []

    def long(episode):
        seen.append((episode["episode"].unique().tolist(), len(episode)))
        return len(episode) >= 4

    assert report(table(), expert=long).expert_share == pytest.approx(2 / 3)
    assert seen == [([10], 4), ([11], 3), ([12], 5)]


def test_rules_that_compare_episodes():
    assert report(table((2, 2, 2, 2)), expert=top_share_by_return(0.25)).expert_share == 0.25


def test_no_expert_at_all():
    fault = only_fault(table(), expert=episode_length(1000))
    assert fault == "the expert rule episode_length(1000) keeps none of 3 episodes"


def test_coverage_by_hand():
    td = table((3,))
    td["observation"][:, :2] = torch.tensor([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    td["next", "observation"][:2] = td["observation"][1:]
    starts = torch.tensor([[0.5, 0.0], [0.4, 0.4], [5.0, 0.2], [0.0, 4.9]])  # second: 0.566 away
    found = report(td, starts=starts)
    assert found.ok and found.coverage == 0.75
    assert found.warnings == [
        "1 of 4 start states have no recorded state within 0.5, the first is start 1 at [0.4, 0.4]"
    ]


def test_coverage_ignores_broken_rows():
    td = table()
    td["observation"][0] = torch.nan
    assert report(td, starts=td["observation"][1:3]).coverage == 1.0


@pytest.mark.parametrize("shape", [(3,), (2, 4), (0, 2), (2, 0)])
def test_starts_of_another_shape(shape):
    with pytest.raises(ValueError, match="starts has shape"):
        report(table(), starts=torch.zeros(shape))


def test_starts_that_are_not_finite():
    with pytest.raises(ValueError, match="NaN or Inf"):
        report(table(), starts=torch.full((1, 2), torch.nan))


def test_missing_entry():
    td = table()
    del td["next", "truncated"]
    with pytest.raises(KeyError) as caught:
        report(td)
    assert caught.value.args[0].startswith("entries [('next', 'truncated')] are missing; the data")


def test_no_steps():
    assert only_fault(table()[:0]) == "there are no steps"


def test_one_row():
    assert report(table((1,))).ok


def test_many_places_are_counted():
    rows = torch.ones(8, dtype=torch.bool)
    text = describe_rows(torch.zeros(8, dtype=torch.int64), rows)
    assert text.startswith("8 rows: episode 0 step 0, ") and text.endswith("step 4, and 3 more")


def test_all_faults_at_once_are_all_named():
    td = table((4, 3, 5))
    td["action"][0, 0] = torch.nan
    td["next", "done"][1] = td["next", "terminated"][1] = True
    td["next", "observation"][4] += 1.0
    td["next", "done"][11] = td["next", "truncated"][11] = False
    faults = "\n".join(report(td).faults)
    places = ["episode 10 step 0", "episode 10 step 1", "episode 11 step 0", "episode 12 step 4"]
    assert [place for place in places if place not in faults] == []


@settings(max_examples=40, deadline=None)
@given(lengths=st.lists(st.integers(2, 6), min_size=1, max_size=6), data=st.data())
def test_a_planted_fault_is_named_where_it_lies(lengths, data):
    td = table(lengths)
    assert report(td).ok
    which = data.draw(st.integers(0, len(lengths) - 1))
    step = data.draw(st.integers(0, lengths[which] - 2))  # never the last step
    row = sum(lengths[:which]) + step
    kind = data.draw(st.sampled_from(["nan", "done", "chain"]))
    if kind == "nan":
        td["next", "reward"][row] = torch.nan
    elif kind == "done":
        td["next", "done"][row] = td["next", "truncated"][row] = True
    else:
        td["next", "observation"][row] += 1.0
    assert only_fault(td).endswith(f"1 row: episode {10 + which} step {step}")


def test_the_table_is_left_as_it_is():
    td = table()
    before = td.clone()
    report(td, expert=lambda e: True, starts=torch.zeros(1, 2))
    assert all(torch.equal(td[key], before[key]) for key in before.keys(True, True))


def test_cost_of_a_large_table():
    td = table([100] * 2000, width=4)
    begin = time.perf_counter()
    assert report(td, starts=torch.zeros(100, 2)).ok
    assert time.perf_counter() - begin < 5.0  # 0.3 s; a loop over 200,000 rows takes far longer
