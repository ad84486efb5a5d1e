"""Targets that are kept for several policy steps: what is kept lies in the tensordict."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data.tensor_specs import Unbounded
from torchrl.envs.transforms import TensorDictPrimer

__all__ = ["KEPT", "keep_or_renew", "kept_primer"]

KEPT = ("retrieval", "kept")  # float64 [*B, 5]: row, similarity, offset, age, version


def kept_primer() -> TensorDictPrimer:
    """The environment transform that carries what is kept from step to step."""
    spec = Unbounded((5,), dtype=torch.float64)
    return TensorDictPrimer({KEPT: spec}, default_value=0.0, expand_specs=True)


def keep_or_renew(
    tensordict: TensorDictBase,
    lasting: Tensor,
    interval: int,
    rows: int,
    version: int,
    select: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
) -> tuple[Tensor, Tensor, Tensor]:
    """What was chosen up to ``interval`` steps ago, or what ``select`` chooses now.

    Args:
        tensordict (TensorDictBase): with ``is_init`` and KEPT; the next KEPT is written into it.
        lasting (Tensor): bool [Q], states that can keep a target.
        interval (int): policy steps.
        rows, version (int): of the database.
        select (callable): bool [Q], which to choose for -> row, similarity and offset of those.

    Returns:
        Row, similarity and offset, each [Q].

    Raises:
        KeyError: an entry is missing.
    """
    kept, start = tensordict.get(KEPT), tensordict.get("is_init")
    if kept is None or start is None:
        raise KeyError(
            f"retrieval_interval={interval} needs 'is_init' and {KEPT} in the tensordict; add "
            "InitTracker() and make_tensordict_primer() to the environment."
        )
    index, _, _, age, of_version = kept.reshape(-1, 5).unbind(-1)
    fresh = start.reshape(-1) | (age >= interval) | (age == 0)
    # nothing to keep: no target yet, a row that is gone or moved, a state that is none
    fresh |= (of_version != version) | (index < 0) | (index >= rows) | ~lasting
    # a kept target comes one recorded step nearer with each step
    state = kept.reshape(-1, 5) + kept.new_tensor([0.0, 0.0, -1.0, 1.0, 0.0])
    state[:, 2].clamp_min_(0.0)
    if fresh.any():
        renewed = torch.stack([value.double() for value in select(fresh)], -1)
        age_and_version = renewed.new_tensor([1.0, version]).expand(len(renewed), 2)
        state[fresh] = torch.cat([renewed, age_and_version], -1)
    tensordict.set(("next", *KEPT), state.reshape(kept.shape))
    return state[:, 0].long(), state[:, 1].float(), state[:, 2].long()
