"""Data that leave out a part of the space."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.data.episodes import episode_lengths

__all__ = ["enters_region", "without_region"]


def enters_region(data: TensorDictBase, centres: Tensor, half_width: float) -> Tensor:
    """Which episodes have a state in one of some squares: bool [E].

    Args:
        data (TensorDictBase): flat steps [T] with ``episode`` and ``observation``, whose first two
            entries are x, y.
        centres (Tensor): [n, 2], of the squares.
        half_width (float): half of their side.

    Examples:
        >>> from tensordict import TensorDict
        >>> state = torch.tensor([[0.0, 0.0], [1.0, 0.0], [5.0, 0.0]])
        >>> steps = TensorDict({"observation": state, "episode": torch.tensor([0, 0, 1])}, [3])
        >>> enters_region(steps, torch.tensor([[1.2, 0.1]]), 0.5)
        tensor([ True, False])
    """
    inside = torch.zeros(len(data), dtype=torch.bool, device=data["observation"].device)
    for centre in centres.to(data["observation"]):  # of a few cells; the rows are many
        inside |= ((data["observation"][:, :2] - centre).abs() <= half_width).all(-1)
    lengths = episode_lengths(data).to(inside.device)
    episode = torch.repeat_interleave(torch.arange(len(lengths), device=inside.device), lengths)
    return torch.zeros_like(lengths, dtype=torch.bool).index_put_(
        (episode[inside],), inside.new_ones(())
    )


def without_region(
    data: TensorDictBase, centres: Tensor, half_width: float, coverage: float = 0.0, seed: int = 0
) -> TensorDictBase:
    """Recorded steps without the episodes that enter a region, or with a share of them.

    It is the region-restricted setting of RAD, section "Generalization".

    Args:
        data, centres, half_width: as of :func:`enters_region`.
        coverage (float, optional): share of those episodes that stays. Defaults to ``0.0``.
        seed (int, optional): of which stay. Defaults to ``0``.

    Raises:
        ValueError: ``coverage`` lies outside [0, 1], or no episode is left.
    """
    if not 0.0 <= coverage <= 1.0:
        raise ValueError(f"coverage is {coverage}; expected a share in [0, 1].")
    gone = enters_region(data, centres, half_width)
    entering = gone.nonzero()[:, 0]
    order = torch.randperm(len(entering), generator=torch.Generator().manual_seed(seed))
    gone[entering[order[: round(coverage * len(entering))].to(entering.device)]] = False
    if gone.all():
        raise ValueError(f"all {len(gone)} episodes enter the region, and none is left.")
    return data[torch.repeat_interleave(~gone, episode_lengths(data).to(gone.device))]
