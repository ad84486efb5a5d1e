"""Generative processes: how data becomes noise, and the way back."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

__all__ = ["AncestralDiffusion", "Diffusion", "Process", "RectifiedFlow", "make_process"]


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

    def deviation(self, time: float, following: float) -> float:
        """Of the fresh noise that is added after a step; 0 for none."""


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

    def deviation(self, time: float, following: float) -> float:
        return 0.0


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

    def deviation(self, time: float, following: float) -> float:
        return 0.0

    def variance(self, time: float, following: float) -> float:
        r"""Of the sample at ``following``, given that at ``time`` and the data.

        .. math:: \tilde\beta = \frac{\sigma_s^2}{\sigma_t^2}
            \left(1 - \frac{\alpha_t^2}{\alpha_s^2}\right)

        It also scales the gradient of a return model (Janner et al., 2022).
        """
        (alpha, sigma), (alpha_next, sigma_next) = self._numbers(time), self._numbers(following)
        return (sigma_next / sigma) ** 2 * (1 - (alpha / alpha_next) ** 2)


class AncestralDiffusion(Diffusion):
    r"""The same diffusion, sampled as DDPM does (Ho et al., 2020): fresh noise after each step.

    A step leads to the mean of the posterior (equation "sample2" of RAD, whose printed fraction is
    corrected here), and noise of the variance :math:`\tilde\beta` is added; none after the last
    step, which returns the prediction itself:

    .. math:: \mu = \frac{\alpha_s \beta}{\sigma_t^2} \hat\tau^0
        + \frac{\alpha_t \sigma_s^2}{\alpha_s \sigma_t^2} \hat\tau^t,
        \quad \beta = 1 - \frac{\alpha_t^2}{\alpha_s^2}

    from time t to time s. In K steps these are DDPM's K noise levels; a network that was trained at
    all times can be sampled with any K.

    Examples:
        >>> process, clean = AncestralDiffusion(), torch.tensor([2.0])
        >>> alpha, following = process.alpha_sigma(0.8)[0], process.alpha_sigma(0.6)[0]
        >>> mean = process.step(alpha * clean, clean, 0.8, 0.6)
        >>> torch.allclose(mean, following * clean)
        True
    """

    def step(self, sample: Tensor, prediction: Tensor, time: float, following: float) -> Tensor:
        if following == 0.0:
            return prediction
        (alpha, sigma), (alpha_next, sigma_next) = self._numbers(time), self._numbers(following)
        kept = alpha / alpha_next
        of_data = alpha_next * (1 - kept**2) / sigma**2
        return torch.add(kept * (sigma_next / sigma) ** 2 * sample, prediction, alpha=of_data)

    def deviation(self, time: float, following: float) -> float:
        return math.sqrt(self.variance(time, following))


def make_process(name: str) -> Process:
    """A process by name: ``"flow"``, ``"diffusion"`` (sampled by DDIM) or ``"ancestral"`` (DDPM).

    Raises:
        ValueError: another name.
    """
    processes: dict[str, type[Process]] = {
        "ancestral": AncestralDiffusion,
        "diffusion": Diffusion,
        "flow": RectifiedFlow,
    }
    if name not in processes:
        raise ValueError(f"process is {name!r}; expected one of {sorted(processes)}.")
    return processes[name]()
