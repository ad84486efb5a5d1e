import builtins
import json
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_rad.data.minari import check_content, join_stream, load_minari
from torchrl_rad.envs.adapter import ObservationAdapter

minari = pytest.importorskip("minari")
EpisodeBuffer = minari.data_collector.EpisodeBuffer
FORMATS = ["hdf5", "arrow"]
NUMBERS = ("observation", "action", ("next", "observation"), ("next", "reward"))


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    """An empty folder of local data sets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def box(width, low=-np.inf, high=np.inf, dtype=np.float64):
    return gymnasium.spaces.Box(low, high, (width,), dtype)


POINTMAZE = gymnasium.spaces.Dict(achieved_goal=box(2), desired_goal=box(2), observation=box(4))
ACTION = box(2, -1.0, 1.0, np.float32)


def pointmaze_stream(lengths, seed=0):
    """Episodes cut out of one stream at each goal, as the scripts of D4RL/pointmaze/*-v2 record."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(sum(lengths) + 1, 4))
    episodes, first = [], 0
    for length in lengths:
        state = states[first : first + length + 1]
        goal = np.tile(rng.normal(size=2), (length + 1, 1))
        hit = np.arange(length + 1) == length
        episodes.append(
            EpisodeBuffer(
                observations={
                    "observation": state,
                    "achieved_goal": state[:, :2],
                    "desired_goal": goal,
                },
                actions=rng.uniform(-1, 1, (length, 2)).astype(np.float32),
                rewards=list(hit[1:].astype(float)),
                terminations=[False] * length,
                truncations=list(hit[1:].tolist()),
                infos={
                    "success": hit.tolist(),
                    "qpos": state[:, :2],
                    "qvel": state[:, 2:],
                    "goal": goal,
                },
            )
        )
        first += length
    return episodes


def flat_episode(length=3, **changes):
    parts = {
        "observations": np.arange(2.0 * (length + 1)).reshape(length + 1, 2),
        "actions": np.linspace(-1, 1, 2 * length, dtype=np.float32).reshape(length, 2),
        "rewards": [1.0] * length,
        "terminations": [False] * (length - 1) + [True],
        "truncations": [False] * length,
    }
    return EpisodeBuffer(**{**parts, **changes})


def write(dataset_id, episodes, observation=None, action=ACTION, data_format="hdf5"):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return minari.create_dataset_from_buffers(
            dataset_id,
            episodes,
            observation_space=observation or box(2),
            action_space=action,
            data_format=data_format,
        )


def load(*args, **kwargs):
    return load_minari(*args, progress=False, **kwargs)


@pytest.mark.parametrize("data_format", FORMATS)
@pytest.mark.parametrize("maze", ["umaze", "medium", "large"])
def test_pointmaze_values(maze, data_format):
    lengths = [5, 2, 7]
    episodes = pointmaze_stream(lengths)
    write(f"D4RL/pointmaze/{maze}-v2", episodes, POINTMAZE, data_format=data_format)
    td = load(f"D4RL/pointmaze/{maze}-v2")
    assert td.batch_size == torch.Size([14])
    assert td["episode"].tolist() == [0] * 5 + [1] * 2 + [2] * 7
    states = [np.float32(e.observations["observation"]) for e in episodes]
    now = np.concatenate([s[:-1] for s in states])
    following = np.concatenate([s[1:] for s in states])
    np.testing.assert_array_equal(td["observation"], now)
    np.testing.assert_array_equal(td["next", "observation"], following)
    np.testing.assert_array_equal(td["action"], np.concatenate([e.actions for e in episodes]))
    ends = [4, 6, 13]
    assert td["next", "reward"].squeeze(-1).nonzero().squeeze(-1).tolist() == ends
    assert td["next", "truncated"].squeeze(-1).nonzero().squeeze(-1).tolist() == ends
    assert not td["next", "terminated"].any()
    assert torch.equal(td["next", "done"], td["next", "truncated"])


@pytest.mark.parametrize("data_format", FORMATS)
def test_schema(data_format):
    write("D4RL/pointmaze/umaze-v2", pointmaze_stream([3, 4]), POINTMAZE, data_format=data_format)
    td = load("D4RL/pointmaze/umaze-v2")
    found = {key: (td[key].dtype, tuple(td[key].shape)) for key in td.keys(True, True)}
    assert found == {
        "observation": (torch.float32, (7, 4)),
        "action": (torch.float32, (7, 2)),
        "episode": (torch.int64, (7,)),
        ("next", "observation"): (torch.float32, (7, 4)),
        ("next", "reward"): (torch.float32, (7, 1)),
        ("next", "terminated"): (torch.bool, (7, 1)),
        ("next", "truncated"): (torch.bool, (7, 1)),
        ("next", "done"): (torch.bool, (7, 1)),
    }


def test_adapter_orders_the_entries():
    episodes = pointmaze_stream([3])
    write("maze-v0", episodes, POINTMAZE)
    td = load("maze-v0", ObservationAdapter(("desired_goal", "observation")))
    entries = episodes[0].observations
    expected = np.concatenate([entries["desired_goal"], entries["observation"]], -1)
    np.testing.assert_array_equal(td["next", "observation"], np.float32(expected[1:]))


@pytest.mark.parametrize("data_format", FORMATS)
def test_one_episode_with_flat_observations(data_format):
    write("flat-v0", [flat_episode(3)], data_format=data_format)
    td = load("flat-v0")
    assert td["observation"].tolist() == [[0, 1], [2, 3], [4, 5]]
    assert td["next", "observation"].tolist() == [[2, 3], [4, 5], [6, 7]]
    assert td["episode"].tolist() == [0, 0, 0]
    assert td["next", "terminated"].squeeze(-1).tolist() == [False, False, True]
    assert td["next", "done"].squeeze(-1).tolist() == [False, False, True]


def test_the_order_is_minaris_beyond_ten_episodes():
    # as text, "episode_10" comes before "episode_2"
    write("many-v0", [flat_episode(2, rewards=[float(i), 0.5]) for i in range(12)])
    td = load("many-v0")
    assert td["next", "reward"][::2].squeeze(-1).tolist() == list(range(12))
    assert td["episode"][::2].tolist() == list(range(12))


def test_discrete_actions_become_one_column():
    episode = flat_episode(3, actions=np.array([0, 2, 1]))
    write("discrete-v0", [episode], action=gymnasium.spaces.Discrete(3))
    assert load("discrete-v0")["action"].tolist() == [[0.0], [2.0], [1.0]]


def test_infos_of_the_rows_own_states():
    episodes = pointmaze_stream([3, 2])
    write("D4RL/pointmaze/umaze-v2", episodes, POINTMAZE)
    td = load("D4RL/pointmaze/umaze-v2", infos=("qpos", "success"))
    expected = np.concatenate([e.infos["qpos"][:-1] for e in episodes])
    np.testing.assert_array_equal(td["info", "qpos"], np.float32(expected))
    assert td["info", "success"].shape == (5, 1) and td["info", "success"].dtype == torch.float32
    assert td["next"].keys() == load("D4RL/pointmaze/umaze-v2")["next"].keys()


def test_other_rewards():
    write("flat-v0", [flat_episode(3), flat_episode(2)])
    td = load("flat-v0", reward=lambda observations: observations[1:, 0])
    assert td["next", "reward"].flatten().tolist() == [2, 4, 6, 2, 4]
    with pytest.raises(ValueError, match="episode 0: .* gave 4 rewards .*; expected 3"):
        load("flat-v0", reward=lambda observations: observations[:, 0])


def test_progress_bar_is_optional(capsys):
    write("flat-v0", [flat_episode()])
    load("flat-v0")
    assert capsys.readouterr().err == ""
    load_minari("flat-v0")
    assert "loading flat-v0" in capsys.readouterr().err


# errors


def test_not_installed(monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "minari":
            raise ImportError("No module named 'minari'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "torchrl_rad\[offline\]"'):
        load("any-v0")


def test_unknown_id_lists_what_is_here():
    write("D4RL/pointmaze/umaze-v2", [flat_episode()])
    with pytest.raises(FileNotFoundError, match="'nothing-v0' is not here") as caught:
        load("nothing-v0")
    assert "D4RL/pointmaze/umaze-v2" in str(caught.value)
    assert "download=True" in str(caught.value)


def test_no_local_sets():
    with pytest.raises(FileNotFoundError, match="local data sets: none"):
        load("nothing-v0")


def test_download_without_a_network(monkeypatch):
    def offline(dataset_id, download=False):
        if download:
            raise ConnectionError("Name or service not known")
        raise FileNotFoundError(dataset_id)

    monkeypatch.setattr(minari, "load_dataset", offline)
    with pytest.raises(FileNotFoundError, match="downloading it failed") as caught:
        load("D4RL/pointmaze/umaze-v2", download=True)
    assert "ConnectionError: Name or service not known" in str(caught.value)
    assert isinstance(caught.value.__cause__, ConnectionError)


def test_download_is_only_asked_for_when_absent(monkeypatch):
    made = write("flat-v0", [flat_episode()])
    calls = []

    def server(dataset_id, download=False):
        calls.append(download)
        if not download:
            raise FileNotFoundError(dataset_id)
        return made

    monkeypatch.setattr(minari, "load_dataset", server)
    assert len(load("flat-v0", download=True)) == 3
    assert calls == [False, True]


def test_interrupted_download(root):
    (root / "half-v0" / "data").mkdir(parents=True)
    with pytest.raises(ValueError, match="'half-v0' is here but cannot be read"):
        load("half-v0", download=True)


def test_damaged_file(root):
    write("cut-v0", [flat_episode()])
    path = root / "cut-v0" / "data" / "main_data.hdf5"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="cannot read an episode of 'cut-v0'"):
        load("cut-v0")


def test_arrow_infos_that_minari_cannot_read():
    write("info-v0", [flat_episode(3, infos={"success": np.zeros(4)})], data_format="arrow")
    with pytest.raises(ValueError, match="record it as a list"):
        load("info-v0")


def test_empty_set():
    write("empty-v0", [])
    with pytest.raises(ValueError, match="'empty-v0' holds no episodes"):
        load("empty-v0")


def test_wrong_observation_entry():
    write("maze-v0", pointmaze_stream([3]), POINTMAZE)
    with pytest.raises(KeyError, match="state") as caught:
        load("maze-v0", ObservationAdapter(("state",)))
    assert "maze-v0" in str(caught.value) and "achieved_goal" in str(caught.value)


def test_entry_that_is_no_array():
    task = gymnasium.spaces.Dict(kettle=box(1))
    space = gymnasium.spaces.Dict(observation=box(2), achieved_goal=task)
    observations = {
        "observation": np.ones((4, 2)),
        "achieved_goal": {"kettle": np.ones((4, 1))},
    }
    write("kitchen-v0", [flat_episode(3, observations=observations)], space)
    assert load("kitchen-v0")["observation"].shape == (3, 2)
    with pytest.raises(TypeError, match="cannot make one vector"):
        load("kitchen-v0", ObservationAdapter(("achieved_goal",)))


def test_infos_that_lack_an_entry():
    write("flat-v0", [flat_episode(infos={"qpos": np.ones((4, 2))})])
    assert load("flat-v0", infos=("qpos",))["info", "qpos"].shape == (3, 2)
    with pytest.raises(KeyError, match="episode 0: infos lack 'qvel'; there are .'qpos'."):
        load("flat-v0", infos=("qvel",))
    write("bare-v0", [flat_episode()])
    with pytest.raises(KeyError, match="infos lack 'qvel'"):
        load("bare-v0", infos=("qvel",))


def test_infos_of_another_form():
    tasks = {"kettle": np.ones((4, 1))}
    write("dict-v0", [flat_episode(infos={"done": tasks, "ctrl": np.ones((3, 2))})])
    with pytest.raises(TypeError, match="'done' of the infos is no array of numbers"):
        load("dict-v0", infos=("done",))
    with pytest.raises(
        ValueError, match=r"'ctrl' of the infos has shape \[3, 2\], expected 4 rows"
    ):
        load("dict-v0", infos=("ctrl",))


def test_infos_that_are_not_finite():
    qpos = np.ones((4, 2))
    qpos[1] = np.nan
    write("nan-v0", [flat_episode(infos={"qpos": qpos})])
    with pytest.raises(ValueError, match=r"\('info', 'qpos'\) at 1 row: episode 0 step 1"):
        load("nan-v0", infos=("qpos",))


def test_dict_actions():
    space = gymnasium.spaces.Dict(arm=box(2))
    write("dict-v0", [flat_episode(3, actions={"arm": np.ones((3, 2))})], action=space)
    with pytest.raises(TypeError, match="actions are a dict"):
        load("dict-v0")


def test_an_observation_is_missing():
    write("short-v0", [flat_episode(), flat_episode(3, observations=np.ones((3, 2)))])
    with pytest.raises(ValueError, match="episode 1: 3 rewards with 3 observations"):
        load("short-v0")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize(
    ("entry", "key"),
    [("observations", "'observation'"), ("actions", "'action'"), ("rewards", "'next', 'reward'")],
)
def test_not_finite_is_named(entry, key, bad):
    damaged = flat_episode()
    values = np.array(getattr(damaged, entry))
    values[1] = bad
    write("nan-v0", [flat_episode(), flat_episode(3, **{entry: values})])
    with pytest.raises(ValueError, match="NaN or Inf") as caught:
        load("nan-v0")
    assert key in str(caught.value) and "episode 1 step 1" in str(caught.value)


def test_the_last_observation_is_checked_too():
    observations = np.ones((4, 2))
    observations[3, 1] = np.nan
    write("nan-v0", [flat_episode(3, observations=observations)])
    with pytest.raises(ValueError, match=r"\('next', 'observation'\) at 1 row: episode 0 step 2"):
        load("nan-v0")


@pytest.mark.parametrize("entry", ["total_steps", "total_episodes"])
def test_a_part_of_the_data(root, entry):
    write("part-v0", [flat_episode(3), flat_episode(2)], data_format="arrow")
    path = root / "part-v0" / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata[entry] -= 1  # less claimed than there is
    path.write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match="came, expected"):
        load("part-v0")


@pytest.mark.parametrize("data_format", FORMATS)
def test_a_long_episode_comes_whole_or_not_at_all(data_format):
    # Minari reads one batch an episode: 32,768 rows of an Arrow file
    length = 40_000
    long = flat_episode(length, observations=np.ones((length + 1, 2)))
    write("long-v0", [long], data_format=data_format)
    if data_format == "hdf5":
        assert len(load("long-v0")) == length
    else:
        with pytest.raises(ValueError, match="1 episodes with 32767 steps came.*HDF5"):
            load("long-v0")


@pytest.mark.parametrize("entry", ["observations", "actions"])
def test_zeros_are_not_data(entry):
    values = np.zeros_like(getattr(flat_episode(), entry))
    write("zero-v0", [flat_episode(3, **{entry: values})])
    with pytest.raises(ValueError, match=f"'{entry[:-1]}' is 0 in all 3 rows"):
        load("zero-v0")


def test_rewards_may_be_zero():
    write("unlabelled-v0", [flat_episode(3, rewards=[0.0] * 3)])
    assert not load("unlabelled-v0")["next", "reward"].any()


# join_stream


def stream_table(lengths, jumps=(), seed=0):
    """Episodes of one walk in the plane, interrupted before the episodes named in ``jumps``."""
    generator = torch.Generator().manual_seed(seed)
    total = sum(lengths)
    episode = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    walk = torch.randn(total + 1, 2, generator=generator)
    now, following = walk[:-1].clone(), walk[1:].clone()
    ends = torch.tensor(lengths).cumsum(0) - 1
    for jump in jumps:
        following[ends[jump - 1]] += 100.0
    done = torch.zeros(total, 1, dtype=torch.bool)
    done[ends] = True
    after = {
        "observation": following,
        "reward": torch.rand(total, 1, generator=generator),
        "terminated": torch.zeros_like(done),
        "truncated": done,
        "done": done.clone(),
    }
    return TensorDict(
        {"observation": now, "action": walk[1:] - 1.0, "episode": episode + 7, "next": after},
        [total],
    )


def ends_of(td, name="done"):
    return td["next", name].squeeze(-1).nonzero().squeeze(-1).tolist()


def test_join_and_cut_by_hand():
    # streams of 2 + 3 + 4 and 2 rows
    joined = join_stream(stream_table([2, 3, 4, 2], jumps=[3]), max_steps=4)
    assert joined["episode"].tolist() == [0] * 4 + [1] * 4 + [2] + [3] * 2
    assert ends_of(joined) == ends_of(joined, "truncated") == [3, 7, 8, 10]
    assert ends_of(joined, "terminated") == []


def test_join_leaves_the_rest_and_the_argument():
    td = stream_table([2, 3, 4])
    before = td.clone()
    joined = join_stream(td, 5)
    assert all(torch.equal(td[key], before[key]) for key in before.keys(True, True))
    assert all(torch.equal(joined[key], td[key]) for key in NUMBERS)


def test_join_tolerance():
    td = stream_table([2, 2])
    td["next", "observation"][1, 0] += 0.01
    assert join_stream(td, 10)["episode"].tolist() == [0, 0, 1, 1]
    assert join_stream(td, 10, atol=0.02)["episode"].tolist() == [0, 0, 0, 0]


def test_one_differing_feature_is_enough():
    td = stream_table([2, 2])
    td["next", "observation"][1, 1] += 1.0
    assert join_stream(td, 10)["episode"].tolist() == [0, 0, 1, 1]


def test_nan_joins_nothing():
    td = stream_table([2, 2])
    td["next", "observation"][1] = torch.nan
    td["observation"][2] = torch.nan
    assert join_stream(td, 10)["episode"].tolist() == [0, 0, 1, 1]


def test_termination_counts_only_where_the_stream_ends():
    td = stream_table([2, 2, 2], jumps=[2])
    td["next", "terminated"] = td["next", "done"].clone()
    joined = join_stream(td, 10)
    assert ends_of(joined, "terminated") == [3, 5]
    assert ends_of(joined, "truncated") == ends_of(joined) == [3, 5]


def test_join_of_a_memory_mapped_table(tmp_path):
    td = stream_table([2, 3])
    joined = join_stream(td.memmap(tmp_path), 10)
    assert joined["episode"].tolist() == [0] * 5


def test_join_of_nothing_and_of_one_episode():
    td = stream_table([3])
    assert len(join_stream(td[:0], 5)) == 0
    assert ends_of(join_stream(td, 2)) == [1, 2]


def test_join_errors():
    td = stream_table([2, 2])
    with pytest.raises(ValueError, match="max_steps is 0"):
        join_stream(td, 0)
    td["episode"] = torch.tensor([0, 1, 0, 1])
    with pytest.raises(ValueError, match="do not lie together"):
        join_stream(td, 5)


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=8),
    max_steps=st.integers(1, 12),
    data=st.data(),
)
def test_join_against_a_loop(lengths, max_steps, data):
    jumps = data.draw(st.sets(st.integers(1, max(1, len(lengths) - 1))))
    jumps = {jump for jump in jumps if jump < len(lengths)}
    joined = join_stream(stream_table(lengths, jumps), max_steps)
    expected, current, used = [], -1, max_steps
    for i, length in enumerate(lengths):
        used = max_steps if i == 0 or i in jumps else used
        for _ in range(length):
            if used == max_steps:
                current, used = current + 1, 0
            expected.append(current)
            used += 1
    assert joined["episode"].tolist() == expected
    last = [i for i, e in enumerate(expected) if expected[i + 1 : i + 2] != [e]]
    assert ends_of(joined) == last


@pytest.mark.parametrize("data_format", FORMATS)
def test_pointmaze_is_joined(data_format):
    write(
        "D4RL/pointmaze/large-v2", pointmaze_stream([5, 2, 7]), POINTMAZE, data_format=data_format
    )
    td = load("D4RL/pointmaze/large-v2")
    assert join_stream(td, 6)["episode"].tolist() == [0] * 6 + [1] * 6 + [2] * 2
    with_goal = load("D4RL/pointmaze/large-v2", ObservationAdapter(("observation", "desired_goal")))
    assert join_stream(with_goal, 20)["episode"].tolist() == [0] * 5 + [1] * 2 + [2] * 7


def test_check_content_accepts_what_is_complete():
    assert check_content(stream_table([2, 3]), episodes=2, steps=5) is None
    with pytest.raises(ValueError, match="2 episodes with 5 steps came, expected 3 with 5"):
        check_content(stream_table([2, 3]), episodes=3, steps=5)
