"""The sampling loop of every planner."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_rad.modules.process import Process

__all__ = ["inpaint", "sample_plan"]


def inpaint(values: Tensor, known: Tensor, mask: Tensor) -> Tensor:
    """Overwrites the known entries: where ``mask`` [..., L, 1] or [..., L, D] is True."""
    return torch.where(mask, known, values)


def sample_plan(
    process: Process,
    network: Callable[[Tensor, Tensor, Tensor], Tensor],
    noise: Tensor,
    known: Tensor,
    mask: Tensor,
    steps: int,
) -> Tensor:
    """Turns noise into plans that hold the known entries.

    The known entries are written before each call of the network and at the end (RAD, section
    "Planning Module").

    Args:
        process (Process): the generative process.
        network (callable): (sample [B, L, D], mask, time [1]) -> prediction [B, L, D].
        noise (Tensor): [B, L, D].
        known (Tensor): [B, L, D], read where ``mask`` is True.
        mask (Tensor): bool [B, L, 1] or [B, L, D].
        steps (int): calls of the network.

    Returns:
        Plans, [B, L, D].

    Raises:
        ValueError: fewer than one step.

    Examples:
        >>> from torchrl_rad.modules.process import RectifiedFlow
        >>> noise = torch.zeros(1, 3, 1)
        >>> known, mask = torch.ones(1, 3, 1), torch.tensor([True, False, False])[None, :, None]
        >>> network = lambda x, mask, time: x + 2.0
        >>> sample_plan(RectifiedFlow(), network, noise, known, mask, steps=1).squeeze()
        tensor([1., 2., 2.])
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}; a plan needs at least one inference step.")
    sample = inpaint(noise, known, mask)
    grid = process.grid(steps)
    for time, following in zip(grid[:-1], grid[1:], strict=True):
        prediction = network(sample, mask, torch.full((1,), time, device=sample.device))
        sample = inpaint(process.step(sample, prediction, time, following), known, mask)
    return sample
