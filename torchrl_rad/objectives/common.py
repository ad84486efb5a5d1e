"""What the losses on windows share."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

__all__ = ["window_masks"]


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
