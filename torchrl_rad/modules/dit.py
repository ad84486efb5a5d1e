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


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Attention [B, heads, f, E] of queries [B, heads, f, E] to the keys [B, heads, n, E]."""
    if query.dtype != torch.bfloat16 or not query.is_cpu:
        return F.scaled_dot_product_attention(query, key, value)
    # with so few tokens the CPU's fused kernel is slower in bfloat16 than in float32
    with torch.autocast("cpu", enabled=False):
        parts = query.float(), key.float(), value.float()
        return F.scaled_dot_product_attention(*parts).to(query.dtype)


class Block(nn.Module):
    """Attention and MLP, each scaled, shifted and gated by the conditioning (adaLN-Zero)."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        # the exact form: on a CPU the one with tanh takes four times as long
        self.mlp = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
        )
        self.modulation = nn.Linear(width, 6 * width)

    def forward(self, x: Tensor, condition: Tensor, free: slice | None = None) -> Tensor:
        """[B, n, W] to [B, f, W], the tokens in ``free`` or all; ``condition`` is [B or 1, W]."""
        parts = self.modulation(condition)[:, None].chunk(6, -1)  # each [B or 1, 1, W]
        shift, scale, gate, shift_mlp, scale_mlp, gate_mlp = parts
        h = self._attention(torch.addcmul(shift, self.norm(x), 1 + scale), free)
        x = torch.addcmul(x if free is None else x[:, free], gate, h)
        return torch.addcmul(
            x, gate_mlp, self.mlp(torch.addcmul(shift_mlp, self.norm(x), 1 + scale_mlp))
        )

    def _attention(self, x: Tensor, free: slice | None) -> Tensor:
        qkv = self.qkv(x).unflatten(-1, (3, self.heads, -1)).transpose(1, 3)
        query, key, value = qkv.unbind(2)  # each [B, heads, n, W / heads]
        mixed = attend(query if free is None else query[:, :, free], key, value)
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
        conditioned (bool, optional): the network is also told a number for each plan, such as the
            return that it is to have. Defaults to ``False``.

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
        conditioned: bool = False,
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
        self.condition: nn.Module | None = None
        if conditioned:
            self.condition = nn.Sequential(
                nn.Linear(1, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
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

    def modulator(self, time: Tensor, condition: Tensor | None = None) -> Tensor:
        """What scales and shifts all blocks: [B or 1, W] of times and conditions [B], or [1]."""
        codes = sinusoids(1000.0 * time, self.width)
        told = self.time(codes.to(self.positions.dtype))
        if self.condition is None:
            return told
        assert condition is not None  # the planner has one if its networks want it
        return told + self.condition(condition[:, None].to(self.positions.dtype))

    def forward(
        self,
        x: Tensor,
        mask: Tensor,
        time: Tensor,
        free: slice | None = None,
        condition: Tensor | None = None,
    ) -> Tensor:
        """Predicts [B, f, S].

        Args:
            x (Tensor): noisy states [B, n, S].
            mask (Tensor): bool [B, n, 1], True where they are known.
            time (Tensor): of the process, [B], or [1] for all alike.
            free (slice, optional): the f tokens asked for. Defaults to all.
            condition (Tensor, optional): [B], or [1] for all alike; where it is ``conditioned``.
        """
        if self.mask_channel:
            x = torch.cat([x, mask.to(x.dtype)], -1)
        x = self.embed(x)
        x = x + self.positions.to(x.dtype)  # [B, n, W], of the precision of autocast
        told = self.modulator(time, condition)
        for block in self.blocks[:-1]:
            x = block(x, told)
        x = self.blocks[-1](x, told, free)
        shift, scale = self.modulation(told)[:, None].chunk(2, -1)
        return self.head(torch.addcmul(shift, self.norm(x), 1 + scale))
