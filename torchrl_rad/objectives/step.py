"""L_e: training the step estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.modules.step import StepEstimator
from torchrl_rad.objectives.common import KeyedLoss, window_masks
from torchrl_rad.parallel import draw_rows

__all__ = ["StepEstimationLoss", "draw_step_pairs"]


def draw_step_pairs(
    windows: Tensor,
    generator: torch.Generator | None = None,
    *,
    horizon: int | None = None,
    pairs: int = 1,
) -> TensorDict:
    """Pairs (s_t, s_{t+i}) from windows: i uniform in 1..H-1, t in what room is left.

    A window lies inside one episode, and so does a pair.

    Args:
        windows (Tensor): [B, W, S].
        generator (torch.Generator, optional): source of randomness.

    Keyword Args:
        horizon (int, optional): H of the step estimator. Defaults to W.
        pairs (int, optional): from each window. Defaults to ``1``.

    Returns:
        TensorDict [B * pairs] with ``observation``, ``target`` [B * pairs, S] and ``target_step``
        [B * pairs, 1] int64.

    Raises:
        ValueError: the windows are shorter than ``horizon``, or no pairs are asked for.

    Examples:
        >>> windows = torch.arange(9.0)[None, :, None].expand(4, 9, 1)
        >>> pairs = draw_step_pairs(windows)
        >>> bool((pairs["target"] - pairs["observation"] == pairs["target_step"]).all())
        True
    """
    length, device = windows.shape[1], windows.device
    if horizon is None:
        horizon = length
    if pairs < 1:
        raise ValueError(f"pairs is {pairs}; expected one or more from each window.")
    if length < horizon:
        raise ValueError(
            f"windows of {length} states hold no pairs up to {horizon - 1} steps apart; draw "
            f"windows of {horizon} states or more."
        )
    rows = torch.arange(len(windows), device=device).repeat_interleave(pairs)

    def steps(count: int) -> Tensor:
        return torch.randint(1, horizon, (count,), generator=generator, device=device)

    def places(count: int) -> Tensor:
        return torch.rand(count, generator=generator, device=device)

    step = draw_rows(steps, len(rows))
    begin = (draw_rows(places, len(rows)) * (length - step).float()).long()
    state, target = windows[rows, begin], windows[rows, begin + step]
    drawn = {"observation": state, "target": target, "target_step": step[:, None]}
    return TensorDict(drawn, rows.shape)


class StepEstimationLoss(KeyedLoss):
    r"""Cross entropy of the step estimator (L_e of RAD, equation "loss:e").

    .. math:: L_e = -E \log e[i]

    with softmax over the classes. The paper prints a sigmoid and this loss; nothing then pushes the
    other classes down, so ``activation="sigmoid"`` of the estimator is trained one class against
    the rest.

    Args:
        estimator (StepEstimator): f_e.

    Keyword Args:
        reduction (str, optional): ``"none"``, ``"mean"`` or ``"sum"``. Defaults to ``"mean"``.

    .. note:: The tensordict passed to :meth:`forward` must contain ``self.tensor_keys.observation``
        and ``target`` [*B, S] and ``target_step`` [*B, 1] int64, the true number of steps, 1 to H -
        1 (see :func:`draw_step_pairs`).

    Examples:
        >>> from torchrl_rad import Normalizer
        >>> loss = StepEstimationLoss(StepEstimator(Normalizer.identity(2), horizon=9))
        >>> out = loss(draw_step_pairs(torch.randn(5, 9, 2)))
        >>> sorted(out.keys())
        ['loss_step', 'step_error']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``.

        Attributes:
            observation (NestedKey): state. Defaults to ``"observation"``.
            target (NestedKey): later state of the same episode. Defaults to ``"target"``.
            target_step (NestedKey): steps between them. Defaults to ``"target_step"``.
        """

        observation: NestedKey = "observation"
        target: NestedKey = "target"
        target_step: NestedKey = "target_step"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_step", "step_error"]
    estimator: StepEstimator
    estimator_params: TensorDictParams
    target_estimator_params: TensorDictParams

    def __init__(
        self, estimator: StepEstimator, *, reduction: Literal["none", "mean", "sum"] | None = None
    ):
        super().__init__()
        self.convert_to_functional(estimator, "estimator")
        self.reduction = "mean" if reduction is None else reduction

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of a batch of pairs, and the mean absolute error in steps."""
        with self.estimator_params.to_module(self.estimator):
            state = self.estimator.normalizer.read(tensordict, self.tensor_keys.observation)
            target = self.estimator.normalizer.read(tensordict, self.tensor_keys.target)
        shape = state.shape[:-1]
        step = tensordict[self.tensor_keys.target_step].reshape(*shape, 1)
        masks, counted = window_masks(self._loss_mask_keys(), tensordict, shape)
        if counted is not None:  # what is masked may be NaN, also in the backward pass
            state = torch.where(counted[..., None], state, 0.0)
            target = torch.where(counted[..., None], target, 0.0)
        with self.estimator_params.to_module(self.estimator):
            logits = self.estimator.logits(state, target)
            error = (self.estimator._steps(logits.detach()) - step).abs().float().squeeze(-1)
        out = TensorDict(
            {
                "loss_step": self._reduce_loss(self._entropy(logits, step.squeeze(-1) - 1), masks),
                "step_error": self._reduce_loss(error, masks, reduction="mean"),
            }
        )
        self._clear_weakrefs(tensordict, out, "estimator_params")
        return out

    def _entropy(self, logits: Tensor, label: Tensor) -> Tensor:
        """Loss of each pair [*B]; ``label`` counts from 0."""
        label = label.clamp(0, logits.shape[-1] - 1)
        if self.estimator.activation == "softmax":
            scores = logits.reshape(-1, logits.shape[-1])
            loss = F.cross_entropy(scores, label.flatten(), reduction="none")
            return loss.reshape(label.shape)
        one_hot = F.one_hot(label, logits.shape[-1]).to(logits.dtype)
        return F.binary_cross_entropy_with_logits(logits, one_hot, reduction="none").sum(-1)
