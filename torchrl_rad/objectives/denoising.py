"""L_d: training a planner to in-paint towards pseudo targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.levels import change_of, encode_states
from torchrl_rad.modules.planner import PlanNetworks
from torchrl_rad.objectives.common import (
    KeyedLoss,
    check_share,
    check_step,
    read_windows,
    window_masks,
)
from torchrl_rad.parallel import draw_rows

__all__ = ["DenoisingLoss"]


class DenoisingLoss(KeyedLoss):
    r"""Generation loss with pseudo targets, for every level of a planner.

    It is L_d of RAD, equation "loss:difusion".

    Each window of H states gives each level a random piece of its span. A step i, uniform over the
    span, chooses the pseudo target, which the planner's own placement puts on the grid; a share of
    the pieces has none, so that rows without a target can be planned by the same network. Known
    states (the first; the last on finer levels; the target) are shown clean and do not enter the
    loss:

    .. math:: L_d = E \| w \odot (1 - m) \odot (\phi_\theta(\hat\tau^k, m, k) - y) \|^2

    with y the velocity (flow) or the clean states (diffusion), m the mask of the known ones and w
    the weight of the state after the current one, which is what a plan is used for.

    Args:
        planner (DiffuserLitePlanner): whose networks are trained.

    Keyword Args:
        no_target (float, optional): share of pieces without a target; a planner with
            ``targets=False`` has none at all. Defaults to ``0.2``.
        pseudo_step (int, optional): the same step for every pseudo target, for the ablation -PTS.
            Defaults to a random one.
        next_weight (float, optional): weight of grid point 1. Defaults to ``10.0``
            (DiffuserLite's).
        only (sequence of int, optional): levels to train, if not all.
        delay (bool, optional): keep target parameters, for :class:`torchrl.objectives.SoftUpdate`.
            Defaults to ``False``.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"`` over windows. Defaults to
            ``"mean"``.

    .. note:: The tensordict passed to :meth:`forward` must contain
        ``self.tensor_keys.observation``, windows [*B, H, S] of raw states, and for a planner that
        is told returns ``value`` [*B, H] or [*B, H, 1]. Masks (``("collector",
        "mask")``, ...) may be [*B] or [*B, H]: a window counts if all its steps do.

    Examples:
        >>> from torchrl_rad import InverseDynamics, Normalizer
        >>> states = Normalizer.identity(2)
        >>> inverse = InverseDynamics(states, states, 1)
        >>> planner = DiffuserLitePlanner(states, inverse, horizon=9, jumps=(4, 1), width=32)
        >>> loss = DenoisingLoss(planner)
        >>> out = loss(TensorDict({"observation": torch.randn(6, 9, 2)}, [6]))
        >>> out["loss_denoising"].shape, sorted(out.keys())
        (torch.Size([]), ['level_0', 'level_1', 'loss_denoising'])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``.

        Attributes:
            observation (NestedKey): windows of states. Defaults to ``"observation"``.
            value (NestedKey): return from each of them on, read where the planner is told returns.
                Defaults to ``"return_to_go"``.
        """

        observation: NestedKey = "observation"
        value: NestedKey = "return_to_go"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    network: PlanNetworks
    network_params: TensorDictParams
    target_network_params: TensorDictParams

    def __init__(
        self,
        planner: DiffuserLitePlanner,
        *,
        no_target: float = 0.2,
        pseudo_step: int | None = None,
        next_weight: float = 10.0,
        only: Sequence[int] | None = None,
        delay: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__()
        check_share(no_target)
        check_step(pseudo_step, planner.horizon)
        self.convert_to_functional(planner.networks, "network", create_target_params=delay)
        self.planner_normalizer, self.planner_changes = planner.normalizer, planner.changes
        self.planner_condition = planner.condition
        self._unread = ("value",) if planner.condition is None else ()
        self.levels, self.horizon = planner.levels, planner.horizon
        self.process, self.placement = planner.process, planner.placement
        self.numbers = list(range(len(self.levels)) if only is None else only)
        if not self.numbers or not set(self.numbers) <= set(range(len(self.levels))):
            raise ValueError(
                f"only is {self.numbers}; these plans have levels 0 to {len(self.levels) - 1}."
            )
        self._out_keys = ["loss_denoising", *(f"level_{n}" for n in self.numbers)]
        self.partial = len(self.numbers) < len(self.levels)  # some weights get no gradient
        self.no_target = no_target if planner.targets else 1.0
        self.pseudo_step, self.next_weight = pseudo_step, next_weight
        self.reduction = "mean" if reduction is None else reduction

    @property
    def out_keys(self) -> list[str]:
        return self._out_keys

    @out_keys.setter
    def out_keys(self, value: list[str]) -> None:
        self._out_keys = value

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows, and the mean of each level."""
        windows = read_windows(
            self.planner_normalizer, tensordict, self.tensor_keys.observation, self.horizon
        )
        shape = windows.shape[:-2]
        masks, counted = window_masks(self._loss_mask_keys(), tensordict, shape)
        if counted is not None:  # what is masked may be NaN, also in the backward pass
            windows = torch.where(counted[..., None, None], windows, 0.0)
        windows = windows.reshape(-1, *windows.shape[-2:])
        values = self._values(tensordict, shape, counted)
        with self.network_params.to_module(self.network):
            losses = [
                self._level(number, windows, values).reshape(shape) for number in self.numbers
            ]
        out = {"loss_denoising": self._reduce_loss(torch.stack(losses).sum(0), masks)}
        for number, value in zip(self.numbers, losses, strict=True):
            out[f"level_{number}"] = self._reduce_loss(value.detach(), masks, reduction="mean")
        out = TensorDict(out)
        self._clear_weakrefs(tensordict, out, "network_params", "target_network_params")
        return out

    def _values(
        self, tensordict: TensorDictBase, shape: torch.Size, counted: Tensor | None
    ) -> Tensor | None:
        """Returns [B, H] from each state of the windows on, if the networks are told any."""
        if self.planner_condition is None:
            return None
        key = self.tensor_keys.value
        values = tensordict.get(key, None)
        if values is None:
            raise KeyError(f"{key!r} is missing in the tensordict; this planner is told returns.")
        values = values.reshape(*shape, self.horizon)
        if counted is not None:
            values = torch.where(counted[..., None], values, 0.0)
        return values.reshape(-1, self.horizon)

    def _level(self, number: int, windows: Tensor, values: Tensor | None) -> Tensor:
        """Loss of each window [B] on one level."""
        clean, mask, begin = self.pieces(number, windows)
        told = {}
        if values is not None:
            assert self.planner_condition is not None
            told["condition"] = self.planner_condition(values.gather(1, begin[:, None])[:, 0])
        change = change_of(self.planner_changes, number)
        clean = encode_states(clean, self.planner_normalizer, change)
        device, shape = clean.device, clean.shape[1:]
        time = draw_rows(lambda rows: torch.rand(rows, device=device), len(clean))
        noise = draw_rows(lambda rows: torch.randn(rows, *shape, device=device), len(clean))
        noisy = torch.where(mask, clean, self.process.corrupt(clean, noise, time[:, None, None]))
        free = self.levels[number].free(number)  # the others count for nothing
        predicted = self.network(number, noisy, mask, time, free=free, **told).to(clean.dtype)
        error = predicted - self.process.target(clean, noise)[:, free]
        error = error.square().masked_fill(mask[:, free], 0.0)
        total = error.sum((-2, -1)) + (self.next_weight - 1) * error[:, 0].sum(-1)
        return total / clean[0].numel()

    def pieces(self, number: int, windows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A random piece of each window on one level's grid, with the pseudo target in it.

        Args:
            number (int): the level.
            windows (Tensor): [B, H, S], raw units.

        Returns:
            States [B, n, S], raw units; the mask of the known ones, bool [B, n, 1]; and where in
            its window each piece begins, int64 [B].
        """
        level, count, device = self.levels[number], len(windows), windows.device
        rows = torch.arange(count, device=device)
        places, span = self.horizon - level.span, level.span
        begin = draw_rows(lambda n: torch.randint(places, (n,), device=device), count)
        grid = begin[:, None] + torch.arange(level.tokens, device=device) * level.jump  # [B, n]
        clean = windows[rows[:, None], grid]
        mask = torch.zeros(count, level.tokens, dtype=torch.bool, device=device)
        mask[:, 0] = True
        mask[:, -1] = number > 0
        step = draw_rows(lambda n: torch.randint(1, span + 1, (n,), device=device), count)
        if self.pseudo_step is not None:  # on levels that do not reach so far, at their end
            step = torch.full_like(step, min(self.pseudo_step, level.span))
        place = self.placement(step, number, *level)
        chance = draw_rows(lambda n: torch.rand(n, device=device), count)
        pinned = place.active & (chance >= self.no_target)
        # a shifted placement pins the window's own state; others move that at `step` to the grid
        moved = windows[rows, begin + place.time]
        here = torch.arange(level.tokens, device=device) == place.token[:, None]
        here &= pinned[:, None]
        clean = torch.where(here[..., None], moved[:, None], clean)
        return clean, (mask | here)[..., None], begin
