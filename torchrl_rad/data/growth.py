"""What changes in a filled database: rewards, room for new episodes, episodes that come again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.data.checks import check_finite
from torchrl_rad.data.episodes import return_to_go

__all__ = ["EVICTIONS", "copies", "evicted", "kept_names", "new_reward", "stored_lengths"]

EVICTIONS = ("oldest", "lowest_return")


def stored_lengths(rows: TensorDictBase) -> Tensor:
    """Lengths of the episodes in a database's rows, int64 [E], in their order.

    Examples:
        >>> from tensordict import TensorDict
        >>> stored_lengths(TensorDict({"step": torch.tensor([0, 1, 0])}, [3]))
        tensor([2, 1])
    """
    starts = (rows["step"] == 0).nonzero()[:, 0].cpu()
    return torch.diff(starts, append=starts.new_tensor([len(rows)]))


def new_reward(
    rows: TensorDictBase, reward: Callable[[TensorDictBase], Tensor] | Tensor | Any, gamma: float
) -> tuple[Tensor, Tensor]:
    """Another reward for the rows of a database, like the present one, and its returns.

    Args:
        rows (TensorDictBase): [N].
        reward: [N] or [N, 1]; a function of the rows that gives it; or the name of such an entry.
        gamma (float): discount.

    Raises:
        KeyError: there is no entry of that name.
        TypeError: no numbers came.
        ValueError: another length; NaN or Inf, named by episode and step.
    """
    if isinstance(reward, (str, tuple)):
        found = rows.get(reward, None)
        if not isinstance(found, Tensor):
            names = sorted(map(str, rows.keys(True, True)))
            raise KeyError(f"{reward!r} is no entry of the database; it has {names}.")
        reward = found
    elif callable(reward):
        reward = reward(rows)
    if not isinstance(reward, Tensor):
        raise TypeError(
            f"a reward must be a tensor, a function of the rows or the name of an entry; got "
            f"{type(reward).__name__}."
        )
    present = rows["next", "reward"]
    if reward.shape not in (present.shape, present.shape[:1]):
        raise ValueError(
            f"the reward is {list(reward.shape)}; expected one a row, {list(present.shape)} or "
            f"{list(present.shape[:1])}."
        )
    reward = reward.detach().reshape(present.shape).to(present)
    steps = rows.select(("next", "reward")).set(("next", "reward"), reward)
    check_finite(steps, (("next", "reward"),), rows["episode"], rows["step"])
    value = return_to_go(reward, stored_lengths(rows), gamma).to(present.device)
    return reward, value


def kept_names(rows: TensorDictBase) -> list[str]:
    """Names under which rewards and returns of before are kept beside the present ones."""
    tables = [name for name, value in rows.items() if isinstance(value, TensorDictBase)]
    return [name for name in tables if "return_to_go" in rows[name].keys()]


def evicted(rows: TensorDictBase, needed: int, rule: str) -> Tensor:
    """Episodes to give up so that ``needed`` rows become free: bool [N], their rows.

    Args:
        rows (TensorDictBase): of the database, [N].
        needed (int): at most N.
        rule (str): ``"oldest"``, those added first; ``"lowest_return"``, those that pay least from
            their first step on, of equal ones the oldest.

    Examples:
        >>> from tensordict import TensorDict
        >>> rows = TensorDict({"step": torch.tensor([0, 1, 0, 0]),
        ...     "return_to_go": torch.tensor([2.0, 9.0, 1.0, 2.0])}, [4])
        >>> evicted(rows, 2, "lowest_return")
        tensor([ True,  True,  True, False])
    """
    lengths = stored_lengths(rows)
    order = torch.arange(len(lengths))
    if rule == "lowest_return":
        start = lengths.cumsum(0) - lengths
        order = rows["return_to_go"].cpu()[start].argsort(stable=True)
    freed = lengths[order].cumsum(0)
    count = int((freed < needed).sum()) + 1
    gone = torch.zeros(len(lengths), dtype=torch.bool)
    gone[order[:count]] = True
    return torch.repeat_interleave(gone, lengths)


def copies(rows: TensorDictBase, steps: TensorDictBase, key: Any) -> list[tuple[int, int]]:
    """Episodes among ``steps`` with the states of one among ``rows``, or of one before them.

    Both have the columns of a database.

    Returns:
        Ids: of the episode that came again, and of the one that it repeats.
    """
    known: dict[tuple, list[tuple[int, Tensor]]] = defaultdict(list)
    found = []
    for table, new in ((rows, False), (steps, True)):
        for ends, number, states in _episodes(table, key):
            same = next((other for other, its in known[ends] if torch.equal(its, states)), None)
            if new and same is not None:
                found.append((number, same))
            known[ends].append((number, states))
    return found


def _episodes(rows: TensorDictBase, key: Any) -> Iterator[tuple[tuple, int, Tensor]]:
    """Of each episode its length, first and last state; its id; its states."""
    lengths = stored_lengths(rows)
    start = lengths.cumsum(0) - lengths
    states = rows.get(key)
    ends = torch.cat([states[start], states[start + lengths - 1]], -1).tolist()
    ids = rows["episode"][start].tolist()
    for number, end, own in zip(ids, ends, states.split(lengths.tolist()), strict=True):
        yield (len(own), *end), number, own
