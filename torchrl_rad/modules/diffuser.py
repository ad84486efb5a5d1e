"""PL of D-RAD: a plan of states and actions around the current state and the target."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal, TypeVar, cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_rad.modules.frozen import FrozenCache, PlainNetwork, StepNetwork, is_hooked
from torchrl_rad.modules.frozen_unet import FrozenReturnModel, FrozenUNet, can_tile
from torchrl_rad.modules.levels import Level
from torchrl_rad.modules.noisy_return_model import NoisyReturnModel, PlainReturnModel, StepReturns
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.placement import TargetPlacement
from torchrl_rad.modules.planner import Noise, Pin, Planner, PlanNetworks, best_plans
from torchrl_rad.modules.process import Diffusion, make_process
from torchrl_rad.modules.sampling import Guidance, sample_plan
from torchrl_rad.modules.temporal_unet import TemporalUNet, check_length

__all__ = ["DiffuserPlanner"]

Frozen = TypeVar("Frozen", FrozenUNet, FrozenReturnModel)

SAMPLERS = {"ancestral": "ancestral", "ddim": "diffusion"}  # names of their processes


class DiffuserPlanner(Planner):
    """Plans states and actions together, step by step, and acts by the first one (D-RAD).

    It is Diffuser (Janner et al., 2022) with a retrieved target: the state ``target_step`` steps
    ahead. The current state and the target are in-painted: they are in ``plan`` exactly; all
    actions are free. Rows with ``found`` False, or with a target beyond the horizon, are planned
    without a target in the same batch; a step below 1 counts as 1.

    Before each call of the network the return model moves the noisy plans towards a larger return;
    in the end it chooses among the candidates.

    ================  ====================  ====================================================
    key               shape, dtype          meaning
    ================  ====================  ====================================================
    ``observation``   [*B, S], read         state, raw units; NaN and Inf count as 0
    ``target``        [*B, S], read         target, raw units
    ``found``         [*B, 1] bool, read    whether there is a target
    ``target_step``   [*B, 1] int64, read   steps to the target, 1 to H - 1
    ``target_index``  [*B, 1] int64         may be missing: every step has its place in a plan, so
                                            that no other row is looked up
    ``plan``          [*B, H, S] float32    planned states, raw units, at ``plan_times``
                                            (int64 [H]) steps from now
    ``action``        [*B, A] float32       action
    ``actions``       [*B, H, A] float32,   all actions of the plan; the first one is ``action``
                      on demand
    ================  ====================  ====================================================

    Args:
        normalizer (Normalizer): of states; actions are planned as they are.
        action_dim (int): A.
        horizon (int, optional): H, steps of a plan, a multiple of 2 ** (resolutions - 1). Defaults
            to ``32``.
        width, multiples (optional): of the :class:`TemporalUNet`. Default to ``32``,
            ``(1, 2, 4, 8)``.
        steps (int, optional): calls of the network. Defaults to ``20``.
        sampler (str, optional): ``"ancestral"`` (DDPM), or ``"ddim"``, which does with few steps;
            both sample from the same weights. Defaults to ``"ancestral"``.
        temperature (float, optional): scale of the initial noise. Defaults to ``1.0``.
        candidates (int, optional): plans a row, of which the return model keeps the best. Defaults
            to ``1``.
        return_model (NoisyReturnModel, optional): J; needed for more than one candidate.
        guide_scale (float, optional): times the posterior variance it is the factor of J's
            gradient, J in units of its deviation (Diffuser's scales are of J in units of return:
            times the deviation they are these); 0 for none. Defaults to ``1.0``.
        guide_steps (int, optional): gradients before a call of the network. Defaults to ``2``.
        guide_stop (int, optional): last steps that are not guided. Defaults to ``2``.
        noise (str, optional): ``"sample"``; ``"seeded"``: the same noise at each call and for each
            row, also used when ``"sample"`` meets ``ExplorationType.DETERMINISTIC``; ``"zero"``.
            Defaults to ``"sample"``.
        targets (bool, optional): False gives the backbone, which reads the observation alone.
            Defaults to ``True``.
        bound (float, optional): actions lie in [-bound, bound]. Defaults to ``1.0``.
        in_keys, out_keys (sequence of NestedKey, optional): new names, in the order of the table; a
            third out_key asks for all actions.

    Raises:
        ValueError: an argument has a value that it cannot have.

    Examples:
        >>> from tensordict import TensorDict
        >>> planner = DiffuserPlanner(Normalizer.identity(2), 1, horizon=8, width=8, steps=2)
        >>> out = planner(TensorDict({"observation": torch.zeros(3, 2), "target": torch.ones(3, 2),
        ...     "found": torch.ones(3, 1, dtype=torch.bool), "target_step": torch.full((3, 1), 5)},
        ...     [3]))
        >>> out["action"].shape, out["plan"].shape, out["plan"][0, 5].tolist()
        (torch.Size([3, 1]), torch.Size([3, 8, 2]), [1.0, 1.0])
    """

    plan_times: Tensor
    process: Diffusion
    return_model: NoisyReturnModel | None
    most_outputs = 3

    def __init__(
        self,
        normalizer: Normalizer,
        action_dim: int,
        horizon: int = 32,
        width: int = 32,
        multiples: Sequence[int] = (1, 2, 4, 8),
        steps: int = 20,
        sampler: Literal["ancestral", "ddim"] = "ancestral",
        temperature: float = 1.0,
        candidates: int = 1,
        return_model: NoisyReturnModel | None = None,
        guide_scale: float = 1.0,
        guide_steps: int = 2,
        guide_stop: int = 2,
        noise: Noise = "sample",
        targets: bool = True,
        bound: float = 1.0,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("plan", "action"),
    ):
        if sampler not in SAMPLERS:
            raise ValueError(f"sampler is {sampler!r}; expected one of {sorted(SAMPLERS)}.")
        super().__init__(
            normalizer,
            make_process(SAMPLERS[sampler]),
            steps,
            [temperature],
            candidates,
            return_model,
            noise,
            targets,
            in_keys,
            out_keys,
        )
        if guide_scale < 0 or guide_steps < 0 or guide_stop < 0:
            raise ValueError(
                f"guide_scale, guide_steps and guide_stop are {guide_scale}, {guide_steps} and "
                f"{guide_stop}; none may be negative."
            )
        check_length(horizon, len(multiples))
        state_dim = len(normalizer.mean)
        seen = (
            getattr(return_model, "horizon", horizon),
            getattr(return_model, "entries", state_dim + action_dim),
        )
        if seen != (horizon, state_dim + action_dim):
            raise ValueError(
                f"the return model sees {seen[0]} steps of {seen[1]} entries; these plans have "
                f"{horizon} of {state_dim + action_dim}."
            )
        self.horizon, self.levels = horizon, [Level(1, horizon)]
        self.action_dim, self.bound = action_dim, bound
        self.guide_scale, self.guide_steps, self.guide_stop = guide_scale, guide_steps, guide_stop
        self.placement = TargetPlacement("shifted")  # on this grid all placements are alike
        self.networks = PlanNetworks([TemporalUNet(state_dim + action_dim, width, multiples)])
        self.register_buffer("plan_times", torch.arange(horizon), persistent=False)
        self._frozen_returns = FrozenCache()
        self._compiled: dict[str, Any] | None = None  # options

    def compile(self, **options: Any) -> None:  # type: ignore[override]
        """Networks are compiled by :func:`torch.compile` at the next plan, on a CPU.

        It takes minutes for each number of rows, and needs a C++ compiler; plans are then 1.3 (64
        candidates) to 2.3 times (one) as fast. New weights are not compiled anew. The loop around
        the networks stays as it is. For a GPU there is :meth:`capture`.

        Args:
            **options: of :func:`torch.compile`; ``dynamic`` is False if it is not given, since
                graphs for any number of rows are slower.

        Raises:
            RuntimeError: the networks are not called in the frozen form that is compiled: they are
                on a GPU, somebody watches their calls, or the horizon is no multiple of
                4 * 2 ** (resolutions - 1).

        Examples:
            >>> planner = DiffuserPlanner(Normalizer.identity(2), 1, horizon=8, width=8,
            ...     multiples=(1,))
            >>> planner.compile(backend="eager")
            >>> planner(observation=torch.zeros(3, 2), target=torch.ones(3, 2),
            ...     found=torch.ones(3, 1, dtype=torch.bool),
            ...     target_step=torch.full((3, 1), 5))[1].shape
            torch.Size([3, 1])
        """
        if not self._freezes(self.networks[0], TemporalUNet):
            raise RuntimeError(
                "only frozen networks are compiled: those of a planner on the CPU, without hooks, "
                f"whose horizon ({self.horizon}) is a multiple of 4 * 2 ** (resolutions - 1). For "
                "a GPU there is capture()."
            )
        self._compiled = {"dynamic": False, **options}
        self._frozen, self._frozen_returns = FrozenCache(), FrozenCache()

    def decide(self, state: Tensor, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        pin = None
        if self.targets:
            told = self._told(tensordict, len(state))
            place = self.placement(told.step, 0, *self.levels[0])
            pin = Pin(place.token, told.target, told.found & place.active)
        plan, width = self._planned(state, [pin]), state.shape[-1]
        actions = plan[..., width:].clamp(-self.bound, self.bound)
        return (plan[..., :width], actions[:, 0], actions)[: len(self.out_keys)]

    def plan(self, state: Tensor, pins: Sequence[Pin | None]) -> Tensor:
        (pin,), (rows, width) = pins, state.shape
        states = state.new_zeros(rows, self.horizon, width)
        mask = torch.zeros(rows, self.horizon, 1, dtype=torch.bool, device=state.device)
        states[:, 0], mask[:, 0] = state, True
        if pin is not None:
            states, mask = pin.write(states, mask)
        copies = self.candidates
        states, mask = states.repeat_interleave(copies, 0), mask.repeat_interleave(copies, 0)
        free = states.new_zeros(*states.shape[:2], self.action_dim)
        of_actions = torch.zeros_like(free, dtype=torch.bool)
        known = torch.cat([self.normalizer(states), free], -1)
        generator = self._generator(state.device)
        (network,) = self._step_networks(state.device)
        returns = self._returns(state.device)
        with torch.autocast(state.device.type, enabled=False):
            given = network.prepare(mask)
            sample = sample_plan(
                self.process,
                lambda x, step: network(x, given, step, slice(None)),
                self.temperatures[0] * self._draw(rows, copies, self.horizon, generator, known),
                known,
                torch.cat([mask.expand_as(states), of_actions], -1),
                self.steps,
                guidance=self._guidance(returns, mask),
                fresh=lambda: self._draw(rows, copies, self.horizon, generator, known),
            )
            # exact in raw units: what is known is not sent through the normaliser and back
            planned = torch.where(mask, states, self.normalizer.inverse(sample[..., :width]))
            plans = torch.cat([planned, sample[..., width:]], -1)
            if copies == 1:
                return plans
            assert returns is not None
            worth = returns.value(sample, mask, self.steps)  # at the last time, without noise
        return best_plans(plans.unflatten(0, (rows, copies)), worth.view(rows, copies))

    def _guidance(self, returns: StepReturns | None, mask: Tensor) -> Guidance | None:
        """Gradients of the return model, which are scaled by the posterior variance."""
        if returns is None or self.guide_scale == 0 or self.guide_steps == 0:
            return None
        guided = self.steps - self.guide_stop
        scales = [
            self.guide_scale * self.process.variance(time, following) if step < guided else 0.0
            for step, (time, following) in enumerate(pairwise(self.process.grid(self.steps)))
        ]
        return Guidance(
            lambda sample, step: returns.gradient(sample, mask, step), scales, self.guide_steps
        )

    # networks at the times of the sampler

    def _step_network(
        self,
        network: nn.Module,
        times: Sequence[float],
        dtype: torch.dtype | None,
        condition: Tensor | None,
    ) -> StepNetwork:
        if self._freezes(network, TemporalUNet):  # in float32: quicker than bfloat16 as it is
            return self._compiling(FrozenUNet(cast(TemporalUNet, network), times))
        return PlainNetwork(network, times, dtype)

    def _returns(self, device: torch.device) -> StepReturns | None:
        model = self.return_model
        if model is None:
            return None
        times = self.process.grid(self.steps)
        if device.type != "cpu" or not self._freezes(model, NoisyReturnModel):
            return PlainReturnModel(model, times)
        return self._frozen_returns.get(
            model, tuple(times), lambda: self._compiling(FrozenReturnModel(model, times))
        )

    def _compiling(self, network: Frozen) -> Frozen:
        if self._compiled is not None:
            network.compile(self._compiled)
        return network

    def _freezes(self, network: nn.Module, kind: type) -> bool:
        """Whether a network can be called in its frozen form, and nobody watches its calls."""
        if type(network) is not kind or is_hooked(network):
            return False
        on_cpu = next(network.parameters()).is_cpu
        return on_cpu and can_tile(self.horizon, len(cast(TemporalUNet, network).multiples))
