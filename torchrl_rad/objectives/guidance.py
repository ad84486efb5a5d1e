"""L_g: training the return model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.modules.return_model import ReturnModel, ReturnScale
from torchrl_rad.objectives.common import KeyedLoss, window_masks

__all__ = ["ReturnGuidanceLoss", "guidance_outputs", "plan_return", "return_target"]


def plan_return(reward: Tensor, value: Tensor, gamma: float) -> Tensor:
    r"""Return of a window of H steps, continued by a value (C of RAD, section "Model Learning").

    .. math:: C(\tau) = \sum_{t=0}^{H-2} \gamma^t r_t + \gamma^{H-1} V(s_{H-1})

    Args:
        reward (Tensor): [*B, H].
        value (Tensor): [*B], of the last state.
        gamma (float): discount.

    Returns:
        [*B].

    Examples:
        >>> plan_return(torch.tensor([[1.0, 1.0, 9.0]]), torch.tensor([8.0]), 0.5)
        tensor([3.5000])
    """
    length = reward.shape[-1]
    discount = gamma ** torch.arange(length, device=reward.device, dtype=torch.float32)
    return (reward[..., :-1] * discount[:-1]).sum(-1) + discount[-1] * value


def return_target(
    tensordict: TensorDictBase,
    keys: Any,
    shape: Sequence[int],
    gamma: float,
    counted: Tensor | None,
) -> Tensor:
    """C(tau) [*B] of windows of which not all count; the others' is 0.

    Args:
        tensordict (TensorDictBase): a loss's input.
        keys: the loss's ``tensor_keys``, with ``reward`` and ``value``.
        shape (sequence of int): [*B, H].
        gamma (float): discount.
        counted (Tensor, optional): bool [*B]. What is masked may be NaN.
    """
    reward, value = (tensordict[key].reshape(*shape) for key in (keys.reward, keys.value))
    target = plan_return(reward, value[..., -1], gamma)
    return target if counted is None else torch.where(counted, target, 0.0)


def guidance_outputs(
    loss: KeyedLoss, model: ReturnScale, predicted: Tensor, target: Tensor, masks: TensorDict
) -> TensorDict:
    """``loss_guidance`` and ``return_error`` of what ``model`` predicts, which is in its units."""
    error = predicted - (target - model.mean) / model.deviation
    error_in_returns = (error * model.deviation).abs().detach()
    return TensorDict(
        {
            "loss_guidance": loss._reduce_loss(error.square(), masks),
            "return_error": loss._reduce_loss(error_in_returns, masks, reduction="mean"),
        }
    )


class ReturnGuidanceLoss(KeyedLoss):
    r"""Mean squared error of the return model (L_g of RAD, equation "loss:g").

    .. math:: L_g = E (J_\phi(\tau) - C(\tau))^2

    in units of the model's deviation.

    Args:
        return_model (ReturnModel): J.

    Keyword Args:
        jump (int): step of the grid on which J sees a window: the planner's first jump.
        gamma (float, optional): discount. Defaults to ``0.99``.
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"`` over windows. Defaults to
            ``"mean"``.

    .. note:: The tensordict passed to :meth:`forward` must contain ``self.tensor_keys.observation``
        [*B, H, S], ``reward`` [*B, H, 1] and ``value`` [*B, H, 1] or [*B, H], whose last entry is
        V(s_{H-1}): the recorded return-to-go, or a learned value.

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> loss = ReturnGuidanceLoss(ReturnModel(Normalizer.identity(2), tokens=3), jump=4)
        >>> windows = TensorDict({"observation": torch.zeros(5, 9, 2),
        ...     "next": {"reward": torch.zeros(5, 9, 1)}, "return_to_go": torch.zeros(5, 9)}, [5])
        >>> loss(windows)["loss_guidance"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``.

        Attributes:
            observation (NestedKey): windows of states. Defaults to ``"observation"``.
            reward (NestedKey): their rewards. Defaults to ``("next", "reward")``.
            value (NestedKey): values of the states. Defaults to ``"return_to_go"``.
        """

        observation: NestedKey = "observation"
        reward: NestedKey = ("next", "reward")
        value: NestedKey = "return_to_go"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_guidance", "return_error"]
    return_model: ReturnModel
    return_model_params: TensorDictParams
    target_return_model_params: TensorDictParams

    def __init__(
        self,
        return_model: ReturnModel,
        *,
        jump: int,
        gamma: float = 0.99,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ):
        super().__init__()
        if jump < 1:
            raise ValueError(f"jump is {jump}; expected 1 or more.")
        self.convert_to_functional(return_model, "return_model")
        self.jump, self.gamma = jump, gamma
        self.reduction = "mean" if reduction is None else reduction

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of windows, and the mean absolute error in units of return."""
        horizon = self.jump * (self.return_model.tokens - 1) + 1
        with self.return_model_params.to_module(self.return_model):
            states = self.return_model.normalizer.read(tensordict, self.tensor_keys.observation)
        if states.ndim < 2 or states.shape[-2] != horizon:
            raise ValueError(
                f"{self.tensor_keys.observation!r} is {tuple(states.shape)}; expected windows "
                f"[*B, {horizon}, S]: {self.return_model.tokens} states, {self.jump} steps apart."
            )
        shape = states.shape[:-2]
        masks, counted = window_masks(self._loss_mask_keys(), tensordict, shape)
        target = return_target(tensordict, self.tensor_keys, (*shape, horizon), self.gamma, counted)
        if counted is not None:  # what is masked may be NaN, also in the backward pass
            states = torch.where(counted[..., None, None], states, 0.0)
        with self.return_model_params.to_module(self.return_model):
            predicted = self.return_model.standardised(states[..., :: self.jump, :])
            out = guidance_outputs(self, self.return_model, predicted, target, masks)
        self._clear_weakrefs(tensordict, out, "return_model_params")
        return out
