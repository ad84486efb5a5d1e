"""L_d and L_g of a planner of states and actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.modules.diffuser import DiffuserPlanner
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel
from torchrl_rad.objectives.common import KeyedLoss, window_masks
from torchrl_rad.objectives.denoising import DenoisingLoss
from torchrl_rad.objectives.guidance import plan_return

__all__ = ["NoisyReturnLoss", "TrajectoryLoss", "actions_of"]


def actions_of(
    tensordict: TensorDictBase, key: NestedKey, shape: torch.Size, horizon: int
) -> Tensor:
    """Actions [B, H, A] beside windows [*B, H, S].

    Raises:
        KeyError: there are none.
        ValueError: they are of another number of windows or steps.
    """
    action = tensordict.get(key, None)
    if action is None:
        raise KeyError(f"{key!r} is missing in the tensordict; a loss of trajectories reads it.")
    if action.shape[:-1] != (*shape, horizon):
        raise ValueError(
            f"{key!r} is {tuple(action.shape)}; expected [*B, H, A] = {(*shape, horizon, 'A')}, as "
            "the windows of states are."
        )
    return action.reshape(-1, *action.shape[-2:])


class TrajectoryLoss(DenoisingLoss):
    r"""Generation loss with pseudo targets of :class:`~torchrl_rad.modules.DiffuserPlanner`.

    It is L_d of RAD, equation "loss:difusion", over states and actions: each window of H steps is
    shown with noise, its first state and the state of a random later step without. Known entries do
    not enter the loss; the first action, which is what a plan is used for, counts more.

    Args:
        planner (DiffuserPlanner): whose network is trained.

    Keyword Args:
        no_target, pseudo_step, delay, reduction (optional): as of :class:`DenoisingLoss`.
        action_weight (float, optional): of the first action. Defaults to ``10.0`` (Diffuser's).

    .. note:: The tensordict passed to :meth:`forward` must contain
        ``self.tensor_keys.observation`` [*B, H, S] and ``action`` [*B, H, A], raw units.

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> planner = DiffuserPlanner(Normalizer.identity(2), 1, horizon=8, width=8)
        >>> windows = {"observation": torch.randn(6, 8, 2), "action": torch.randn(6, 8, 1)}
        >>> TrajectoryLoss(planner)(TensorDict(windows, [6]))["loss_denoising"].shape
        torch.Size([])
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

    tensor_keys: _AcceptedKeys  # type: ignore[assignment]
    default_keys = _AcceptedKeys  # type: ignore[assignment]

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
        super().__init__(
            planner,
            no_target=no_target,
            pseudo_step=pseudo_step,
            next_weight=action_weight,
            delay=delay,
            reduction=reduction,
        )

    def _read(self, tensordict: TensorDictBase) -> tuple[Tensor, TensorDict, torch.Size]:
        windows, masks, shape = super()._read(tensordict)
        action = actions_of(tensordict, self.tensor_keys.action, shape, self.horizon)
        _, counted = window_masks(self._loss_mask_keys(), tensordict, shape)
        if counted is not None:
            action = torch.where(counted.reshape(-1, 1, 1), action, 0.0)
        return torch.cat([windows, action.to(windows)], -1), masks, shape

    def _level(self, number: int, windows: Tensor) -> Tensor:
        """Loss of each window [B]."""
        clean, known = self.pieces(number, windows)  # [B, H, S + A], bool [B, H, 1]
        states = len(self.planner_normalizer.mean)
        of_actions = torch.zeros_like(clean[..., states:], dtype=torch.bool)
        mask = torch.cat([known.expand(*known.shape[:2], states), of_actions], -1)
        time = torch.rand(len(clean), device=clean.device)
        noise = torch.randn_like(clean)
        noisy = torch.where(mask, clean, self.process.corrupt(clean, noise, time[:, None, None]))
        predicted = self.network(number, noisy, known, time).to(clean.dtype)
        error = (predicted - self.process.target(clean, noise)).square().masked_fill(mask, 0.0)
        first = error[:, 0, states:].sum(-1)
        return (error.sum((-2, -1)) + (self.next_weight - 1) * first) / clean[0].numel()


class NoisyReturnLoss(KeyedLoss):
    r"""Mean squared error of a return model that sees noisy plans (L_g of RAD, "loss:g").

    .. math:: L_g = E (J_\phi(\hat\tau^k, k) - C(\tau))^2

    in units of the model's deviation. What is known is shown to it as to the planner.

    Args:
        planner (DiffuserPlanner): whose return model is trained.

    Keyword Args:
        gamma (float, optional): discount. Defaults to ``0.99``.
        no_target (float, optional): share of windows without a target. Defaults to ``0.2``.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"`` over windows. Defaults to
            ``"mean"``.

    .. note:: The tensordict passed to :meth:`forward` must contain ``self.tensor_keys.observation``
        [*B, H, S], ``action`` [*B, H, A], ``reward`` [*B, H, 1] and ``value`` [*B, H, 1] or
        [*B, H], whose last entry is V(s_{H-1}).

    Raises:
        ValueError: the planner has no return model.

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> states = Normalizer.identity(2)
        >>> model = NoisyReturnModel(states, action_dim=1, horizon=8, width=8)
        >>> planner = DiffuserPlanner(states, 1, horizon=8, width=8, return_model=model)
        >>> windows = TensorDict({"observation": torch.zeros(5, 8, 2),
        ...     "action": torch.zeros(5, 8, 1), "next": {"reward": torch.zeros(5, 8, 1)},
        ...     "return_to_go": torch.zeros(5, 8)}, [5])
        >>> NoisyReturnLoss(planner)(windows)["loss_guidance"].shape
        torch.Size([])
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
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__()
        if planner.return_model is None:
            raise ValueError("the planner has no return model; build it with one.")
        if not 0.0 <= no_target <= 1.0:
            raise ValueError(f"no_target is {no_target}; expected a share in [0, 1].")
        self.convert_to_functional(planner.return_model, "return_model")
        self.process, self.horizon, self.gamma = planner.process, planner.horizon, gamma
        self.no_target = no_target if planner.targets else 1.0
        self.reduction = "mean" if reduction is None else reduction

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows, and the mean absolute error in units of return."""
        keys = self.tensor_keys
        with self.return_model_params.to_module(self.return_model):
            states = self.return_model.normalizer.read(tensordict, keys.observation)
        if states.ndim < 2 or states.shape[-2] != self.horizon:
            raise ValueError(
                f"{keys.observation!r} is {tuple(states.shape)}; expected windows "
                f"[*B, {self.horizon}, S], the horizon that the planner was built for."
            )
        shape, width = states.shape[:-2], states.shape[-1]
        plans = torch.cat(
            [
                states.reshape(-1, self.horizon, width),
                actions_of(tensordict, keys.action, shape, self.horizon).to(states),
            ],
            -1,
        )
        reward = tensordict[keys.reward].reshape(*shape, self.horizon)
        value = tensordict[keys.value].reshape(*shape, self.horizon)[..., -1]
        target = plan_return(reward, value, self.gamma).reshape(-1)
        masks, counted = window_masks(self._loss_mask_keys(), tensordict, shape)
        if counted is not None:  # what is masked may be NaN, also in the backward pass
            plans = torch.where(counted.reshape(-1, 1, 1), plans, 0.0)
            target = torch.where(counted.reshape(-1), target, 0.0)
        with self.return_model_params.to_module(self.return_model):
            error, unit = self._errors(plans, width, target)
        error, absolute = error.reshape(shape), (error * unit).abs().detach().reshape(shape)
        out = TensorDict(
            {
                "loss_guidance": self._reduce_loss(error.square(), masks),
                "return_error": self._reduce_loss(absolute, masks, reduction="mean"),
            }
        )
        self._clear_weakrefs(tensordict, out, "return_model_params")
        return out

    def _errors(self, plans: Tensor, width: int, target: Tensor) -> tuple[Tensor, Tensor]:
        """Error of each window [B] in units of the deviation, which comes with it."""
        clean = self.return_model.normalised(plans)
        count, device = len(clean), clean.device
        known = torch.zeros(count, self.horizon, 1, dtype=torch.bool, device=device)
        known[:, 0] = True
        step = torch.randint(1, self.horizon, (count,), device=device)
        pinned = torch.rand(count, device=device) >= self.no_target
        known[torch.arange(count, device=device), step] |= pinned[:, None]
        time = torch.rand(count, device=device)
        noisy = self.process.corrupt(clean, torch.randn_like(clean), time[:, None, None])
        states = torch.where(known, clean[..., :width], noisy[..., :width])
        shown = torch.cat([states, noisy[..., width:]], -1)
        predicted = self.return_model.standardised(shown, known, time)
        unit = self.return_model.deviation
        return predicted - (target - self.return_model.mean) / unit, unit
