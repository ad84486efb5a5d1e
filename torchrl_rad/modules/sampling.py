"""The sampling loop of every planner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_rad.modules.process import Process

__all__ = ["Guidance", "inpaint", "sample_plan"]


class Guidance(NamedTuple):
    """How samples are led to a larger value before each call of the network.

    Attributes:
        gradient: (sample [B, L, D], number of the step) -> gradient of the value [B, L, D].
        scales: factor of the gradient, one a step; where it is 0, none is taken.
        repeats: gradients a step.
    """

    gradient: Callable[[Tensor, int], Tensor]
    scales: Sequence[float]
    repeats: int


def inpaint(values: Tensor, known: Tensor, mask: Tensor) -> Tensor:
    """Overwrites the known entries: where ``mask`` [..., L, 1] or [..., L, D] is True."""
    return torch.where(mask, known, values)


def sample_plan(
    process: Process,
    network: Callable[[Tensor, int], Tensor],
    noise: Tensor,
    known: Tensor,
    mask: Tensor,
    steps: int,
    free: slice = slice(None),
    guidance: Guidance | None = None,
    fresh: Callable[[], Tensor] | None = None,
) -> Tensor:
    """Turns noise into plans that hold the known entries.

    The known entries are written before each call of the network and at the end (RAD, section
    "Planning Module"). Guidance moves the sample that the network then sees (Janner et al., 2022).

    Args:
        process (Process): the generative process.
        network (callable): (sample [B, L, D], number of the step) -> prediction [B, f, D]. What
            depends on the step alone, such as the code of ``process.grid(steps)[step]``, can be
            made beforehand, once for all calls.
        noise (Tensor): [B, L, D].
        known (Tensor): [B, L, D], read where ``mask`` is True.
        mask (Tensor): bool [B, L, 1] or [B, L, D].
        steps (int): calls of the network.
        free (slice, optional): f tokens next to each other that are to be predicted; the others are
            known. Defaults to all.
        guidance (Guidance, optional): towards plans of a larger value. Defaults to none.
        fresh (callable, optional): () -> noise [B, L, D] for a process that adds some after a step.
            Defaults to standard normal noise.

    Returns:
        Plans, [B, L, D].

    Raises:
        ValueError: fewer than one step.

    Examples:
        >>> from torchrl_rad.modules.process import RectifiedFlow
        >>> noise = torch.zeros(1, 3, 1)
        >>> known, mask = torch.ones(1, 3, 1), torch.tensor([True, False, False])[None, :, None]
        >>> network = lambda x, step: x + 2.0
        >>> sample_plan(RectifiedFlow(), network, noise, known, mask, steps=1).squeeze()
        tensor([1., 2., 2.])
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}; a plan needs at least one inference step.")
    sample = inpaint(noise, known, mask)
    begin, end, _ = free.indices(sample.shape[1])
    part_known, part_mask = known[:, begin:end], mask[:, begin:end]
    before, after = sample[:, :begin], sample[:, end:]
    for step, (time, following) in enumerate(pairwise(process.grid(steps))):
        if guidance is not None and guidance.scales[step]:
            for _ in range(guidance.repeats):
                shift = guidance.gradient(sample, step)
                shifted = torch.add(sample, shift, alpha=guidance.scales[step])
                sample = inpaint(shifted, known, mask)
        part = process.step(sample[:, begin:end], network(sample, step), time, following)
        deviation = process.deviation(time, following)
        if deviation:
            noise = torch.randn_like(sample) if fresh is None else fresh()
            part = torch.add(part, noise[:, begin:end], alpha=deviation)
        sample = torch.cat([before, inpaint(part, part_known, part_mask), after], 1)
    return sample
