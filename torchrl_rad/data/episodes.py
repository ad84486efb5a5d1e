"""Episodes in a flat table of steps: where they begin, what is left, what they pay."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["episode_lengths", "return_to_go", "step_and_remaining"]


def episode_lengths(steps: TensorDictBase) -> Tensor:
    """Lengths of the episodes of a flat table, in the order in which they lie there.

    Episodes are told apart by ``"episode"`` (int64 [T]) where there is one, by ``("next", "done")`` (bool [T, 1])
    otherwise.

    Returns:
        int64 [E], whose sum is T.

    Raises:
        KeyError: neither entry is there.
        ValueError: an id comes back after another one, or the last episode has no end.

    Examples:
        >>> from tensordict import TensorDict
        >>> episode_lengths(TensorDict({"episode": torch.tensor([4, 4, 7])}, [3])).tolist()
        [2, 1]
    """
    count = steps.batch_size[0]
    if count == 0:
        return torch.zeros(0, dtype=torch.int64)
    ids = steps.get("episode", None)
    if ids is not None:
        ids, lengths = torch.unique_consecutive(ids.reshape(count).cpu(), return_counts=True)
        if len(torch.unique(ids)) != len(ids):
            values, times = torch.unique(ids, return_counts=True)
            raise ValueError(
                f"the rows of episode {values[times > 1][0].item()} do not lie together; "
                "sort the steps by episode, in recorded order."
            )
        return lengths
    done = steps.get(("next", "done"), None)
    if done is None:
        raise KeyError('steps need "episode" [T] or ("next", "done") [T, 1] to tell episodes apart.')
    ends = done.reshape(count).cpu().nonzero().squeeze(-1)
    if len(ends) == 0 or ends[-1] != count - 1:
        begun = 0 if len(ends) == 0 else ends[-1].item() + 1
        raise ValueError(
            f"the episode that begins at row {begun} has no end: ('next', 'done') is False at the last row, "
            f"{count - 1}; pass whole episodes."
        )
    return torch.diff(ends, prepend=ends.new_tensor([-1]))


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
