"""A diffusion transformer over the few states of one plan level (DiT, Peebles and Xie, 2023)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["DiT"]


def sinusoids(positions: Tensor, size: int) -> Tensor:
    """Sine then cosine codes of positions [N]: [N, size]."""
    frequencies = torch.exp(-math.log(10_000.0) * torch.arange(size // 2) / (size // 2 - 1))
    angles = positions[:, None] * frequencies.to(positions.device)
    return torch.cat([angles.sin(), angles.cos()], -1)


def attend(qkv: Tensor) -> Tensor:
    """Attention over queries, keys and values in one, [3, B, heads, L, E]: [B, heads, L, E]."""
    if qkv.dtype != torch.bfloat16 or not qkv.is_cpu:
        return F.scaled_dot_product_attention(*qkv)
    # with so few tokens the CPU's fused kernel is slower in bfloat16 than in float32
    with torch.autocast("cpu", enabled=False):
        return F.scaled_dot_product_attention(*qkv.float()).to(qkv.dtype)


class Block(nn.Module):
    """Attention and MLP, each scaled, shifted and gated by the conditioning (adaLN-Zero)."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU("tanh"), nn.Linear(4 * width, width)
        )
        self.modulation = nn.Linear(width, 6 * width)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        parts = self.modulation(condition)[:, None].chunk(6, -1)  # each [B or 1, 1, W]
        shift, scale, gate, shift_mlp, scale_mlp, gate_mlp = parts
        x = x + gate * self._attention(self.norm(x) * (1 + scale) + shift)
        return x + gate_mlp * self.mlp(self.norm(x) * (1 + scale_mlp) + shift_mlp)

    def _attention(self, x: Tensor) -> Tensor:
        qkv = self.qkv(x).unflatten(-1, (3, self.heads, -1))
        mixed = attend(qkv.permute(2, 0, 3, 1, 4))  # [B, heads, L, W / heads]
        return self.out(mixed.transpose(1, 2).flatten(-2))


class DiT(nn.Module):
    """Predicts from noisy states, a mask of the known ones and the time of the process.

    The residual stream is the standard one. With ``mask_channel`` the network is told which entries
    are known: at a random place a clean state cannot be told from noise. The output is zero at
    initialisation.

    Args:
        state_dim (int): S, entries of a state.
        tokens (int): n, states of a plan.
        width (int, optional): Defaults to ``256``.
        heads (int, optional): Defaults to ``8``.
        blocks (int, optional): Defaults to ``2``.
        mask_channel (bool, optional): Defaults to ``True``.

    Examples:
        >>> network = DiT(state_dim=4, tokens=5)
        >>> mask = torch.zeros(3, 5, 1, dtype=torch.bool)
        >>> network(torch.randn(3, 5, 4), mask, torch.rand(3)).shape
        torch.Size([3, 5, 4])
    """

    positions: Tensor

    def __init__(
        self,
        state_dim: int,
        tokens: int,
        width: int = 256,
        heads: int = 8,
        blocks: int = 2,
        mask_channel: bool = True,
    ):
        super().__init__()
        if width % heads or width % 2 or width < 4:
            raise ValueError(
                f"width is {width}; expected an even multiple of heads ({heads}), 4 or more."
            )
        if blocks < 1:
            raise ValueError(f"blocks is {blocks}; expected 1 or more.")
        self.width, self.mask_channel = width, mask_channel
        self.register_buffer("positions", sinusoids(torch.arange(float(tokens)), width))
        self.embed = nn.Linear(state_dim + mask_channel, width)
        self.time = nn.Sequential(
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(blocks))
        self.norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.modulation = nn.Linear(width, 2 * width)
        self.head = nn.Linear(width, state_dim)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws new weights, such that the output is zero."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        for name, parameter in self.named_parameters():
            if name.endswith(("modulation.weight", "head.weight")):
                nn.init.zeros_(parameter)

    def forward(self, x: Tensor, mask: Tensor, time: Tensor) -> Tensor:
        """Predicts [B, n, S].

        Args:
            x (Tensor): noisy states [B, n, S].
            mask (Tensor): bool [B, n, 1], True where they are known.
            time (Tensor): of the process, [B], or [1] for all alike.
        """
        if self.mask_channel:
            x = torch.cat([x, mask.to(x.dtype)], -1)
        x = self.embed(x) + self.positions  # [B, n, W]
        codes = sinusoids(1000.0 * time, self.width)
        condition = self.time(codes.to(self.positions.dtype))  # [B or 1, W]
        for block in self.blocks:
            x = block(x, condition)
        shift, scale = self.modulation(condition)[:, None].chunk(2, -1)
        return self.head(self.norm(x) * (1 + scale) + shift)
