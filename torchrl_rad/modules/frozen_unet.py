"""U-Net and noisy return model at fixed weights, with convolutions that multiply less.

A convolution five steps wide is worked out by Toom and Cook's method (Lavin and Gray, 2016): four
neighbouring outputs from eight products instead of twenty. Activations lie as phases [4, T, B, C]:
step 4 t + p of a sequence is at [p, t], so that the four outputs are whole blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, cast

import torch
from torch import Tensor, nn

from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.temporal_unet import (
    GROUPS,
    ConvBlock,
    Encoder,
    ResidualBlock,
    TemporalUNet,
    TimeCode,
)

__all__ = ["FrozenReturnModel", "FrozenUNet", "can_tile"]

Function = Callable[[Tensor, Tensor, Tensor], Tensor]

EPSILON = 1e-5  # of GroupNorm


def _number(value: float, dtype: torch.dtype) -> Tensor:
    """A 0-dim tensor: torch makes one of a Python number at each call, which takes microseconds."""
    if torch.compiler.is_compiling():  # where they are constants, and caches are warned of
        return torch.tensor(value, dtype=dtype)
    return _kept_number(value, dtype)


@lru_cache
def _kept_number(value: float, dtype: torch.dtype) -> Tensor:
    return torch.tensor(value, dtype=dtype)


def can_tile(length: int, resolutions: int) -> bool:
    """Whether at every resolution the steps of a plan fall into tiles of four."""
    return length % (4 * 2 ** (resolutions - 1)) == 0


def _matrices() -> tuple[Tensor, Tensor, Tensor]:
    """A [4, 8], G [8, 5] and B [8, 8] for four outputs y_p = sum_j g_j d_{p + j}.

    They are y = A ((G g) * (B d)).
    A polynomial product is evaluated at seven points and at infinity; this is its transpose.
    """
    points = torch.tensor([0.0, 1.0, -1.0, 2.0, -2.0, 0.5, -0.5], dtype=torch.float64)

    def powers(count: int) -> Tensor:
        finite = points[:, None] ** torch.arange(count)
        infinity = torch.zeros(1, count, dtype=torch.float64)
        infinity[0, -1] = 1.0
        return torch.cat([finite, infinity])

    return powers(4).T, powers(5), torch.linalg.inv(powers(8)).T


class FrozenConv:
    """A convolution five steps wide with padding 2, and its transpose.

    Examples:
        >>> conv = nn.Conv1d(3, 6, 5, padding=2)
        >>> x = torch.randn(2, 3, 8)  # two sequences of two tiles
        >>> phases = x.permute(2, 0, 1).reshape(2, 4, 2, 3).transpose(0, 1).contiguous()
        >>> y = FrozenConv(conv.weight, conv.bias)(phases)
        >>> y = y.transpose(0, 1).reshape(8, 2, 6).permute(1, 2, 0)
        >>> torch.allclose(y, conv(x), atol=1e-4)
        True
    """

    def __init__(self, weight: Tensor, bias: Tensor | None = None):
        of_outputs, of_weights, of_inputs = _matrices()
        taps = weight.double().permute(2, 1, 0)  # [5, in, out]
        products = torch.tensordot(of_weights, taps, 1)  # [8, in, out]
        self.weight = products.to(weight.dtype).contiguous()
        self.outputs, self.inputs = of_outputs.to(weight.dtype), of_inputs.to(weight.dtype)
        self.bias = bias

    def __call__(self, x: Tensor) -> Tensor:
        """[4, T, B, in] to [4, T, B, out]."""
        _, tiles, rows, entries = x.shape
        if tiles == 1:  # the steps around are padding
            inputs, matrix = x.flatten(1), self.inputs[:, 2:6]
        else:
            around = x.new_empty(8, tiles, rows, entries)
            around[2:6] = x
            around[:2, 1:], around[6:, :-1] = x[2:, :-1], x[:2, 1:]
            around[:2, 0], around[6:, -1] = 0.0, 0.0  # padding
            inputs, matrix = around.flatten(1), self.inputs
        products = torch.bmm((matrix @ inputs).view(8, tiles * rows, entries), self.weight)
        y = (self.outputs @ products.flatten(1)).view(4, tiles, rows, products.shape[-1])
        return y if self.bias is None else y.add_(self.bias)


class FrozenConvBlock:
    """A :class:`~torchrl_rad.modules.temporal_unet.ConvBlock` and its gradient."""

    def __init__(self, block: ConvBlock, gradients: bool):
        conv, norm, _ = cast(tuple[nn.Conv1d, nn.GroupNorm, nn.Mish], tuple(block))
        weight, bias = conv.weight.detach(), cast(Tensor, conv.bias).detach()
        self.conv = FrozenConv(weight, bias)
        self.gamma, self.beta = norm.weight.detach(), norm.bias.detach()
        if gradients:
            self.back = FrozenConv(weight.flip(-1).transpose(0, 1))

    def __call__(self, x: Tensor, tape: list[Any] | None = None) -> Tensor:
        x = self.conv(x)
        shape, grouped = x.shape, _grouped(x.shape)
        x = x.flatten(0, 1)  # [L, B, C]
        one = _number(1.0, x.dtype)
        share = _number(1 / (len(x) * grouped[-1]), x.dtype)  # of a group, of one entry
        sums = torch.stack([x.sum(0), (x * x).sum(0)]).view(2, *grouped).sum(-1, keepdim=True)
        mean, square = (sums * share).unbind(0)  # [B, groups, 1]
        variance = torch.addcmul(square, mean, mean, value=-1).clamp_min_(0.0)
        rate = variance.add_(_number(EPSILON, x.dtype)).rsqrt_()
        scale = rate * self.gamma.view(GROUPS, -1)  # [B, groups, C / groups]
        shift = torch.addcmul(self.beta.view(GROUPS, -1), mean, scale, value=-1)
        scale, shift = scale.flatten(1), shift.flatten(1)  # [B, C]
        y = torch.addcmul(shift, x, scale)
        # mish(y) = y (1 - 2 / (1 + (1 + exp y)^2)), also where exp y is infinite
        grown = (y if tape is None else y.clamp(max=30.0)).exp().add_(one)
        denominator = torch.addcmul(one, grown, grown)
        if tape is not None:
            slope = _mish_slope(y, grown, denominator)
            tape.append((x, slope, mean, rate, scale))
        return torch.addcdiv(y, y, denominator, value=-2).view(shape)

    def gradient(self, grad: Tensor, tape: list[Any]) -> Tensor:
        """From the gradient of the output to that of the input."""
        x, slope, mean, rate, scale = tape.pop()
        shape, grouped = grad.shape, _grouped(grad.shape)
        grad = grad.view(x.shape) * slope
        # through the normalisation: what moves mean or deviation of a group is taken out
        share = _number(1 / (len(x) * grouped[-1]), x.dtype)
        sums = torch.stack([grad.sum(0), (grad * x).sum(0)]).mul_(scale)
        sums = sums.view(2, *grouped).sum(-1, keepdim=True)
        first, second = (sums * share).unbind(0)
        along = (second - mean * first) * rate * rate  # [B, groups, 1]
        constant = (mean * along - first).expand(grouped).flatten(1)
        along = along.expand(grouped).flatten(1)
        out = torch.addcmul(constant, grad, scale)
        return self.back(torch.addcmul(out, x, along, value=-1).view(shape))


def _grouped(shape: torch.Size) -> tuple[int, int, int]:
    """[B, groups, C / groups] of phases."""
    return shape[2], GROUPS, shape[3] // GROUPS


def mish_slope(y: Tensor) -> Tensor:
    """Derivative of mish."""
    one = _number(1.0, y.dtype)
    grown = y.clamp(max=30.0).exp_().add_(one)
    return _mish_slope(y, grown, torch.addcmul(one, grown, grown))


def _mish_slope(y: Tensor, grown: Tensor, denominator: Tensor) -> Tensor:
    """The same with g = 1 + exp y and d = 1 + g^2 given: 1 + 2 (2 y g (g - 1) / d - 1) / d."""
    one = _number(1.0, y.dtype)
    product = torch.addcmul(grown, grown, grown, value=-1).mul_(y)
    inner = torch.addcdiv(one, product, denominator, value=2)
    return torch.addcdiv(one, inner, denominator, value=-2)


class FrozenResidualBlock:
    """A :class:`~torchrl_rad.modules.temporal_unet.ResidualBlock` at some times."""

    def __init__(self, block: ResidualBlock, codes: Tensor, gradients: bool = False):
        self.first, self.second = (
            FrozenConvBlock(part, gradients) for part in (block.first, block.second)
        )
        self.time = block.time(codes)  # [K, C]
        self.skip: tuple[Tensor, Tensor] | None = None
        if isinstance(block.skip, nn.Conv1d):
            weight = block.skip.weight.detach()[..., 0].T.contiguous()
            self.skip = weight, cast(Tensor, block.skip.bias).detach()

    def __call__(self, x: Tensor, step: Tensor, tape: list[Any] | None = None) -> Tensor:
        h = self.second(self.first(x, tape).add_(self.time.index_select(0, step)), tape)
        if self.skip is None:
            return h.add_(x)
        weight, bias = self.skip
        return torch.addmm(bias, x.flatten(0, 2), weight).view(h.shape).add_(h)

    def gradient(self, grad: Tensor, tape: list[Any]) -> Tensor:
        through = self.first.gradient(self.second.gradient(grad, tape), tape)
        if self.skip is None:
            return through.add_(grad)
        past = grad.flatten(0, 2) @ self.skip[0].T
        return through.add_(past.view(through.shape))


def as_phases(x: Tensor) -> Tensor:
    """Steps first [L, B, C] to phases [4, L / 4, B, C]."""
    return x.view(len(x) // 4, 4, *x.shape[1:]).transpose(0, 1).contiguous()


def as_steps(x: Tensor) -> Tensor:
    """Phases [4, T, B, C] to steps first [4 T, B, C]."""
    return x.transpose(0, 1).flatten(0, 1)


def shifted(x: Tensor, by: int) -> Tensor:
    """Steps [L, B, C] one earlier (by 1) or later (by -1), with zeros outside of the plan."""
    nothing = torch.zeros_like(x[:1])
    return torch.cat([nothing, x[:-1]] if by == 1 else [x[1:], nothing])


class FrozenDown:
    """The convolution that halves the steps, and its gradient."""

    def __init__(self, conv: nn.Conv1d):
        weight = conv.weight.detach().permute(2, 1, 0)  # [3, in, out]
        self.weight, self.bias = weight.flatten(0, 1), cast(Tensor, conv.bias).detach()
        before, now, after = weight.transpose(1, 2)
        self.even, self.odd = now, torch.cat([after, before])

    def __call__(self, x: Tensor) -> Tensor:
        x = as_steps(x)
        odd = x[1::2]
        seen = torch.cat([shifted(odd, 1), x[::2], odd], -1)  # [L / 2, B, 3 C]
        y = torch.addmm(self.bias, seen.flatten(0, 1), self.weight)
        return as_phases(y.view(*seen.shape[:2], len(self.bias)))

    def gradient(self, grad: Tensor) -> Tensor:
        grad = as_steps(grad)
        even = grad.flatten(0, 1) @ self.even
        odd = torch.cat([grad, shifted(grad, -1)], -1).flatten(0, 1) @ self.odd
        together = torch.stack([part.view(grad.shape) for part in (even, odd)], 1)
        return as_phases(together.flatten(0, 1))


class FrozenUp:
    """The transposed convolution that doubles the steps."""

    def __init__(self, conv: nn.ConvTranspose1d):
        taps = conv.weight.detach().permute(2, 0, 1)  # [4, in, out]
        self.even, self.odd = torch.cat([taps[1], taps[3]]), torch.cat([taps[2], taps[0]])
        self.bias = cast(Tensor, conv.bias).detach()

    def __call__(self, x: Tensor) -> Tensor:
        x = as_steps(x)
        parts = [
            torch.addmm(self.bias, torch.cat([x, shifted(x, by)], -1).flatten(0, 1), weight)
            for by, weight in ((1, self.even), (-1, self.odd))
        ]
        together = torch.stack([part.view(x.shape) for part in parts], 1)  # [L, 2, B, C]
        return as_phases(together.flatten(0, 1))


class FrozenEncoder:
    """An :class:`~torchrl_rad.modules.temporal_unet.Encoder` at some times."""

    def __init__(self, encoder: Encoder, codes: Tensor, gradients: bool = False):
        self.first, self.second = (
            [FrozenResidualBlock(cast(ResidualBlock, b), codes, gradients) for b in blocks]
            for blocks in (encoder.first, encoder.second)
        )
        self.down = [FrozenDown(cast(nn.Conv1d, conv)) for conv in encoder.down]

    def __call__(self, x: Tensor, step: Tensor, tape: list[Any] | None = None) -> list[Tensor]:
        seen: list[Tensor] = []
        for level, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            x = x if level == 0 else self.down[level - 1](x)
            x = second(first(x, step, tape), step, tape)
            seen.append(x)
        return seen

    def gradient(self, grad: Tensor, tape: list[Any]) -> Tensor:
        for level in reversed(range(len(self.first))):
            grad = self.first[level].gradient(self.second[level].gradient(grad, tape), tape)
            grad = grad if level == 0 else self.down[level - 1].gradient(grad)
        return grad


def _codes(code: TimeCode, times: Sequence[float]) -> Tensor:
    """Time codes [K, W]."""
    return code(torch.tensor(times, device=code.first.weight.device))


def _numbers(codes: Tensor) -> tuple[Tensor, ...]:
    """Those of the times as tensors [1]: of Python's a compiled function would be made for each."""
    return torch.arange(len(codes)).split(1)


def _input(x: Tensor, prepared: Tensor) -> Tensor:
    """Sequences [B, L, D] and the mask's channel as phases."""
    return as_phases(torch.cat([x.transpose(0, 1), prepared], -1))


class FrozenUNet:
    """A :class:`TemporalUNet` at its present weights and the times of a sampler, on a CPU.

    Args:
        network (TemporalUNet): copied; later changes of its weights do not show.
        times (sequence of float): of the process, one a step.

    Examples:
        >>> network = TemporalUNet(6, width=8, multiples=(1, 2))
        >>> frozen, mask = FrozenUNet(network, [1.0, 0.5]), torch.zeros(3, 8, 1, dtype=torch.bool)
        >>> x = torch.randn(3, 8, 6)
        >>> out = frozen(x, frozen.prepare(mask), step=1, free=slice(None))
        >>> torch.allclose(out, network(x, mask, torch.full((1,), 0.5)), atol=1e-4)
        True
    """

    @torch.no_grad()
    def __init__(self, network: TemporalUNet, times: Sequence[float]):
        with torch.autocast("cpu", enabled=False):
            codes = _codes(network.time, times)
            self.encoder = FrozenEncoder(network.encoder, codes)
            self.middle, self.first, self.second = (
                [FrozenResidualBlock(cast(ResidualBlock, b), codes) for b in blocks]
                for blocks in (network.middle, network.first, network.second)
            )
        self.up = [FrozenUp(cast(nn.ConvTranspose1d, conv)) for conv in network.up]
        self.last, self.dtype = FrozenConvBlock(network.last, False), codes.dtype
        self.weight = network.head.weight.detach()[..., 0].T.contiguous()
        self.bias = cast(Tensor, network.head.bias).detach()
        self.numbers = _numbers(codes)
        self.compiled: Function | None = None

    def compile(self, options: Mapping[str, Any]) -> None:
        """Predictions are compiled with these options of :func:`torch.compile`."""
        self.compiled = torch.compile(self._predict, **options)

    def prepare(self, mask: Tensor) -> Tensor:
        """The mask's channel, steps first."""
        return mask.transpose(0, 1).to(self.dtype)

    def __call__(self, x: Tensor, prepared: Tensor, step: int, free: slice) -> Tensor:
        """As :meth:`~torchrl_rad.modules.frozen.StepNetwork.__call__`."""
        return (self.compiled or self._predict)(x, prepared, self.numbers[step])[:, free]

    def _predict(self, x: Tensor, prepared: Tensor, step: Tensor) -> Tensor:
        seen = self.encoder(_input(x, prepared), step)
        h = seen[-1]
        for block in self.middle:
            h = block(h, step)
        for first, second, up in zip(self.first, self.second, self.up, strict=True):
            h = up(second(first(torch.cat([h, seen.pop()], -1), step), step))
        h = as_steps(self.last(h))
        y = torch.addmm(self.bias, h.flatten(0, 1), self.weight)
        return y.view(*h.shape[:2], len(self.bias)).transpose(0, 1)


class FrozenReturnModel:
    """A :class:`NoisyReturnModel` at its present weights and some times, and its gradient.

    Args:
        model (NoisyReturnModel): copied; later changes of its weights do not show.
        times (sequence of float): of the process.

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> model = NoisyReturnModel(Normalizer.identity(2), 1, 8, width=8, multiples=(1, 2))
        >>> frozen, mask = FrozenReturnModel(model, [0.5]), torch.zeros(3, 8, 1, dtype=torch.bool)
        >>> frozen.gradient(torch.randn(3, 8, 3), mask, 0).shape
        torch.Size([3, 8, 3])
    """

    @torch.no_grad()
    def __init__(self, model: NoisyReturnModel, times: Sequence[float]):
        with torch.autocast("cpu", enabled=False):
            codes = _codes(model.time, times)
            self.encoder = FrozenEncoder(model.encoder, codes, gradients=True)
            mix, flat = model.mix.weight.detach(), model.mix.in_features - codes.shape[-1]
            self.time = torch.addmm(model.mix.bias, codes, mix[:, flat:].T)  # [K, W']
        self.entries = model.entries
        self.steps = model.horizon >> len(self.encoder.down)  # of the lowest resolution
        # channels change slower than steps there, and faster here
        mix = mix[:, :flat].view(len(mix), -1, self.steps).permute(2, 1, 0)
        self.mix = mix.reshape(flat, -1)
        head = cast(nn.Linear, model.head[1])
        self.weight, self.bias = head.weight.detach()[0], head.bias.detach()
        self.numbers = _numbers(codes)
        self.compiled: Function | None = None

    def compile(self, options: Mapping[str, Any]) -> None:
        """Gradients are compiled with these options of :func:`torch.compile`."""
        self.compiled = torch.compile(self._slope, **options)

    def _mixed(self, x: Tensor, mask: Tensor, step: Tensor, tape: list[Any] | None) -> Tensor:
        prepared = mask.transpose(0, 1).to(x.dtype)
        low = self.encoder(_input(x, prepared), step, tape)[-1]
        return torch.addmm(self.time.index_select(0, step), self._flat(low), self.mix)

    def _flat(self, low: Tensor) -> Tensor:
        """[4, T, B, C] to [B, L * C]."""
        return as_steps(low).transpose(0, 1).flatten(1)

    @torch.no_grad()
    def value(self, x: Tensor, mask: Tensor, step: int) -> Tensor:
        """Predicted return [B] of [B, H, D] in units of the deviation."""
        mixed = self._mixed(x, mask, self.numbers[step], None)
        return nn.functional.mish(mixed) @ self.weight + self.bias

    @torch.no_grad()
    def gradient(self, x: Tensor, mask: Tensor, step: int) -> Tensor:
        """Of that return with respect to ``x``."""
        return (self.compiled or self._slope)(x, mask, self.numbers[step])

    def _slope(self, x: Tensor, mask: Tensor, step: Tensor) -> Tensor:
        tape: list[Any] = []
        mixed = self._mixed(x, mask, step, tape)
        grad = (mish_slope(mixed) * self.weight) @ self.mix.T  # [B, L * C]
        grad = grad.view(len(x), self.steps, len(self.mix) // self.steps).transpose(0, 1)
        grad = self.encoder.gradient(as_phases(grad.contiguous()), tape)
        return as_steps(grad)[..., : self.entries].transpose(0, 1)
