"""A U-Net over time (Janner et al., 2022): convolutions over the states and actions of a plan."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_rad.modules.dit import sinusoids

__all__ = ["Encoder", "TemporalUNet", "TimeCode", "check_length"]

GROUPS = 8  # of a normalisation


class ConvBlock(nn.Sequential):
    """Five steps wide convolution, normalisation over groups of channels, Mish."""

    def __init__(self, before: int, after: int):
        super().__init__(
            nn.Conv1d(before, after, 5, padding=2), nn.GroupNorm(GROUPS, after), nn.Mish()
        )


class ResidualBlock(nn.Module):
    """Two convolutions around a shortcut; the time code is added to each channel in between."""

    def __init__(self, before: int, after: int, width: int):
        super().__init__()
        self.first, self.second = ConvBlock(before, after), ConvBlock(after, after)
        self.time = nn.Linear(width, after)
        self.skip = nn.Conv1d(before, after, 1) if before != after else nn.Identity()

    def forward(self, x: Tensor, code: Tensor) -> Tensor:
        """[B, before, L] to [B, after, L]; ``code`` is [B or 1, W]."""
        h = self.first(x) + self.time(code)[..., None]
        return self.second(h) + self.skip(x)


class TimeCode(nn.Module):
    """Code [B, W] of times [B] of the process."""

    def __init__(self, width: int):
        super().__init__()
        self.width, self.first = width, nn.Linear(width, 4 * width)
        self.rest = nn.Sequential(nn.Mish(), nn.Linear(4 * width, width), nn.Mish())

    def forward(self, time: Tensor) -> Tensor:
        codes = sinusoids(1000.0 * time, self.width).to(self.first.weight.dtype)
        return self.rest(self.first(codes))


class Encoder(nn.Module):
    """The half that goes down: two blocks a resolution, then half as many steps.

    Args:
        entries (int): channels of the input.
        width (int): of the time code; channels are multiples of it.
        multiples (sequence of int): of each resolution.
    """

    def __init__(self, entries: int, width: int, multiples: Sequence[int]):
        super().__init__()
        if width < 4 or any((width * multiple) % GROUPS for multiple in multiples):
            raise ValueError(
                f"width is {width} and multiples are {list(multiples)}; expected an even width of "
                f"4 or more, and every product divisible by {GROUPS}, the groups of a "
                "normalisation."
            )
        channels = [width * multiple for multiple in multiples]
        before = [entries, *channels[:-1]]
        self.first = nn.ModuleList(
            ResidualBlock(a, b, width) for a, b in zip(before, channels, strict=True)
        )
        self.second = nn.ModuleList(ResidualBlock(c, c, width) for c in channels)
        self.down = nn.ModuleList(nn.Conv1d(c, c, 3, 2, padding=1) for c in channels[:-1])

    def forward(self, x: Tensor, code: Tensor) -> list[Tensor]:
        """What each resolution sees, [B, C, L], [B, C', L / 2], ...; the lowest is last."""
        seen: list[Tensor] = []
        for level, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            x = second(first(x if level == 0 else self.down[level - 1](x), code), code)
            seen.append(x)
        return seen


class TemporalUNet(nn.Module):
    """Predicts from noisy sequences, a mask of the known entries and the time of the process.

    The mask is a channel of the input: at a random place a clean state cannot be told from noise.
    The time code is made of [1] where all rows share it, and broadcast.

    Args:
        entries (int): D, of a state and an action.
        width (int, optional): channels at full resolution are ``width * multiples[0]``. Defaults to
            ``32``.
        multiples (sequence of int, optional): of ``width`` at each resolution (absolute, not of the
            one before). Defaults to ``(1, 2, 4, 8)``.
        mask_channels (int, optional): M, groups of entries that are known together. Defaults to
            ``1``: the state.

    Raises:
        ValueError: the channels do not fall into groups, or there is no resolution.

    Examples:
        >>> network = TemporalUNet(entries=6, width=8, multiples=(1, 2))
        >>> mask = torch.zeros(3, 32, 1, dtype=torch.bool)
        >>> network(torch.randn(3, 32, 6), mask, torch.rand(3)).shape
        torch.Size([3, 32, 6])
    """

    def __init__(
        self,
        entries: int,
        width: int = 32,
        multiples: Sequence[int] = (1, 2, 4, 8),
        mask_channels: int = 1,
    ):
        super().__init__()
        if len(multiples) == 0:
            raise ValueError("multiples are empty; a U-Net has one resolution or more.")
        self.entries, self.mask_channels = entries, mask_channels
        self.multiples = tuple(multiples)
        self.time = TimeCode(width)
        self.encoder = Encoder(entries + mask_channels, width, multiples)
        channels = [width * multiple for multiple in multiples]
        low = channels[-1]
        self.middle = nn.ModuleList(ResidualBlock(low, low, width) for _ in range(2))
        pairs = list(zip(channels[1:], channels[:-1], strict=True))[::-1]
        self.first = nn.ModuleList(ResidualBlock(2 * a, b, width) for a, b in pairs)
        self.second = nn.ModuleList(ResidualBlock(b, b, width) for _, b in pairs)
        self.up = nn.ModuleList(nn.ConvTranspose1d(b, b, 4, 2, padding=1) for _, b in pairs)
        self.last = ConvBlock(channels[0], channels[0])
        self.head = nn.Conv1d(channels[0], entries, 1)

    def reset_parameters(self) -> None:
        """Draws new weights."""
        for module in self.modules():
            if isinstance(module, nn.Conv1d | nn.ConvTranspose1d | nn.Linear | nn.GroupNorm):
                module.reset_parameters()

    def forward(self, x: Tensor, mask: Tensor, time: Tensor, free: slice | None = None) -> Tensor:
        """Predicts [B, L, D], or the steps in ``free`` of it.

        Args:
            x (Tensor): noisy sequences [B, L, D]; L is a multiple of 2 ** (resolutions - 1).
            mask (Tensor): bool [B, L, M], True where they are known.
            time (Tensor): of the process, [B], or [1] for all alike.
            free (slice, optional): the steps asked for. Defaults to all.

        Raises:
            ValueError: the input has another width, or a length that cannot be halved so often.
        """
        check_sequence(x, mask, self.entries, self.mask_channels)
        check_length(x.shape[1], len(self.multiples))
        code = self.time(time)
        x = torch.cat([x, mask.to(x.dtype)], -1).transpose(1, 2)  # [B, D + M, L]
        seen = self.encoder(x, code)
        x = seen[-1]
        for block in self.middle:
            x = block(x, code)
        for first, second, up in zip(self.first, self.second, self.up, strict=True):
            x = up(second(first(torch.cat([x, seen.pop()], 1), code), code))
        x = self.head(self.last(x)).transpose(1, 2)
        return x if free is None else x[:, free]


def check_length(length: int, resolutions: int) -> None:
    """Raises ValueError for a plan that cannot be halved ``resolutions - 1`` times."""
    unit = 2 ** (resolutions - 1)
    if length < unit or length % unit:
        below = length - length % unit
        near = f"{below} or {below + unit}" if below else f"{unit}"
        raise ValueError(
            f"a plan of {length} steps cannot be halved {resolutions - 1} times, as the "
            f"{resolutions} resolutions of this network do; use {near}, or fewer multiples."
        )


def check_sequence(x: Tensor, mask: Tensor, entries: int, mask_channels: int) -> None:
    """Raises ValueError for sequences that are not [B, L, entries] or a mask that is not theirs."""
    if x.ndim != 3 or x.shape[-1] != entries:
        raise ValueError(
            f"the sequences are {tuple(x.shape)}; expected [B, L, {entries}], states and actions."
        )
    if mask.shape != (*x.shape[:2], mask_channels):
        raise ValueError(
            f"the mask is {tuple(mask.shape)}; expected {(*x.shape[:2], mask_channels)}, as the "
            "sequences are."
        )
