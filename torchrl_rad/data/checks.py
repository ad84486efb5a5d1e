"""What a table of steps must be before an expert database takes it."""

from __future__ import annotations

from typing import Any

from tensordict import LazyStackedTensorDict, TensorDictBase
from torch import Tensor

__all__ = ["check_finite", "check_same_columns", "check_steps", "flat_steps"]


def flat_steps(tensordict: Any) -> TensorDictBase:
    """A shallow copy of a flat table of steps [T].

    Raises:
        TypeError: something else than a TensorDict came.
        ValueError: it has no step, or is not flat.

    Examples:
        >>> from tensordict import TensorDict
        >>> flat_steps(TensorDict({}, [2, 7]))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: expected flat steps, batch size [T]; got [2, 7]. Pass td.reshape(-1); ...
    """
    if not isinstance(tensordict, TensorDictBase):
        raise TypeError(
            f"expected a TensorDict of steps, got {type(tensordict).__name__}; join a list of "
            "episodes with torch.cat(episodes)."
        )
    if tensordict.ndim != 1:
        raise ValueError(
            f"expected flat steps, batch size [T]; got {list(tensordict.batch_size)}. "
            "Pass td.reshape(-1); a collector that fills the database itself needs "
            "trajs_per_batch=n, traj_format='cat'."
        )
    if len(tensordict) == 0:
        raise ValueError("expected whole episodes, got a table with no step.")
    if isinstance(tensordict, LazyStackedTensorDict):
        return tensordict.contiguous()
    return tensordict.copy()


def check_steps(steps: TensorDictBase, state_key: Any) -> None:
    """Checks that states and rewards are there and have a possible shape and dtype.

    Raises:
        KeyError: an entry is missing.
        ValueError: states are not floating point [T, S], or rewards not [T, 1].
    """
    count = len(steps)
    for key in (state_key, ("next", "reward")):
        if not isinstance(steps.get(key, None), Tensor):
            raise KeyError(f"steps need the entry {key!r}; got {names(steps)}.")
    states, reward = steps.get(state_key), steps.get(("next", "reward"))
    if not states.is_floating_point() or states.ndim != 2:
        raise ValueError(
            f"{state_key!r} must be floating point [T, S]; got {states.dtype} "
            f"{list(states.shape)}. Convert it, e.g. with float() or flatten(1)."
        )
    if reward.numel() != count:
        raise ValueError(
            f"('next', 'reward') must be one number a step, [T, 1]; got {list(reward.shape)}."
        )


def check_finite(steps: TensorDictBase, keys: tuple, episode: Tensor, step: Tensor) -> None:
    """Checks the entries named for NaN and Inf, where they are there.

    Args:
        steps (TensorDictBase): flat steps [T].
        keys (tuple of NestedKey): entries to check.
        episode (Tensor): int64 [T], for the message.
        step (Tensor): int64 [T], for the message.

    Raises:
        ValueError: names the first row that is not finite by episode and step.
    """
    for key in keys:
        value = steps.get(key, None)
        if value is None:
            continue
        bad = ~value.reshape(len(steps), -1).isfinite().all(-1)
        if bad.any():
            row = int(bad.nonzero()[0])
            raise ValueError(
                f"{key!r} has NaN or Inf in {int(bad.sum())} row(s), the first in episode "
                f"{int(episode[row])} at step {int(step[row])}; remove or repair these episodes."
            )


def check_same_columns(steps: TensorDictBase, stored: TensorDictBase) -> None:
    """Checks that steps have the entries, widths and dtypes of the rows that are stored already.

    Raises:
        KeyError: an entry is missing or new.
        ValueError: an entry has another width or dtype.
    """
    expected = {key: stored.get(key) for key in stored.keys(True, True) if key != "index"}
    given = {key: steps.get(key) for key in steps.keys(True, True) if key != "index"}
    missing, new = expected.keys() - given.keys(), given.keys() - expected.keys()
    if missing or new:
        raise KeyError(
            f"steps must have the entries of the rows in the database: {_sorted(missing)} missing, "
            f"{_sorted(new)} new. Add them, or leave them out with td.exclude(...)."
        )
    for key, value in expected.items():
        got = given[key]
        if isinstance(value, Tensor) and isinstance(got, Tensor):
            if got.shape[1:] != value.shape[1:] or got.dtype != value.dtype:
                raise ValueError(
                    f"{key!r} is {got.dtype} [T{_tail(got)}], but the database holds {value.dtype} "
                    f"[N{_tail(value)}]; convert it, or fill another database."
                )


def names(steps: TensorDictBase) -> list[str]:
    """All entries of a table, nested ones as ``a.b``, sorted."""
    return _sorted(steps.keys(True, True))


def _sorted(keys: Any) -> list[str]:
    return sorted(key if isinstance(key, str) else ".".join(key) for key in keys)


def _tail(value: Tensor) -> str:
    return "".join(f", {size}" for size in value.shape[1:])
