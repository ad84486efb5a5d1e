"""SE: how many steps away a target is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_rad.modules.normalizer import Normalizer

__all__ = ["StepEstimator"]

ESTIMATES = ("mode", "median", "mean", "recorded", "random")


class StepEstimator(TensorDictModuleBase):
    """Estimates the steps from a state to a target, 1 to H - 1.

    It is f_e of RAD, section "Step Estimation Model".

    An MLP on both states, standardised, with H - 1 classes; class c means c + 1 steps.
    ``estimate="recorded"`` needs no network: it hands on the recorded distance that
    :class:`RetrievalTargetModule` writes as ``target_offset``.

    ===================  ==================================  =============================
    key                  shape, dtype                        meaning
    ===================  ==================================  =============================
    ``observation``      [*B, S], read                       state, raw units
    ``target``           [*B, S], read                       target, raw units
    ``target_offset``    [*B, 1] int64, read if "recorded"   recorded steps to the target
    ``target_step``      [*B, 1] int64                       estimated steps, 1 to H - 1
    ``step_logits``      [*B, H - 1], on demand              scores of the classes
    ===================  ==================================  =============================

    Args:
        normalizer (Normalizer): of states.
        horizon (int): H, that of :class:`RetrievalTargetModule`.
        width (int, optional): Defaults to ``256``.
        activation (str, optional): ``"softmax"``: classes exclude each other; ``"sigmoid"``: one
            against the rest, as the paper prints it. Defaults to ``"softmax"``.
        estimate (str, optional): ``"mode"``, ``"median"`` or ``"mean"`` of the classes;
            ``"recorded"``; or ``"random"``, uniform over the steps, for the ablation -SE. Defaults
            to ``"mode"``.
        pace (float, optional): the steps are multiplied by it and rounded, 1 at least. Below 1 it
            asks the planner to arrive sooner than the demonstrations did. Defaults to ``1.0``.
        in_keys (sequence of NestedKey, optional): state and target, and the offset if
            ``"recorded"``.
        out_keys (sequence of NestedKey, optional): the steps; a second one asks for the logits.

    Raises:
        ValueError: an argument has a value that it cannot have.

    Examples:
        >>> from tensordict import TensorDict
        >>> estimator = StepEstimator(Normalizer.identity(2), horizon=9)
        >>> pairs = {"observation": torch.zeros(3, 2), "target": torch.ones(3, 2)}
        >>> out = estimator(TensorDict(pairs, [3]))
        >>> out["target_step"].shape, bool((out["target_step"] >= 1).all())
        (torch.Size([3, 1]), True)
    """

    def __init__(
        self,
        normalizer: Normalizer,
        horizon: int,
        width: int = 256,
        activation: Literal["softmax", "sigmoid"] = "softmax",
        estimate: Literal["mode", "median", "mean", "recorded", "random"] = "mode",
        pace: float = 1.0,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("target_step",),
    ):
        super().__init__()
        if not pace > 0:
            raise ValueError(f"pace is {pace}; expected a positive factor, 1 for no change.")
        if horizon < 2:
            raise ValueError(f"horizon is {horizon}; a step estimate needs 2 or more.")
        if activation not in ("softmax", "sigmoid"):
            raise ValueError(f"activation is {activation!r}; expected 'softmax' or 'sigmoid'.")
        if estimate not in ESTIMATES:
            raise ValueError(f"estimate is {estimate!r}; expected one of {list(ESTIMATES)}.")
        if in_keys is None:
            in_keys = ["observation", "target"] + ["target_offset"] * (estimate == "recorded")
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        self.horizon, self.activation, self.estimate = horizon, activation, estimate
        self.pace = pace
        self.normalizer = normalizer
        self.net = nn.Sequential(
            nn.Linear(2 * len(normalizer.mean), width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, horizon - 1),
        )  # fmt: skip

    def logits(self, state: Tensor, target: Tensor) -> Tensor:
        """Scores of the classes [*B, H - 1] from raw states [*B, S]."""
        return self.net(torch.cat([self.normalizer(state), self.normalizer(target)], -1))

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the estimated steps into ``tensordict`` and returns it."""
        recorded = self.estimate == "recorded"
        if recorded:
            offset = tensordict.get(self.in_keys[2], None)
            if offset is None:
                raise KeyError(
                    f"{self.in_keys[2]!r} is missing in the tensordict; estimate='recorded' reads "
                    "it: RetrievalTargetModule writes it where it is its sixth out_key."
                )
            tensordict.set(self.out_keys[0], self._paced(offset))
        if not recorded or len(self.out_keys) > 1:
            # a state with NaN has itself, without them, as its target
            state = self.normalizer.read(tensordict, self.in_keys[0])
            state = torch.nan_to_num(state, nan=0.0, posinf=0.0, neginf=0.0)
            target = self.normalizer.read(tensordict, self.in_keys[1])
            with torch.autocast(state.device.type, enabled=False):  # too small to be faster
                logits = self.logits(state, target)
            if not recorded:
                tensordict.set(self.out_keys[0], self._paced(self._steps(logits)))
            if len(self.out_keys) > 1:
                tensordict.set(self.out_keys[1], logits)
        return tensordict

    def _paced(self, steps: Tensor) -> Tensor:
        if self.pace != 1.0:
            steps = (steps * self.pace).round().long()
        return steps.clamp(1, self.horizon - 1)

    def _steps(self, logits: Tensor) -> Tensor:
        if self.estimate == "random":
            shape = (*logits.shape[:-1], 1)
            return torch.randint(1, self.horizon, shape, device=logits.device)
        if self.estimate in ("mode", "recorded"):
            return logits.argmax(-1, keepdim=True) + 1
        # sigmoids divided by their sum, also where all of them underflow
        scores = logits if self.activation == "softmax" else F.logsigmoid(logits)
        weights = scores.softmax(-1)
        if self.estimate == "median":
            below = (weights.cumsum(-1) < 0.5).sum(-1, keepdim=True)
            return (below + 1).clamp_max(self.horizon - 1)
        classes = torch.arange(1, self.horizon, device=logits.device)
        return (weights * classes).sum(-1, keepdim=True).round().long()
