"""Files in D4RL's layout: every family, and what a file can get wrong."""

from __future__ import annotations

import builtins

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_rad.data import data_report, episode_lengths
from torchrl_rad.data.hdf5 import has_successor, load_hdf5

h5py = pytest.importorskip("h5py")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "set.hdf5"


def marked(count, rows):
    flags = np.zeros(count, bool)
    flags[list(rows)] = True
    return flags


def rows(count=6, width=3, moves=2, **changes):
    """The arrays that every file has."""
    rng = np.random.default_rng(0)
    arrays = {
        "observations": rng.normal(size=(count, width)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (count, moves)).astype(np.float32),
        "rewards": rng.uniform(0.5, 1, count).astype(np.float32),
        "terminals": np.arange(count) == 2,
        "timeouts": np.arange(count) == count - 1,
    }
    return {key: value for key, value in {**arrays, **changes}.items() if value is not None}


def write(path, arrays):
    with h5py.File(path, "w") as file:
        for key, value in arrays.items():
            file[key] = value
    return path


def ends(td, name="done"):
    return td["next", name].squeeze(-1).nonzero().squeeze(-1).tolist()


def lengths(td):
    return episode_lengths(td).tolist()


def check_table(td):
    """Nothing that would make training wrong."""
    assert data_report(td).ok
    assert {key: value.dtype for key, value in td["next"].items()} == {
        "observation": torch.float32,
        "reward": torch.float32,
        "terminated": torch.bool,
        "truncated": torch.bool,
        "done": torch.bool,
    }


# families


def test_locomotion(path):
    arrays = rows(7, terminals=marked(7, [2]), timeouts=marked(7, [5]))
    arrays["infos/qpos"] = np.arange(14.0).reshape(7, 2)
    arrays["infos/qvel"] = np.arange(21.0).reshape(7, 3)
    arrays["metadata/policy/fc0/weight"] = np.ones((2, 2))
    arrays["metadata/algorithm"] = "SAC"
    td = load_hdf5(write(path, arrays), infos=("qpos", "qvel"))
    check_table(td)
    assert td["episode"].tolist() == [0, 0, 0, 1, 1, 1, 2]
    states = arrays["observations"]
    np.testing.assert_array_equal(td["observation"], states)
    np.testing.assert_array_equal(td["action"], arrays["actions"])
    np.testing.assert_array_equal(td["next", "reward"][:, 0], arrays["rewards"])
    np.testing.assert_array_equal(td["next", "observation"], states[[1, 2, 2, 4, 5, 5, 6]])
    assert ends(td, "terminated") == [2]
    assert ends(td, "truncated") == [5, 6]  # the file ends within an episode
    assert ends(td) == [2, 5, 6]
    assert has_successor(td).tolist() == [True, True, False, True, True, False, False]
    np.testing.assert_array_equal(td["info", "qpos"], arrays["infos/qpos"])
    np.testing.assert_array_equal(td["info", "qvel"], arrays["infos/qvel"])
    assert td["info", "qvel"].dtype == torch.float32


def test_infos_are_left_alone_unless_asked_for(path):
    td = load_hdf5(write(path, {**rows(), "infos/qpos": np.ones((6, 2))}))
    assert "info" not in td.keys()


def test_length_and_return_count_the_last_row(path):
    # locomotion's expert rule: length exactly 1000
    arrays = rows(1500, terminals=marked(1500, []), timeouts=marked(1500, [999, 1499]))
    td = load_hdf5(write(path, arrays))
    assert lengths(td) == [1000, 500]
    expected = arrays["rewards"][:1000].astype(np.float64).sum()
    assert td["next", "reward"][:1000].double().sum().item() == pytest.approx(expected)


def test_locomotion_of_version_0(path):
    # without timeouts only the limit tells that an episode was cut: the next row is of another
    arrays = rows(9, terminals=marked(9, [3]), timeouts=None)
    td = load_hdf5(write(path, arrays), max_steps=3)
    assert lengths(td) == [3, 1, 3, 2]
    assert ends(td, "terminated") == [3]
    assert (~has_successor(td)).nonzero().squeeze(-1).tolist() == [2, 3, 6, 8]


def test_halfcheetah_of_version_0_needs_the_limit(path):
    write(path, rows(terminals=marked(6, []), timeouts=None))
    with pytest.raises(ValueError, match="nothing says where episodes end. Pass max_steps"):
        load_hdf5(path)
    td = load_hdf5(path, max_steps=4)
    assert lengths(td) == [4, 2] and ends(td, "terminated") == []
    assert has_successor(td).tolist() == [True, True, True, False, True, False]


def antmaze(count=12):
    hit = marked(count, [2, 3, 4, 7, 8, 9, 11])
    return rows(
        count,
        rewards=hit.astype(np.float32),
        terminals=hit,
        timeouts=marked(count, [5, 11]),
        **{"infos/goal": np.repeat(np.float32([[1, 2], [3, 4]]), count // 2, 0)},
    )


def test_antmaze_goes_on_at_the_goal(path):
    td = load_hdf5(write(path, antmaze()))
    check_table(td)
    assert lengths(td) == [6, 6]
    assert ends(td) == ends(td, "truncated") == [5, 11] and ends(td, "terminated") == []
    assert td["next", "reward"].sum() == 7


def test_antmaze_with_other_ends(path):
    write(path, antmaze())
    td = load_hdf5(path, ends=("terminals", "timeouts"))
    assert ends(td) == [2, 3, 4, 5, 7, 8, 9, 11]
    assert ends(td, "terminated") == [2, 3, 4, 7, 8, 9, 11] and ends(td, "truncated") == [5]


def test_antmaze_with_rewards_of_minus_one_and_zero(path):
    arrays = antmaze()
    td = load_hdf5(write(path, {**arrays, "rewards": arrays["rewards"] - 1}))
    assert lengths(td) == [6, 6]


@pytest.mark.parametrize("pay", [0.0, 1.0])
def test_ends_in_a_row_that_pay_no_more_than_other_rows(path, pay):
    arrays = antmaze()
    arrays["rewards"][0] = arrays["rewards"][2] = pay
    assert ends(load_hdf5(write(path, arrays))) == [2, 3, 4, 5, 7, 8, 9, 11]


def test_episodes_of_one_row(path):
    td = load_hdf5(write(path, rows(terminals=np.ones(6, bool))))
    assert lengths(td) == [1] * 6 and ends(td, "terminated") == list(range(6))


def test_true_ends_at_the_goal_are_cut(path):
    # rewards and terminals agree as in antmaze, but no end follows another one
    hit = marked(12, [3, 7])
    arrays = rows(12, rewards=hit.astype(float), terminals=hit, timeouts=marked(12, [11]))
    td = load_hdf5(write(path, arrays))
    assert lengths(td) == [4, 4, 4] and ends(td, "terminated") == [3, 7]


def test_antmaze_without_timeouts(path):
    write(path, {key: value for key, value in antmaze().items() if key != "timeouts"})
    with pytest.raises(ValueError, match="'terminals' are rows at the goal, not ends"):
        load_hdf5(path)


def maze2d(timeouts):
    goal = np.float32([[1, 1]] * 4 + [[2, 1]] * 3 + [[2, 5]] * 3)
    return rows(
        10, 4, terminals=marked(10, []), timeouts=marked(10, timeouts), **{"infos/goal": goal}
    )


def test_maze2d_stream_is_cut_where_the_goal_changes(path):
    arrays = maze2d([])
    td = load_hdf5(write(path, arrays))
    assert lengths(td) == [4, 3, 3]
    assert ends(td, "truncated") == [3, 6, 9]
    # the ball is not reset: the following row is the successor, but for the last one
    np.testing.assert_array_equal(td["next", "observation"][:-1], arrays["observations"][1:])
    assert has_successor(td).tolist() == [True] * 9 + [False]


def test_maze2d_stream_is_cut_by_steps(path):
    write(path, maze2d([3, 6]))
    assert lengths(load_hdf5(path)) == [4, 3, 3]
    td = load_hdf5(path, ends=(), max_steps=4)
    assert lengths(td) == [4, 4, 2] and has_successor(td).sum() == 9
    both = load_hdf5(path, ends=("infos/goal",), max_steps=2)
    assert lengths(both) == [2, 2, 2, 1, 2, 1]
    reset = load_hdf5(path, max_steps=3)  # timeouts, as the file says, and steps
    assert lengths(reset) == [3, 1, 3, 3] and has_successor(reset).sum() == 6


def test_kitchen(path):
    arrays = rows(
        7,
        60,
        9,
        rewards=np.float32([[0], [1], [2], [2], [0], [1], [1]]),
        terminals=marked(7, [3, 6]),
        timeouts=None,
    )
    td = load_hdf5(write(path, arrays))
    assert lengths(td) == [4, 3] and ends(td, "terminated") == [3, 6]
    assert td["next", "reward"].flatten().tolist() == [0, 1, 2, 2, 0, 1, 1]


def test_recorded_next_observations_are_taken(path):
    following = np.random.default_rng(1).normal(size=(6, 3)).astype(np.float32)
    td = load_hdf5(write(path, rows(next_observations=following)))
    np.testing.assert_array_equal(td["next", "observation"], following)
    assert has_successor(td).all()


def test_a_state_that_stands_still_is_a_successor(path):
    states = np.float32([[1], [1], [2], [3], [3], [4]])
    td = load_hdf5(write(path, rows(observations=states)))
    assert has_successor(td).tolist() == [True, True, False, True, True, False]


def test_other_dtypes(path):
    arrays = rows()
    arrays["observations"] = arrays["observations"].astype(np.float64)
    arrays["terminals"] = arrays["terminals"].astype(np.float32)[:, None]
    arrays["timeouts"] = arrays["timeouts"].astype(np.uint8)
    arrays["actions"] = np.arange(6)
    td = load_hdf5(write(path, arrays))
    assert td["action"].shape == (6, 1) and lengths(td) == [3, 3]
    assert td["observation"].dtype == torch.float32


@settings(max_examples=40, deadline=None)
@given(data=st.data(), max_steps=st.none() | st.integers(1, 6))
def test_against_a_loop(tmp_path_factory, data, max_steps):
    count = data.draw(st.integers(1, 15))
    flags = st.lists(st.booleans(), min_size=count, max_size=count)
    terminals, timeouts = data.draw(flags), data.draw(flags)
    path = tmp_path_factory.mktemp("loop") / "set.hdf5"
    arrays = rows(count, terminals=np.array(terminals), timeouts=np.array(timeouts))
    td = load_hdf5(write(path, arrays), ends=("terminals", "timeouts"), max_steps=max_steps)
    episode, step, ids, following = 0, 0, [], []
    for row in range(count):
        step += 1
        ids.append(episode)
        over = terminals[row] or timeouts[row] or step == max_steps or row == count - 1
        following.append(row if over else row + 1)
        episode, step = (episode + 1, 0) if over else (episode, step)
    assert td["episode"].tolist() == ids
    np.testing.assert_array_equal(td["next", "observation"], arrays["observations"][following])
    assert ends(td, "terminated") == [row for row in range(count) if terminals[row]]


# errors


@pytest.mark.parametrize("missing", ["observations", "actions", "rewards"])
def test_missing_entry(path, missing):
    write(path, rows(**{missing: None}, **{"infos/goal": np.ones((6, 2))}))
    with pytest.raises(KeyError, match=missing) as caught:
        load_hdf5(path)
    assert "timeouts" in str(caught.value) and "infos/goal" in str(caught.value)


def test_missing_info(path):
    write(path, rows())
    with pytest.raises(KeyError, match="infos/qpos"):
        load_hdf5(path, infos=("qpos",))


def test_a_minari_file(path):
    write(path, {"episode_0/observations": np.ones((3, 2))})
    with pytest.raises(KeyError, match="a Minari data set is loaded by its id"):
        load_hdf5(path)


def test_an_entry_that_is_a_group(path):
    write(path, {**rows(actions=None), "actions/arm": np.ones((6, 1))})
    with pytest.raises(KeyError, match="lacks .'actions'."):
        load_hdf5(path)


@pytest.mark.parametrize("entry", ["actions", "rewards", "terminals", "infos/qpos"])
def test_lengths_that_differ(path, entry):
    arrays = {**rows(), "infos/qpos": np.ones((6, 2))}
    arrays[entry] = arrays[entry][:4]
    with pytest.raises(ValueError, match=f"'{entry}' has 4 rows where the observations have 6"):
        load_hdf5(write(path, arrays), infos=("qpos",))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ("observations", "'observation'"),
        ("actions", "'action'"),
        ("rewards", "('next', 'reward')"),
        ("infos/qpos", "('info', 'qpos')"),
    ],
)
def test_not_finite_is_named(path, entry, key, bad):
    arrays = {**rows(), "infos/qpos": np.ones((6, 2), np.float32)}
    arrays[entry][4] = bad
    with pytest.raises(ValueError, match="NaN or Inf") as caught:
        load_hdf5(write(path, arrays), infos=("qpos",))
    assert key in str(caught.value) and "episode 1 step 1" in str(caught.value)


def test_flags_that_are_none(path):
    write(path, rows(terminals=np.float32([0, 0, 0.5, 0, 0, 1])))
    with pytest.raises(ValueError, match="'terminals' holds 0.5 in 1 row"):
        load_hdf5(path)
    write(path, rows(timeouts=np.zeros((6, 2))))
    with pytest.raises(ValueError, match="'timeouts' has 2 columns"):
        load_hdf5(path)


def test_widths(path):
    write(path, rows(rewards=np.ones((6, 2))))
    with pytest.raises(ValueError, match="'rewards' has 2 columns"):
        load_hdf5(path)
    write(path, rows(next_observations=np.ones((6, 5))))
    with pytest.raises(ValueError, match="'next_observations' has 5 columns, expected 3"):
        load_hdf5(path)


def test_text_and_scalars(path):
    write(path, rows(actions=["left"] * 6))
    with pytest.raises(TypeError, match="'actions' has dtype object, expected numbers"):
        load_hdf5(path)
    write(path, rows(rewards=1.0))
    with pytest.raises(ValueError, match=r"'rewards' has shape \[\]"):
        load_hdf5(path)


def test_no_rows(path):
    write(path, {key: value[:0] for key, value in rows().items()})
    with pytest.raises(ValueError, match="at least one"):
        load_hdf5(path)


def test_zeros_are_not_data(path):
    write(path, rows(observations=np.zeros((6, 3))))
    with pytest.raises(ValueError, match="'observation' is 0 in all 6 rows"):
        load_hdf5(path)


def test_no_file(path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        load_hdf5(path)
    with pytest.raises(FileNotFoundError):
        load_hdf5(path.parent)


@pytest.mark.parametrize("content", [b"", b"version https://git-lfs.github.com/spec/v1\n"])
def test_not_an_hdf5_file(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is no whole HDF5 file"):
        load_hdf5(path)


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_cut_file(path, share):
    with h5py.File(path, "w") as file:
        for key, value in rows(20_000).items():
            file.create_dataset(key, data=value, compression="gzip")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match="damaged or cut short"):
        load_hdf5(path)


def test_damage_inside(path):
    with h5py.File(path, "w") as file:
        for key, value in rows(20_000).items():
            file.create_dataset(key, data=value, compression="gzip")
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 4 : len(whole) // 4 + 5000] = bytes(5000)
    path.write_bytes(whole)
    with pytest.raises(ValueError, match="damaged or cut short"):
        load_hdf5(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_steps": 0}, "max_steps is 0"),
        ({"ends": ("done",)}, r"ends names \['done'\]"),
        ({"ends": ()}, "ends is empty"),
        ({"ends": ("infos/goal",)}, r"lacks \['infos/goal'\], named in ends"),
    ],
)
def test_options(path, options, message):
    write(path, rows())
    with pytest.raises((ValueError, KeyError), match=message):
        load_hdf5(path, **options)


def test_not_installed(path, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "h5py":
            raise ImportError("No module named 'h5py'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "torchrl_rad\[offline\]"'):
        load_hdf5(path)
