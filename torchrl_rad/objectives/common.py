"""What the losses on windows share."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_rad.modules.normalizer import Normalizer

__all__ = ["KeyedLoss", "check_share", "check_step", "read_windows", "window_masks"]


class KeyedLoss(LossModule):
    """A loss that reads its accepted keys, all of them and in the order in which they are declared.

    Examples:
        >>> from torchrl_rad import Normalizer, StepEstimationLoss, StepEstimator
        >>> loss = StepEstimationLoss(StepEstimator(Normalizer.identity(2), horizon=9))
        >>> loss.set_keys(target=("next", "target"))
        >>> loss.in_keys
        ['observation', ('next', 'target'), 'target_step']
    """

    _unread: tuple[str, ...] = ()  # accepted keys that this loss does not read

    def __init__(self) -> None:
        super().__init__()
        self._in_keys: list[NestedKey] | None = None

    @property
    def in_keys(self) -> list[NestedKey]:
        if self._in_keys is None:
            keys: Any = self.tensor_keys
            names = [field.name for field in fields(keys) if field.name not in self._unread]
            self._in_keys = [getattr(keys, name) for name in names]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        self._in_keys = value

    def set_keys(self, **kwargs: NestedKey) -> None:
        super().set_keys(**kwargs)
        self._in_keys = None  # else they would be the old ones


def window_masks(
    masks: tuple, tensordict: TensorDictBase, shape: torch.Size
) -> tuple[TensorDict, Tensor | None]:
    """Masks of steps as masks of windows: a window counts if all its steps do.

    Args:
        masks (tuple of NestedKey): entries that may hold a mask, [*B], [*B, H] or [*B, H, 1].
        tensordict (TensorDictBase): the loss's input.
        shape (torch.Size): [*B].

    Returns:
        A TensorDict with those masks as bool [*B], for ``LossModule._reduce_loss``, and all of them
        in one, or None.
    """
    found: dict[Any, Tensor] = {}
    for key in masks:
        mask = tensordict.get(key, None)
        if mask is not None:
            found[key] = mask.reshape(*shape, -1).all(-1)
    together = torch.stack(list(found.values())).all(0) if found else None
    return TensorDict(found, shape), together


def read_windows(
    normalizer: Normalizer, tensordict: TensorDictBase, key: NestedKey, horizon: int
) -> Tensor:
    """Windows of states [*B, H, S] in raw units.

    Raises:
        KeyError: there is no such entry.
        ValueError: the windows have another length or width.
    """
    windows = normalizer.read(tensordict, key)
    if windows.ndim < 2 or windows.shape[-2] != horizon:
        raise ValueError(
            f"{key!r} is {tuple(windows.shape)}; expected windows [*B, {horizon}, S], the horizon "
            "that the planner was built for."
        )
    return windows


def check_share(no_target: float) -> None:
    """Raises ValueError for a share outside [0, 1]."""
    if not 0.0 <= no_target <= 1.0:
        raise ValueError(f"no_target is {no_target}; expected a share in [0, 1].")


def check_step(pseudo_step: int | None, horizon: int) -> None:
    """Raises ValueError for a step outside a plan."""
    if pseudo_step is not None and not 1 <= pseudo_step < horizon:
        raise ValueError(f"pseudo_step is {pseudo_step}; expected 1 to {horizon - 1}, or None.")
