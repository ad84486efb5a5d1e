"""Episodes in a flat table of steps: where they begin, what is left, what they pay."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

__all__ = [
    "episode_ids",
    "episode_lengths",
    "return_to_go",
    "step_and_remaining",
    "with_reward",
]


def episode_lengths(steps: TensorDictBase) -> Tensor:
    """Lengths of the episodes of a flat table, in the order in which they lie there.

    Episodes are told apart by the first of these that there is: ``"episode"`` (int64 [T]), the
    ``("collector", "traj_ids")`` of TorchRL's collectors, ``("next", "done")`` (bool [T, 1]).

    Returns:
        int64 [E], whose sum is T.

    Raises:
        KeyError: none of the entries is there.
        ValueError: an id comes back after another one, or an episode that was not given by
            ``"episode"`` has no end.

    Examples:
        >>> from tensordict import TensorDict
        >>> episode_lengths(TensorDict({"episode": torch.tensor([4, 4, 7])}, [3])).tolist()
        [2, 1]
    """
    count = steps.batch_size[0]
    if count == 0:
        return torch.zeros(0, dtype=torch.int64)
    ids, done = _given_ids(steps), steps.get(("next", "done"), None)
    if ids is not None:
        lengths = _runs(ids)
        if "episode" in steps.keys() or done is None:
            return lengths
        ends = lengths.cumsum(0) - 1
    elif done is not None:
        ends = done.reshape(count).cpu().nonzero().squeeze(-1)
        ends = torch.cat([ends[ends < count - 1], ends.new_tensor([count - 1])])
        lengths = torch.diff(ends, prepend=ends.new_tensor([-1]))
    else:
        raise KeyError(
            'steps need "episode" [T] or ("next", "done") [T, 1] to tell episodes apart.'
        )
    cut = ~done.reshape(count).cpu()[ends]
    if cut.any():
        last = int(ends[cut][0])
        raise ValueError(
            f"the episode that begins at row {last + 1 - int(lengths[cut][0])} has no end: "
            f"('next', 'done') is False at its last row, {last}; pass whole episodes (a collector "
            "gives them with trajs_per_batch=n, traj_format='cat')."
        )
    return lengths


def episode_ids(steps: TensorDictBase, lengths: Tensor) -> Tensor:
    """The ids given with the steps, or the numbers of the episodes: int64 [T] on the CPU.

    Examples:
        >>> from tensordict import TensorDict
        >>> episode_ids(TensorDict({}, [3]), torch.tensor([2, 1]))
        tensor([0, 0, 1])
    """
    ids = _given_ids(steps)
    return torch.repeat_interleave(torch.arange(len(lengths)), lengths) if ids is None else ids


def _given_ids(steps: TensorDictBase) -> Tensor | None:
    for key in ("episode", ("collector", "traj_ids")):
        ids = steps.get(key, None)
        if ids is None:
            continue
        if ids.numel() != len(steps) or ids.is_floating_point():
            raise ValueError(
                f"{key!r} must be one whole number a step, [T]; got {ids.dtype} {list(ids.shape)}."
            )
        return ids.reshape(-1).cpu().long()
    return None


def _runs(ids: Tensor) -> Tensor:
    ids, lengths = torch.unique_consecutive(ids, return_counts=True)
    values, times = torch.unique(ids, return_counts=True)
    if len(values) != len(ids):
        raise ValueError(
            f"the rows of episode {values[times > 1][0].item()} do not lie together; "
            "sort the steps by episode, in recorded order."
        )
    return lengths


def step_and_remaining(lengths: Tensor) -> tuple[Tensor, Tensor]:
    """For each row its step in the episode and the number of steps to the episode's last row.

    Args:
        lengths (Tensor): int64 [E].

    Returns:
        Two int64 [T].

    Examples:
        >>> step_and_remaining(torch.tensor([2, 3]))
        (tensor([0, 1, 0, 1, 2]), tensor([1, 0, 2, 1, 0]))
    """
    first = torch.repeat_interleave(lengths.cumsum(0) - lengths, lengths)
    step = torch.arange(len(first)) - first
    return step, torch.repeat_interleave(lengths, lengths) - 1 - step


def return_to_go(reward: Tensor, lengths: Tensor, gamma: float) -> Tensor:
    r"""Discounted return from each row to the end of its episode (RAD, Preliminary).

    .. math:: v_i = \sum_{t \ge i} \gamma^{t-i} r_t

    Summed in float64, from the last step backwards, all episodes at once.

    Args:
        reward (Tensor): [T] or [T, 1].
        lengths (Tensor): int64 [E], lengths of the episodes.
        gamma (float): discount in [0, 1].

    Returns:
        float32 [T].

    Raises:
        ValueError: ``gamma`` lies outside [0, 1].

    Examples:
        >>> return_to_go(torch.tensor([1.0, 2.0, 4.0]), torch.tensor([2, 1]), 0.5).tolist()
        [2.0, 2.0, 4.0]
    """
    if not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma is {gamma}; a discount lies in [0, 1].")
    reward = reward.reshape(-1).cpu().double()
    if len(reward) == 0:
        return reward.float()
    step, _ = step_and_remaining(lengths)
    longest = int(lengths.max())
    padded = reward.new_zeros(longest, len(lengths))
    column = torch.repeat_interleave(torch.arange(len(lengths)), lengths)
    padded[step, column] = reward  # [longest, E]
    value = reward.new_zeros(len(lengths))
    out = torch.empty_like(padded)
    for t in range(longest - 1, -1, -1):  # one step of the longest episode, not one row
        value = padded[t] + gamma * value
        out[t] = value
    return out[step, column].float()


def with_reward(steps: TensorDictBase, reward: Tensor) -> TensorDictBase:
    """A shallow copy of steps [...] with other rewards [...], stored as [..., 1].

    Examples:
        >>> from tensordict import TensorDict
        >>> steps = TensorDict({"next": {"reward": torch.zeros(2, 1)}}, [2])
        >>> with_reward(steps, torch.ones(2))["next", "reward"].tolist()
        [[1.0], [1.0]]
    """
    out = steps.copy()
    columns = {**dict(steps["next"].items()), "reward": reward[..., None]}
    out["next"] = TensorDict(columns, steps.batch_size)
    return out
