"""Networks at fixed weights: what depends on weights and time alone is computed once."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, Protocol, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_rad.modules.dit import Block, DiT

__all__ = [
    "FrozenCache",
    "FrozenDiT",
    "FrozenLinear",
    "PlainNetwork",
    "StepNetwork",
    "can_pack",
    "is_hooked",
    "step_network",
]


class StepNetwork(Protocol):
    """A denoising network at the times of a sampler: what needs no noisy sample is prepared."""

    def prepare(self, mask: Tensor) -> Tensor:
        """What depends on the mask [B, n, 1] of the known tokens alone."""

    def __call__(self, x: Tensor, prepared: Tensor, step: int, free: slice) -> Tensor:
        """Predicts [B, f, S] for the f tokens in ``free``, those whose values are asked for.

        Args:
            x (Tensor): noisy states [B, n, S].
            prepared (Tensor): of :meth:`prepare`.
            step (int): number of the time.
            free (slice): of the tokens.
        """


def step_network(
    network: nn.Module,
    times: Sequence[float],
    dtype: torch.dtype | None = None,
    condition: Tensor | None = None,
) -> StepNetwork:
    """A :class:`FrozenDiT`; a :class:`PlainNetwork` where something else has to be called."""
    if type(network) is DiT and not is_hooked(network):
        return FrozenDiT(network, times, dtype, condition)
    return PlainNetwork(network, times, dtype, condition)


def is_hooked(network: nn.Module) -> bool:
    """Whether somebody wants to see the calls of a network."""
    return bool(network._forward_hooks or network._forward_pre_hooks)


class PlainNetwork:
    """Calls a network (x [B, n, S], mask, time [1]) -> [B, n, S] as it is.

    Args:
        network (nn.Module): any.
        times (sequence of float): of the process, one a step.
        dtype (torch.dtype, optional): of autocast. Defaults to none.
        condition (Tensor, optional): [1], passed on by name if there is one.

    Examples:
        >>> plain, mask = PlainNetwork(DiT(4, tokens=5), [1.0]), torch.zeros(3, 5, 1).bool()
        >>> plain(torch.randn(3, 5, 4), plain.prepare(mask), 0, slice(1, 5)).shape
        torch.Size([3, 4, 4])
    """

    def __init__(
        self,
        network: nn.Module,
        times: Sequence[float],
        dtype: torch.dtype | None = None,
        condition: Tensor | None = None,
    ):
        self.network, self.times, self.dtype = network, times, dtype
        self.told = {} if condition is None else {"condition": condition}
        on_cpu = all(parameter.device.type == "cpu" for parameter in network.parameters())
        if dtype == torch.float16 and on_cpu:  # quick there with packed weights only
            self.dtype = None

    def prepare(self, mask: Tensor) -> Tensor:
        return mask

    def __call__(self, x: Tensor, prepared: Tensor, step: int, free: slice) -> Tensor:
        with torch.autocast(x.device.type, self.dtype, self.dtype is not None):
            time = torch.full((1,), self.times[step], device=x.device)
            return self.network(x, prepared, time, **self.told)[:, free].to(x.dtype)


class FrozenLinear:
    """A linear layer whose weights lie as the product wants to read them.

    With few rows a product takes as long as reading the weights does. In float32 they are
    transposed; on a CPU those of lower precision are packed: in bfloat16 by oneDNN, as inductor's
    frozen graphs are, in float16 by fbgemm, whose products take rows and add up in float32.

    Args:
        weight (Tensor): [out, in].
        bias (Tensor): [out].
        dtype (torch.dtype, optional): of the product. Defaults to that of the weight.

    Examples:
        >>> linear = FrozenLinear(torch.tensor([[1.0, 2.0]]), torch.tensor([3.0]))
        >>> linear(torch.tensor([[1.0, 1.0]]))
        tensor([[6.]])
    """

    def __init__(self, weight: Tensor, bias: Tensor, dtype: torch.dtype | None = None):
        self.dtype = weight.dtype if dtype is None else dtype
        weight, bias = weight.detach(), bias.detach()
        self.packed = None
        if weight.is_cpu and can_pack(self.dtype):
            self.packed = _PACKED[self.dtype](weight, bias)
        else:  # on a GPU the transposed view is read as fast
            weight, self.bias = weight.to(self.dtype), bias.to(self.dtype)
            self.weight = weight.T.contiguous() if weight.is_cpu else weight.T

    def __call__(self, x: Tensor, gelu: bool = False) -> Tensor:
        """[M, out] of rows [M, in], through GELU if asked for."""
        if self.packed is not None:
            return self.packed(x, gelu)
        x = torch.addmm(self.bias, x.to(self.dtype), self.weight)
        return F.gelu(x) if gelu else x


def can_pack(dtype: torch.dtype) -> bool:
    """Whether this CPU has a product with packed weights of a dtype."""
    try:  # these are not public, so they may go
        if dtype is torch.bfloat16:
            return torch.ops.mkldnn._is_mkldnn_bf16_supported()
        if dtype is torch.float16:
            torch.ops.quantized.linear_prepack_fp16  # noqa: B018
            return torch.backends.quantized.engine in ("x86", "fbgemm")
    except AttributeError:
        pass
    return False


def _packed_bfloat16(weight: Tensor, bias: Tensor) -> Callable[[Tensor, bool], Tensor]:
    dtype, bias = torch.bfloat16, bias.bfloat16()
    weight = torch.ops.mkldnn._reorder_linear_weight(weight.to(dtype).contiguous())

    def product(x: Tensor, gelu: bool) -> Tensor:
        name, form = ("gelu", "none") if gelu else ("none", "")
        return torch.ops.mkldnn._linear_pointwise(x.to(dtype), weight, bias, name, [], form)

    return product


def _packed_float16(weight: Tensor, bias: Tensor) -> Callable[[Tensor, bool], Tensor]:
    packed = torch.ops.quantized.linear_prepack_fp16(weight.float().contiguous(), bias.float())

    def product(x: Tensor, gelu: bool) -> Tensor:
        x = torch.ops.quantized.linear_dynamic_fp16(x.float(), packed)
        return F.gelu(x) if gelu else x

    return product


_PACKED = {torch.bfloat16: _packed_bfloat16, torch.float16: _packed_float16}


class FrozenBlock:
    """A :class:`~torchrl_rad.modules.dit.Block` at some times of the process.

    Scale and shift become weight and bias of the normalisation.
    """

    def __init__(self, block: Block, condition: Tensor, dtype: torch.dtype | None):
        parts = block.modulation(condition).chunk(6, -1)  # each [K, W]
        shift, scale, gate, shift_mlp, scale_mlp, gate_mlp = (part.unbind(0) for part in parts)
        self.before = [(1 + a, b) for a, b in zip(scale, shift, strict=True)]
        self.before_mlp = [(1 + a, b) for a, b in zip(scale_mlp, shift_mlp, strict=True)]
        self.gate, self.gate_mlp, self.heads = gate, gate_mlp, block.heads
        up, _, down = cast(Iterable[nn.Linear], block.mlp)
        self.qkv, self.out, self.up, self.down = (
            FrozenLinear(layer.weight, layer.bias, dtype)
            for layer in (block.qkv, block.out, up, down)
        )

    def __call__(self, x: Tensor, step: int, tokens: int, free: slice | None = None) -> Tensor:
        """[B * n, W] to [B * n, W]; of the tokens in ``free`` only, if it is given."""
        width = x.shape[-1:]
        rows = len(x) // tokens
        h = self.qkv(F.layer_norm(x, width, *self.before[step], eps=1e-6)).to(x.dtype)
        qkv = h.view(rows, tokens, 3, self.heads, width[0] // self.heads).permute(2, 0, 3, 1, 4)
        query, key, value = qkv.unbind(0)  # each [B, heads, n, E]
        if free is not None:
            query, x = query[:, :, free], x.view(rows, tokens, *width)[:, free].flatten(0, 1)
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2)
        x = torch.addcmul(x, self.gate[step], self.out(mixed.reshape(x.shape)))
        h = F.layer_norm(x, width, *self.before_mlp[step], eps=1e-6)
        return torch.addcmul(x, self.gate_mlp[step], self.down(self.up(h, gelu=True)))


class FrozenDiT:
    """A :class:`~torchrl_rad.modules.dit.DiT` at its present weights and the times of a sampler.

    Its predictions are those of the network: in float32 but for the order of summation; in float16
    on a CPU weights are rounded, in bfloat16 also what they are multiplied with (the residual
    stream, attention, embedding and head are not).

    Args:
        network (DiT): copied; later changes of its weights do not show.
        times (sequence of float): of the process, one a step.
        dtype (torch.dtype, optional): of the large products. Defaults to that of the weights.
        condition (Tensor, optional): [1], of all plans.

    Examples:
        >>> network = DiT(state_dim=4, tokens=5)
        >>> frozen, mask = FrozenDiT(network, [1.0, 0.5]), torch.zeros(3, 5, 1, dtype=torch.bool)
        >>> x = torch.randn(3, 5, 4)
        >>> frozen(x, frozen.prepare(mask), step=1, free=slice(1, 5)).shape
        torch.Size([3, 4, 4])
    """

    @torch.no_grad()
    def __init__(
        self,
        network: DiT,
        times: Sequence[float],
        dtype: torch.dtype | None = None,
        condition: Tensor | None = None,
    ):
        with torch.autocast(network.positions.device.type, enabled=False):
            time = torch.tensor(times, device=network.positions.device)
            told = network.modulator(time, condition)  # [K, W]
            self.blocks = [FrozenBlock(b, told, dtype) for b in network.blocks]  # type: ignore
            shift, scale = network.modulation(told).chunk(2, -1)
            self.before = list(zip((1 + scale).unbind(0), shift.unbind(0), strict=True))
        embed, entries = network.embed, network.embed.in_features - network.mask_channel
        self.positions = network.positions + embed.bias  # [n, W]
        self.embed = embed.weight[:, :entries].T.contiguous()
        self.mask = embed.weight[:, entries:].T.contiguous()  # [1, W], or [0, W] without mask
        self.head = FrozenLinear(network.head.weight, network.head.bias)

    def prepare(self, mask: Tensor) -> Tensor:
        """Positions, bias and mask in the embedding, [B * n, W]."""
        embedded = self.positions.expand(len(mask), -1, -1)
        if len(self.mask):
            embedded = embedded + mask * self.mask
        return embedded.flatten(0, 1)

    def __call__(self, x: Tensor, prepared: Tensor, step: int, free: slice) -> Tensor:
        """As :meth:`StepNetwork.__call__`."""
        rows, tokens = x.shape[:2]
        h = torch.addmm(prepared, x.flatten(0, 1), self.embed)  # [B * n, W]
        for block in self.blocks[:-1]:
            h = block(h, step, tokens)
        h = self.blocks[-1](h, step, tokens, free)
        h = F.layer_norm(h, h.shape[-1:], *self.before[step], eps=1e-6)
        return self.head(h).view(rows, len(range(tokens)[free]), x.shape[-1])


class FrozenCache:
    """Keeps what was made from a module's weights for as long as these stay the same.

    Not every write on a parameter raises its version (fused optimisers and writes through ``.data``
    do not), so the weights' vectors and the first row of each other are compared too. What no
    comparison of these shows is a write through ``.data`` that leaves them all as they are.

    Examples:
        >>> cache, network = FrozenCache(), nn.Linear(2, 1)
        >>> first = cache.get(network, "sum", lambda: float(network.weight.sum()))
        >>> network.weight.data += 1.0
        >>> cache.get(network, "sum", lambda: float(network.weight.sum())) == first
        False
    """

    def __init__(self) -> None:
        self.state: list[tuple[int, int, int]] = []
        self.samples: list[Tensor] = []
        self.before = torch.empty(0)
        self.made: dict[Hashable, Any] = {}

    def __reduce__(self):
        return FrozenCache, ()  # copies and pickles are empty

    @torch.no_grad()
    def get(self, module: nn.Module, key: Hashable, make: Callable[[], Any]) -> Any:
        """What ``make()`` gave for ``key`` at the module's present weights."""
        modules = module.modules()
        parameters = [p for m in modules for p in m._parameters.values() if p is not None]
        state = [(id(p), p.data_ptr(), p._version) for p in parameters]
        same = state == self.state
        if not same:
            self.state = state
            self.samples = [p.detach()[(0,) * (p.ndim - 1)].view(-1) for p in parameters]
        sample = torch.cat(self.samples) if self.samples else torch.empty(0)
        if not same or not torch.equal(sample, self.before):
            self.before, self.made = sample, {}
        if key not in self.made:
            self.made[key] = make()
        return self.made[key]
