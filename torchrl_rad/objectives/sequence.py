"""L_d and L_g for plans of states and actions (D-RAD)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.modules.diffuser import DiffuserPlanner
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.planner import PlanNetworks
from torchrl_rad.modules.process import Process
from torchrl_rad.objectives.common import (
    KeyedLoss,
    check_share,
    check_step,
    read_windows,
    window_masks,
)
from torchrl_rad.objectives.guidance import guidance_outputs, return_target
from torchrl_rad.parallel import draw_rows

__all__ = ["SequenceDenoisingLoss", "SequenceGuidanceLoss", "draw_pins"]


def draw_pins(
    count: int,
    horizon: int,
    no_target: float,
    device: torch.device,
    pseudo_step: int | None = None,
) -> Tensor:
    """Mask of the states that are known in a plan: the first one and a pseudo target.

    The target is i ~ U{1, ..., H - 1} steps away (RAD, section "Model Learning"), or in all plans
    ``pseudo_step``; a share of them has none.

    Returns:
        bool [count, H, 1].

    Examples:
        >>> draw_pins(1, 4, no_target=1.0, device=torch.device("cpu")).squeeze().tolist()
        [True, False, False, False]
    """
    step = draw_rows(lambda n: torch.randint(1, horizon, (n,), device=device), count)
    if pseudo_step is not None:
        step = torch.full_like(step, pseudo_step)
    pinned = draw_rows(lambda n: torch.rand(n, device=device), count) >= no_target
    places = torch.arange(horizon, device=device)  # [H]
    mask = (places == step[:, None]) & pinned[:, None]
    return (mask | (places == 0))[..., None]


class _Noisy(NamedTuple):
    """Windows as the networks are shown them: known states clean, all else noisy."""

    sample: Tensor  # [B, H, S + A]
    mask: Tensor  # bool [B, H, 1], states that are known
    entries: Tensor  # bool [B, H, S + A], entries that are known
    time: Tensor  # [B]


def _corrupt(
    process: Process, clean: Tensor, state_dim: int, no_target: float, pseudo_step: int | None
) -> _Noisy:
    count, horizon, width = clean.shape
    mask = draw_pins(count, horizon, no_target, clean.device, pseudo_step)
    of_states = torch.arange(width, device=clean.device) < state_dim
    entries = mask & of_states
    time = draw_rows(lambda n: torch.rand(n, device=clean.device), count)
    noise = draw_rows(lambda n: torch.randn(n, horizon, width, device=clean.device), count)
    noisy = process.corrupt(clean, noise, time[:, None, None])
    return _Noisy(torch.where(entries, clean, noisy), mask, entries, time)


class _SequenceLoss(KeyedLoss):
    """What both losses take from a planner, and how they read windows."""

    def __init__(
        self,
        planner: DiffuserPlanner,
        no_target: float,
        pseudo_step: int | None,
        reduction: str | None,
    ):
        super().__init__()
        check_share(no_target)
        check_step(pseudo_step, planner.horizon)
        self.pseudo_step = pseudo_step
        self.no_target = no_target if planner.targets else 1.0
        self.horizon, self.process = planner.horizon, planner.process
        self.state_dim, self.action_dim = len(planner.normalizer.mean), planner.action_dim
        self.reduction = "mean" if reduction is None else reduction

    def _windows(self, tensordict: TensorDictBase, normalizer: Normalizer):
        """States and actions [N, H, S + A] in raw units, [*B], masks, and what counts [*B]."""
        key = self.tensor_keys.action
        states = read_windows(normalizer, tensordict, self.tensor_keys.observation, self.horizon)
        actions = tensordict.get(key, None)
        if actions is None:
            raise KeyError(f"{key!r} is missing in the tensordict; plans hold actions too.")
        expected = (*states.shape[:-1], self.action_dim)
        if actions.shape != expected:
            raise ValueError(
                f"{key!r} is {tuple(actions.shape)}; expected {expected}, the actions of the states"
                " in these windows."
            )
        shape = states.shape[:-2]
        masks, counted = window_masks(self._loss_mask_keys(), tensordict, shape)
        windows = torch.cat([states, actions.to(states.dtype)], -1)
        if counted is not None:  # what is masked may be NaN, also in the backward pass
            windows = torch.where(counted[..., None, None], windows, 0.0)
        return windows.reshape(-1, *windows.shape[-2:]), shape, masks, counted


class SequenceDenoisingLoss(_SequenceLoss):
    r"""Generation loss with pseudo targets for a planner of states and actions.

    It is L_d of RAD, equation "loss:difusion", for D-RAD. Of each window of H steps the first state
    is known, and the state i ~ U{1, ..., H - 1} steps later is the pseudo target; a share of the
    windows has none, so that rows without a target can be planned by the same network. Known states
    are shown clean and do not enter the loss:

    .. math:: L_d = E \| w \odot (1 - m) \odot (\phi_\theta(\hat\tau^k, m, k) - \tau^0) \|^2

    with m the mask of the known ones and w the weight of the first action, which is the one that is
    carried out. Times k are drawn from all between data and noise, not from K levels alone, so that
    the number of steps can be chosen when planning.

    Args:
        planner (DiffuserPlanner): whose network is trained.

    Keyword Args:
        no_target (float, optional): share of windows without a target; a planner with
            ``targets=False`` has none at all. Defaults to ``0.2``.
        pseudo_step (int, optional): the same step for every pseudo target, for the ablation -PTS.
            Defaults to a random one.
        action_weight (float, optional): weight of the first action. Defaults to ``10.0``
            (Diffuser's).
        delay (bool, optional): keep target parameters, for :class:`torchrl.objectives.SoftUpdate`.
            Defaults to ``False``.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"`` over windows. Defaults to
            ``"mean"``.

    .. note:: The tensordict passed to :meth:`forward` must contain ``self.tensor_keys.observation``
        [*B, H, S] and ``action`` [*B, H, A] in raw units. Masks (``("collector", "mask")``, ...)
        may be [*B] or [*B, H]: a window counts if all its steps do.

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> planner = DiffuserPlanner(Normalizer.identity(2), action_dim=1, horizon=8, width=8)
        >>> loss = SequenceDenoisingLoss(planner)
        >>> windows = {"observation": torch.randn(6, 8, 2), "action": torch.randn(6, 8, 1)}
        >>> sorted(loss(TensorDict(windows, [6])).keys())
        ['action_error', 'loss_denoising', 'state_error']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``.

        Attributes:
            observation (NestedKey): windows of states. Defaults to ``"observation"``.
            action (NestedKey): their actions. Defaults to ``"action"``.
        """

        observation: NestedKey = "observation"
        action: NestedKey = "action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_denoising", "state_error", "action_error"]
    network: PlanNetworks
    network_params: TensorDictParams
    target_network_params: TensorDictParams

    def __init__(
        self,
        planner: DiffuserPlanner,
        *,
        no_target: float = 0.2,
        pseudo_step: int | None = None,
        action_weight: float = 10.0,
        delay: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__(planner, no_target, pseudo_step, reduction)
        self.convert_to_functional(planner.networks, "network", create_target_params=delay)
        self.planner_normalizer = planner.normalizer
        self.action_weight = action_weight

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows, and mean squared errors of states and actions, normalised."""
        windows, shape, masks, _ = self._windows(tensordict, self.planner_normalizer)
        states, actions = windows.split([self.state_dim, self.action_dim], -1)
        clean = torch.cat([self.planner_normalizer(states), actions], -1)
        shown = _corrupt(self.process, clean, self.state_dim, self.no_target, self.pseudo_step)
        with self.network_params.to_module(self.network):
            predicted = self.network(0, shown.sample, shown.mask, shown.time).to(clean.dtype)
        error = (predicted - clean).square().masked_fill(shown.entries, 0.0)
        of_states, of_actions = error.split([self.state_dim, self.action_dim], -1)
        total = error.sum((-2, -1)) + (self.action_weight - 1) * of_actions[:, 0].sum(-1)
        values = {
            "loss_denoising": total / error[0].numel(),
            "state_error": of_states.mean((-2, -1)).detach(),
            "action_error": of_actions.mean((-2, -1)).detach(),
        }
        reductions = (self.reduction, "mean", "mean")
        out = TensorDict(
            {
                key: self._reduce_loss(value.reshape(shape), masks, reduction=reduction)
                for (key, value), reduction in zip(values.items(), reductions, strict=True)
            }
        )
        self._clear_weakrefs(tensordict, out, "network_params", "target_network_params")
        return out


class SequenceGuidanceLoss(_SequenceLoss):
    r"""Mean squared error of the return model on noisy windows.

    It is L_g of RAD, equation "loss:g", for D-RAD: J is shown what it will guide, a plan at step k
    with known states (drawn as for :class:`SequenceDenoisingLoss`), since the gradient is taken
    there.

    .. math:: L_g = E (J_\phi(\hat\tau^k, m, k) - C(\tau))^2

    in units of the model's deviation; C is :func:`plan_return`.

    Args:
        planner (DiffuserPlanner): whose return model is trained.

    Keyword Args:
        gamma (float, optional): discount. Defaults to ``0.99``.
        no_target (float, optional): share of windows without a target; a planner with
            ``targets=False`` has none at all. Defaults to ``0.2``.
        pseudo_step (int, optional): the same step for every pseudo target, for the ablation -PTS.
            Defaults to a random one.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"`` over windows. Defaults to
            ``"mean"``.

    .. note:: The tensordict passed to :meth:`forward` must contain ``self.tensor_keys.observation``
        [*B, H, S], ``action`` [*B, H, A], ``reward`` [*B, H, 1] and ``value`` [*B, H, 1] or [*B,
        H], whose last entry is V(s_{H-1}): the recorded return-to-go, or a learned value.

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> states = Normalizer.identity(2)
        >>> model = NoisyReturnModel(states, action_dim=1, horizon=8, width=8)
        >>> planner = DiffuserPlanner(states, 1, horizon=8, width=8, return_model=model)
        >>> windows = TensorDict({"observation": torch.randn(6, 8, 2),
        ...     "action": torch.randn(6, 8, 1), "next": {"reward": torch.zeros(6, 8, 1)},
        ...     "return_to_go": torch.zeros(6, 8)}, [6])
        >>> sorted(SequenceGuidanceLoss(planner)(windows).keys())
        ['loss_guidance', 'return_error']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``.

        Attributes:
            observation (NestedKey): windows of states. Defaults to ``"observation"``.
            action (NestedKey): their actions. Defaults to ``"action"``.
            reward (NestedKey): their rewards. Defaults to ``("next", "reward")``.
            value (NestedKey): values of the states. Defaults to ``"return_to_go"``.
        """

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        reward: NestedKey = ("next", "reward")
        value: NestedKey = "return_to_go"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_guidance", "return_error"]
    return_model: NoisyReturnModel
    return_model_params: TensorDictParams
    target_return_model_params: TensorDictParams

    def __init__(
        self,
        planner: DiffuserPlanner,
        *,
        gamma: float = 0.99,
        no_target: float = 0.2,
        pseudo_step: int | None = None,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__(planner, no_target, pseudo_step, reduction)
        if planner.return_model is None:
            raise ValueError("this planner has no return model to train; build it with one.")
        self.convert_to_functional(planner.return_model, "return_model")
        self.gamma = gamma

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows, and the mean absolute error in units of return."""
        with self.return_model_params.to_module(self.return_model):
            normalizer = self.return_model.normalizer
            windows, shape, masks, counted = self._windows(tensordict, normalizer)
            clean = self.return_model.normalised(windows)
        target = return_target(
            tensordict, self.tensor_keys, (*shape, self.horizon), self.gamma, counted
        )
        shown = _corrupt(self.process, clean, self.state_dim, self.no_target, self.pseudo_step)
        with self.return_model_params.to_module(self.return_model):
            predicted = self.return_model.standardised(shown.sample, shown.mask, shown.time)
            predicted = predicted.reshape(shape)
            out = guidance_outputs(self, self.return_model, predicted, target, masks)
        self._clear_weakrefs(tensordict, out, "return_model_params")
        return out
