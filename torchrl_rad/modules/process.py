"""Generative processes: how data becomes noise, and the way back."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

__all__ = ["Diffusion", "Process", "RectifiedFlow", "make_process"]


class Process(Protocol):
    """What a planner and its loss need of a process; time runs from 0 (data) to 1 (noise)."""

    def corrupt(self, clean: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """The noisy sample at ``time``, which broadcasts against ``clean``."""

    def target(self, clean: Tensor, noise: Tensor) -> Tensor:
        """What the network is to predict."""

    def grid(self, steps: int) -> list[float]:
        """The ``steps + 1`` times of a sampler, from 1 to 0."""

    def step(self, sample: Tensor, prediction: Tensor, time: float, following: float) -> Tensor:
        """From the sample at ``time`` to that at ``following``, given the network's prediction."""


class RectifiedFlow:
    """Straight lines from data to noise (Liu et al., 2023).

    The network predicts the velocity towards the data. The sampler is Euler's, on DiffuserLite's
    grid (i / n)^1.5, which is finer near the data.

    Examples:
        >>> flow = RectifiedFlow()
        >>> [round(time, 4) for time in flow.grid(2)]
        [1.0, 0.3536, 0.0]
        >>> clean, noise = torch.tensor([2.0]), torch.tensor([-1.0])
        >>> flow.step(noise, flow.target(clean, noise), 1.0, 0.0)
        tensor([2.])
    """

    def corrupt(self, clean: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        return clean + time * (noise - clean)

    def target(self, clean: Tensor, noise: Tensor) -> Tensor:
        return clean - noise

    def grid(self, steps: int) -> list[float]:
        return [(i / steps) ** 1.5 for i in range(steps, -1, -1)]

    def step(self, sample: Tensor, prediction: Tensor, time: float, following: float) -> Tensor:
        return torch.add(sample, prediction, alpha=time - following)


class Diffusion:
    """Variance-preserving diffusion on the cosine schedule in continuous time.

    The network predicts the clean data. The sampler is DDIM's (Song et al., 2021), without noise
    between steps; the last step returns the prediction itself.

    Examples:
        >>> diffusion = Diffusion()
        >>> clean, noise = torch.tensor([2.0]), torch.tensor([-1.0])
        >>> sample = diffusion.corrupt(clean, noise, torch.tensor([0.5]))
        >>> diffusion.step(sample, clean, 0.5, 0.0)
        tensor([2.])
    """

    SHIFT = 0.008
    LAST = 0.9946  # beyond, alpha is too close to zero to divide by

    def alpha_sigma(self, time: Tensor | float) -> tuple[Tensor, Tensor]:
        """Scale of the data and of the noise at a time."""
        time = torch.as_tensor(time, dtype=torch.float32).clamp(0.0, self.LAST)
        alpha = torch.cos(math.pi / 2 * (time + self.SHIFT) / (1 + self.SHIFT))
        alpha = alpha / math.cos(math.pi / 2 * self.SHIFT / (1 + self.SHIFT))
        return alpha, (1 - alpha.square()).clamp_min(0.0).sqrt()

    def _numbers(self, time: float) -> tuple[float, float]:
        """:meth:`alpha_sigma` without tensors, of which a step would wait for a dozen."""
        angles = (
            math.pi / 2 * (t + self.SHIFT) / (1 + self.SHIFT) for t in (min(time, self.LAST), 0.0)
        )
        alpha = math.cos(next(angles)) / math.cos(next(angles))
        return alpha, math.sqrt(max(0.0, 1 - alpha * alpha))

    def corrupt(self, clean: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        alpha, sigma = self.alpha_sigma(time)
        return alpha * clean + sigma * noise

    def target(self, clean: Tensor, noise: Tensor) -> Tensor:
        return clean

    def grid(self, steps: int) -> list[float]:
        return [i / steps for i in range(steps, -1, -1)]

    def step(self, sample: Tensor, prediction: Tensor, time: float, following: float) -> Tensor:
        if following == 0.0:
            return prediction
        (alpha, sigma), (alpha_next, sigma_next) = self._numbers(time), self._numbers(following)
        ratio = sigma_next / sigma
        return torch.add(ratio * sample, prediction, alpha=alpha_next - ratio * alpha)


def make_process(name: str) -> Process:
    """``"flow"`` or ``"diffusion"`` by name.

    Raises:
        ValueError: another name.
    """
    processes: dict[str, type[Process]] = {"flow": RectifiedFlow, "diffusion": Diffusion}
    if name not in processes:
        raise ValueError(f"process is {name!r}; expected one of {sorted(processes)}.")
    return processes[name]()
