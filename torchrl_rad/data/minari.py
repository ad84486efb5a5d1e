"""Minari data sets as a flat table of steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from torchrl_rad.data.episodes import episode_lengths, step_and_remaining
from torchrl_rad.data.report import describe_rows
from torchrl_rad.envs.adapter import ObservationAdapter

__all__ = ["check_content", "join_stream", "load_minari"]


def load_minari(
    dataset_id: str,
    adapter: Callable[[Any], np.ndarray] | None = None,
    download: bool = False,
    progress: bool = True,
    infos: Sequence[str] = (),
    reward: Callable[[Any], Any] | None = None,
) -> TensorDict:
    """Loads any Minari data set, HDF5 or Arrow, as a flat table of steps, and checks what came.

    Args:
        dataset_id (str): for example ``"D4RL/pointmaze/umaze-v2"``. Local sets lie in
            ``$MINARI_DATASETS_PATH`` (``~/.minari/datasets``).
        adapter (callable, optional): observations of one episode [L + 1, ...] -> array [L + 1, S].
            Defaults to :class:`~torchrl_rad.envs.adapter.ObservationAdapter`, which takes the entry
            ``"observation"`` of a dict.
        download (bool, optional): fetch the set if it is not here. Defaults to ``False``.
        progress (bool, optional): show a progress bar. Defaults to ``True``.
        infos (sequence of str, optional): entries of the infos to keep, such as ``"qpos"`` and
            ``"qvel"``, the simulator's state of the row. Defaults to none.
        reward (callable, optional): observations of one episode [L + 1, ...] -> rewards [L] that
            replace the recorded ones, such as
            :func:`~torchrl_rad.data.kitchen.newly_done`.

    Returns:
        TensorDict [T], episodes one after the other: ``observation`` [T, S] and ``action`` [T, A]
        float32, ``episode`` [T] int64 (Minari's id), ``("next", "observation")`` [T, S] and
        ``("next", "reward")`` [T, 1] float32, ``("next", "terminated")``, ``("next", "truncated")``
        and ``("next", "done")`` [T, 1] bool, ``("info", name)`` [T, .] float32.

    Raises:
        ImportError: Minari is not installed.
        FileNotFoundError: the set is not here, and ``download`` is off or failed.
        KeyError: the adapter names an entry that the observations lack, or infos lack one.
        TypeError: observations or actions are not arrays.
        ValueError: the set cannot be read, is empty, or fails :func:`check_content`.

    Examples:
        >>> import os, tempfile, gymnasium, minari
        >>> from unittest import mock
        >>> space = gymnasium.spaces.Box(-9, 9, (1,))
        >>> episode = minari.data_collector.EpisodeBuffer(
        ...     observations=np.float32([[1], [2], [3]]), actions=np.float32([[0.1], [0.2]]),
        ...     rewards=[0.0, 1.0], terminations=[False, False], truncations=[False, True])
        >>> about = dict.fromkeys(
        ...     ["algorithm_name", "author", "author_email", "code_permalink", "description"], "-")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     with mock.patch.dict(os.environ, MINARI_DATASETS_PATH=root):
        ...         made = minari.create_dataset_from_buffers(
        ...             "tiny-v0", [episode], observation_space=space, action_space=space, **about)
        ...         steps = load_minari("tiny-v0", progress=False)
        >>> steps["next", "observation"].tolist(), steps["next", "done"].tolist()
        ([[2.0], [3.0]], [[False], [True]])
    """
    dataset = _open(dataset_id, download)
    if dataset.total_episodes == 0:
        raise ValueError(f"Minari data set {dataset_id!r} holds no episodes; record some first.")
    adapter = ObservationAdapter() if adapter is None else adapter
    bar = tqdm(
        _episodes(dataset, dataset_id),
        desc=f"loading {dataset_id}",
        unit="episode",
        total=dataset.total_episodes,
        disable=not progress,
    )
    episodes = [_columns(episode, adapter, reward, infos, dataset_id) for episode in bar]
    steps = TensorDict({}, [sum(len(columns["action"]) for columns in episodes)])
    for key in list(episodes[0]):  # a column at a time, its parts let go when joined
        steps[key] = torch.from_numpy(np.concatenate([columns.pop(key) for columns in episodes]))
    steps["next", "done"] = steps["next", "terminated"] | steps["next", "truncated"]
    name = f"Minari data set {dataset_id!r}"
    check_content(steps, dataset.total_episodes, dataset.total_steps, name)
    check_infos(steps, name)
    return steps


def _import_minari():
    try:
        import minari
    except ImportError as error:
        raise ImportError(
            f"Minari data sets need the package minari ({error}); "
            'install it with pip install "torchrl_rad[offline]".'
        ) from error
    return minari


def _open(dataset_id: str, download: bool):
    """The Minari data set, from here or, if asked for, from its server."""
    minari = _import_minari()
    try:
        return minari.load_dataset(dataset_id)
    except FileNotFoundError as error:
        absent = error
    except ValueError as error:
        raise ValueError(
            f"Minari data set {dataset_id!r} is here but cannot be read ({error}). "
            "If a download was interrupted, delete its folder and load it with download=True."
        ) from error
    here = sorted(minari.list_local_datasets()) or "none"
    message = f"Minari data set {dataset_id!r} is not here (local data sets: {here})"
    if not download:
        raise FileNotFoundError(
            f"{message} and downloading is off. Pass a local id, set MINARI_DATASETS_PATH to the "
            "folder of the data sets, or pass download=True, which needs a network."
        ) from absent
    try:
        return minari.load_dataset(dataset_id, download=True)
    except Exception as error:  # of the network library, the server or the disk: it did not come
        raise FileNotFoundError(
            f"{message} and downloading it failed ({type(error).__name__}: {error}). Check the id "
            "and the network, or copy the set into the folder that MINARI_DATASETS_PATH names."
        ) from error


def _episodes(dataset, dataset_id: str) -> Iterator:
    try:
        yield from dataset.iterate_episodes()
    except (KeyError, OSError, ValueError) as error:  # of Minari's reader; ours do not pass here
        raise ValueError(
            f"Minari cannot read an episode of {dataset_id!r} ({type(error).__name__}: {error}). "
            "The file is damaged: fetch it anew; or, in Arrow, an entry of infos is a 1-d array, "
            "which Minari writes but cannot read: record it as a list."
        ) from error


def _columns(episode, adapter, reward, infos: Sequence[str], dataset_id: str) -> dict:
    """One episode's entries as arrays [L, ...]; Minari keeps L + 1 observations."""
    states = _states(episode, adapter, dataset_id)
    if isinstance(episode.actions, (dict, tuple, list)):
        raise TypeError(
            f"Minari data set {dataset_id!r}: actions are a {type(episode.actions).__name__}, "
            "expected one array; flatten the action space when recording."
        )
    length = len(episode.rewards)
    if len(states) != length + 1 or len(episode.actions) != length:
        raise ValueError(
            f"Minari data set {dataset_id!r}, episode {episode.id}: {length} rewards with "
            f"{len(states)} observations and {len(episode.actions)} actions; "
            f"expected {length + 1} and {length}. Record the episode anew."
        )
    rewards = episode.rewards if reward is None else reward(episode.observations)
    if len(rewards) != length:
        raise ValueError(
            f"Minari data set {dataset_id!r}, episode {episode.id}: {reward} gave {len(rewards)} "
            f"rewards for {length + 1} observations; expected {length}, one a step."
        )
    columns: dict[Any, np.ndarray] = {
        "observation": states[:-1],
        "action": np.asarray(episode.actions, np.float32).reshape(length, -1),
        "episode": np.full(length, episode.id, np.int64),
        ("next", "observation"): states[1:],
        ("next", "reward"): np.asarray(rewards, np.float32).reshape(length, 1),
        ("next", "terminated"): np.asarray(episode.terminations, bool).reshape(length, 1),
        ("next", "truncated"): np.asarray(episode.truncations, bool).reshape(length, 1),
    }
    for info in infos:
        columns["info", info] = _info(episode, info, length, dataset_id)
    return columns


def _info(episode, info: str, length: int, dataset_id: str) -> np.ndarray:
    """An entry of the infos at the rows' own states: float32 [L, .]."""
    where = f"Minari data set {dataset_id!r}, episode {episode.id}"
    if info not in (episode.infos or {}):
        raise KeyError(
            f"{where}: infos lack {info!r}; there are {sorted(episode.infos or {})}. Name one of "
            "these, or load the set without."
        )
    try:
        values = np.asarray(episode.infos[info], np.float32)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{where}: {info!r} of the infos is no array of numbers ({error}); name another entry."
        ) from error
    if values.ndim == 0 or len(values) != length + 1:
        raise ValueError(
            f"{where}: {info!r} of the infos has shape {list(values.shape)}, expected {length + 1} "
            "rows, one a state. Load the set without it."
        )
    return values[:-1].reshape(length, -1)


def _states(episode, adapter, dataset_id: str) -> np.ndarray:
    try:
        states = np.asarray(adapter(episode.observations), dtype=np.float32)
    except KeyError as error:
        raise KeyError(f"Minari data set {dataset_id!r}: {error.args[0]}") from error
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"Minari data set {dataset_id!r}: {adapter} cannot make one vector of the observations "
            f"({error}). Name entries that are arrays, or pass an adapter of your own."
        ) from error
    return states.reshape(len(states), -1)


def check_content(
    td: TensorDictBase, episodes: int, steps: int, name: str = "the data set"
) -> None:
    """Makes sure that a data set came whole: its size, finite numbers, and not all of them 0.

    A loader that fails silently gives zeros or a part of the data, and training on it runs without
    a complaint.

    Args:
        td (TensorDict): [T]: ``observation``, ``action``, ``episode`` [T], ``("next",
            "observation")``, ``("next", "reward")``.
        episodes (int): number of episodes expected.
        steps (int): number of steps expected.
        name (str, optional): what to call the data in messages.

    Raises:
        ValueError: there are more or fewer episodes or steps; NaN or Inf, named by entry, episode
            and step; or observations or actions are all 0. Rewards may be: the data may not have
            been labelled yet.

    Examples:
        >>> zeros = TensorDict({
        ...     "observation": torch.zeros(2, 1), "action": torch.ones(2, 1),
        ...     "episode": torch.zeros(2, dtype=torch.int64),
        ...     "next": {"observation": torch.ones(2, 1), "reward": torch.ones(2, 1)}}, [2])
        >>> check_content(zeros, episodes=1, steps=2, name="mine")
        Traceback (most recent call last):
        ...
        ValueError: mine: 'observation' is 0 in all 2 rows; the data was not read. Load it anew.
    """
    came = (len(torch.unique_consecutive(td["episode"])), len(td))
    if came != (episodes, steps):
        raise ValueError(
            f"{name}: {came[0]} episodes with {came[1]} steps came, expected {episodes} with "
            f"{steps}. The set is incomplete or damaged: delete its folder and fetch it anew. "
            "(Of Arrow episodes past 32,767 steps Minari reads a part only: store them as HDF5.)"
        )
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        bad = ~td[key].isfinite().all(-1)
        if bad.any():
            raise ValueError(
                f"{name}: NaN or Inf in {key!r} at {describe_rows(td['episode'], bad)}. "
                "Drop these episodes or mend them."
            )
        if key != ("next", "reward") and not td[key].any():
            raise ValueError(
                f"{name}: {key!r} is 0 in all {len(td)} rows; the data was not read. Load it anew."
            )


def check_infos(steps: TensorDictBase, name: str) -> None:
    """Checks what was kept of the infos for NaN and Inf.

    Raises:
        ValueError: names entry, episode and step.
    """
    for key in steps.keys(True, True):
        bad = ~steps[key].isfinite().all(-1) if key[0] == "info" else torch.zeros(0)
        if bad.any():
            raise ValueError(
                f"{name}: NaN or Inf in {key!r} at {describe_rows(steps['episode'], bad)}. "
                "Drop these episodes, or load the set without this entry."
            )


def join_stream(td: TensorDictBase, max_steps: int, atol: float = 1e-6) -> TensorDictBase:
    """Joins episodes that are one physical stream, and cuts it anew by number of steps.

    D4RL's PointMaze sets in Minari begin a new episode whenever a goal is reached, although the
    ball moves on. An episode is joined to the one before it if its first observation is that one's
    last ``("next", "observation")``. Rewards stay as they are, those of the goals of the recording:
    label the data for the goal of the evaluation afterwards. Observations that hold the goal never
    join, since it changes.

    Args:
        td (TensorDict): [T], whole episodes in recorded order: ``observation`` [T, S], ``episode``
            [T] int64, ``("next", "observation")`` [T, S], ``("next", "terminated")`` [T, 1] bool;
            anything else is passed on.
        max_steps (int): rows of an episode; the last one of a stream may be shorter.
        atol (float, optional): largest difference of any feature that counts as equal. Defaults to
            ``1e-6``.

    Returns:
        A new TensorDict [T] with the same entries; set anew are ``episode`` (0, 1, ...), ``("next",
        "truncated")`` and ``("next", "done")`` (True in the last row of each episode), ``("next",
        "terminated")`` (kept in the last row of a stream, False everywhere else).

    Raises:
        ValueError: ``max_steps`` is below 1, or the rows of an episode do not lie together.

    Examples:
        >>> flag = torch.tensor([[False], [True], [False], [True], [True]])
        >>> steps = TensorDict({
        ...     "observation": torch.tensor([[0.0], [1.0], [2.0], [3.0], [9.0]]),
        ...     "episode": torch.tensor([4, 4, 5, 5, 6]),
        ...     "next": {"observation": torch.tensor([[1.0], [2.0], [3.0], [4.0], [9.5]]),
        ...              "terminated": flag & False, "truncated": flag, "done": flag}}, [5])
        >>> joined = join_stream(steps, max_steps=3)
        >>> joined["episode"].tolist(), joined["next", "done"].squeeze(-1).tolist()
        ([0, 0, 0, 1, 2], [False, False, True, True, True])
    """
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}; an episode has at least 1 row.")
    out = td.clone(recurse=False)
    if len(td) == 0:
        return out
    lengths = episode_lengths(td)
    last = lengths.cumsum(0) - 1
    first = last + 1 - lengths
    gap = (td["observation"][first[1:]] - td["next", "observation"][last[:-1]]).abs()
    joined = (gap <= atol).flatten(1).all(-1)  # NaN joins nothing
    begins = torch.cat([torch.ones(1, dtype=torch.bool), ~joined])
    stream_lengths = torch.diff(first[begins], append=torch.tensor([len(td)]))
    step, remaining = step_and_remaining(stream_lengths)
    stream_end = remaining == 0
    end = (stream_end | ((step + 1) % max_steps == 0)).unsqueeze(-1)
    out["episode"] = (step % max_steps == 0).cumsum(0) - 1
    out["next", "terminated"] = td["next", "terminated"] & stream_end.unsqueeze(-1)
    out["next", "truncated"] = end
    out["next", "done"] = end.clone()
    return out
