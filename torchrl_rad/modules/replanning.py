"""Several actions of one plan: to plan anew at every n-th step alone."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import MultiStepActorWrapper

from torchrl_rad.modules.diffuser_lite import DiffuserLitePlanner
from torchrl_rad.modules.inverse import InverseDynamics

__all__ = ["PlanActions", "with_replanning"]


class PlanActions(TensorDictModuleBase):
    """The actions along the first states of a plan, by inverse dynamics.

    ================  =====================  ============================================
    key               shape, dtype           meaning
    ================  =====================  ============================================
    ``plan``          [*B, L, S], read       planned states, one step apart as far as
                                             ``steps``, raw units
    ``action_chunk``  [*B, n, A] float32     the actions from each of them to the next
    ================  =====================  ============================================

    Args:
        inverse_dynamics (InverseDynamics): the planner's.
        steps (int): n.
        in_keys, out_keys (sequence of NestedKey, optional): new names.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_rad import Normalizer
        >>> states = Normalizer.identity(4)
        >>> actions = PlanActions(InverseDynamics(states, states, action_dim=2), steps=3)
        >>> actions(TensorDict({"plan": torch.zeros(5, 9, 4)}, [5]))["action_chunk"].shape
        torch.Size([5, 3, 2])
    """

    def __init__(
        self,
        inverse_dynamics: InverseDynamics,
        steps: int,
        in_keys: Sequence[NestedKey] = ("plan",),
        out_keys: Sequence[NestedKey] = ("action_chunk",),
    ):
        super().__init__()
        self.inverse_dynamics, self.steps = inverse_dynamics, steps
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the actions into ``tensordict`` and returns it."""
        states = tensordict.get(self.in_keys[0])[..., : self.steps + 1, :]
        with torch.autocast(states.device.type, enabled=False):  # as the planner's own action
            actions = self.inverse_dynamics(states[..., :-1, :], states[..., 1:, :])
        return tensordict.set(self.out_keys[0], actions)


def with_replanning(policy: TensorDictSequential, interval: int) -> MultiStepActorWrapper:
    """The same policy, which plans at every ``interval``-th step of a row and acts on in between.

    In between it takes the actions that a :class:`DiffuserPlanner` has planned, or those that lead
    along the planned states of a :class:`DiffuserLitePlanner`.

    It is TorchRL's :class:`~torchrl.modules.MultiStepActorWrapper`: the environment needs
    :class:`~torchrl.envs.InitTracker`, and what is left of a plan lies in the tensordict. Between
    plans the policy looks neither at the state nor at the database; what TS and SE wrote for a plan
    stays written as long as it is acted on.

    Args:
        policy (TensorDictSequential): of :func:`build_policy`; its weights are shared.
        interval (int): steps from plan to plan.

    Raises:
        ValueError: the plan, or its finest level, does not reach so far.

    Examples:
        >>> from torchrl_rad.policy import build_policy
        >>> policy = build_policy({
        ...     "state_dim": 4, "action_dim": 2, "planner": {"width": 32}, "target": None})
        >>> with_replanning(policy, interval=5).replan_interval
        5
    """
    planner = policy[-1]
    lite = isinstance(planner, DiffuserLitePlanner)
    reach = planner.levels[-1].span if lite else planner.horizon
    if not 1 <= interval <= reach:
        of = "the plan's finest level" if lite else "a plan"
        raise ValueError(f"interval is {interval}; expected 1 to {reach}, the steps of {of}.")
    if lite:
        chunk = PlanActions(planner.inverse_dynamics, interval, planner.out_keys[:1])
    else:
        planner = copy.copy(planner)
        planner.out_keys = [*planner.out_keys[:2], "actions"]
        first = partial(torch.narrow, dim=-2, start=0, length=interval)
        chunk = TensorDictModule(first, planner.out_keys[2:], ["action_chunk"])
    told = [key for module in policy[:-1] for key in module.out_keys if isinstance(key, str)]
    held = [f"{key}_chunk" for key in told]
    modules = [*policy[:-1], planner, chunk]
    if told:  # the wrapper carries chunks alone from step to step
        modules.append(TensorDictModule(partial(_repeat, interval), told, held))
    return MultiStepActorWrapper(
        TensorDictSequential(*modules),
        n_steps=interval,
        replan_interval=interval,
        chunk_keys=[*chunk.out_keys, *held],
        action_keys=[*planner.out_keys[1:2], *told],
        init_key="is_init",
    )


def _repeat(times: int, *values: Tensor) -> tuple[Tensor, ...]:
    """Each value [N, ...] for every step of a plan, [N, times, ...]."""
    return tuple(value[:, None].expand(-1, times, *value.shape[1:]) for value in values)
