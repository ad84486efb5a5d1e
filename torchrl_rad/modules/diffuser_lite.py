"""PL of DL-RAD: a plan of states, coarse to fine, around the current state and the target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.condition import ReturnCondition
from torchrl_rad.modules.dit import DiT
from torchrl_rad.modules.frozen import StepNetwork
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.levels import (
    change_of,
    decode_states,
    encode_states,
    plan_levels,
    plan_times,
)
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.placement import TargetPlacement
from torchrl_rad.modules.planner import Noise, Pin, Planner, PlanNetworks, best_plans
from torchrl_rad.modules.process import make_process
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.modules.sampling import sample_plan

__all__ = ["DiffuserLitePlanner"]


class DiffuserLitePlanner(Planner):
    """Plans states on ever finer grids and acts by inverse dynamics (DL-RAD).

    It is DiffuserLite (Dong et al., 2024) with a retrieved target.

    Level l holds states 0, J_l, 2 J_l, ... steps ahead; only the first jump of a level is refined
    by the next one, whose first and last states are known then. The current state and the target
    are in-painted: they are in ``plan`` exactly. Rows with ``found`` False are planned without a
    target in the same batch.

    ================  ====================  ====================================================
    key               shape, dtype          meaning
    ================  ====================  ====================================================
    ``observation``   [*B, S], read         state, raw units; NaN and Inf count as 0
    ``target``        [*B, S], read         target, raw units
    ``found``         [*B, 1] bool, read    whether there is a target
    ``target_step``   [*B, 1] int64, read   steps to the target, 1 to H - 1
    ``target_index``  [*B, 1] int64, read   its row in the database (-1: none), read for a
                                            shifted placement
    ``plan``          [*B, L, S] float32    planned states, raw units, at ``plan_times``
                                            (int64 [L]) steps from now
    ``action``        [*B, A] float32       action
    ================  ====================  ====================================================

    Args:
        normalizer (Normalizer): of states.
        inverse_dynamics (InverseDynamics): f_a.
        horizon (int, optional): H, states of a plan at the finest step. Defaults to ``129``.
        jumps (sequence of int, optional): temporal jump of each level. Defaults to ``(32, 8, 1)``.
        width, heads, blocks (int, optional): of each level's DiT. Default to ``256``, ``8``, ``2``.
        process (str, optional): ``"flow"``, ``"diffusion"`` or ``"ancestral"``, see
            :func:`make_process`. Defaults to ``"flow"``.
        steps (int, optional): calls of the network a level. Defaults to ``3``.
        temperature (float or sequence of float, optional): scale of the initial noise, the same for
            all levels or one for each. Defaults to ``1.0``.
        candidates (int, optional): first-level plans a row, of which the return model keeps the
            best. Defaults to ``1``.
        return_model (ReturnModel, optional): J; needed for more than one candidate.
        noise (str, optional): ``"sample"``; ``"seeded"``: the same noise at each call and for each
            row, also used when ``"sample"`` meets ``ExplorationType.DETERMINISTIC``; ``"zero"``.
            Defaults to ``"sample"``.
        targets (bool, optional): False gives the backbone, which reads the observation alone.
            Defaults to ``True``.
        placement (str, optional): see :class:`TargetPlacement`. Defaults to ``"shifted"``.
        database (ExpertDatabase, optional): where a shifted placement looks up the target's
            episode; without it the target itself stands in.
        relative (bool, optional): the networks see the states after the current one as changes from
            it, in units of the changes that the level's grid meets in the data (``changes``, see
            :func:`fit_scales`), rather than as standardised states. One step changes a robot's
            state by a small part of its deviation. Defaults to ``False``.
        condition (float or sequence of float, optional): the networks are told the return that a
            plan is to have, here one that this share of the recorded ones lies below, the same for
            all levels or one for each (see :class:`ReturnCondition`). Defaults to none: they are
            told nothing.
        in_keys, out_keys (sequence of NestedKey, optional): new names, in the order of the table.

    Raises:
        ValueError: an argument has a value that it cannot have.

    Examples:
        >>> from tensordict import TensorDict
        >>> states = Normalizer.identity(2)
        >>> inverse = InverseDynamics(states, states, 1)
        >>> planner = DiffuserLitePlanner(states, inverse, horizon=9, jumps=(4, 1), width=32)
        >>> out = planner(TensorDict({"observation": torch.zeros(3, 2), "target": torch.ones(3, 2),
        ...     "found": torch.ones(3, 1, dtype=torch.bool), "target_step": torch.full((3, 1), 4),
        ...     "target_index": torch.full((3, 1), -1)}, [3]))
        >>> out["action"].shape, planner.plan_times.tolist(), out["plan"][0, 4].tolist()
        (torch.Size([3, 1]), [0, 1, 2, 3, 4, 8], [1.0, 1.0])
    """

    plan_times: Tensor

    def __init__(
        self,
        normalizer: Normalizer,
        inverse_dynamics: InverseDynamics,
        horizon: int = 129,
        jumps: Sequence[int] = (32, 8, 1),
        width: int = 256,
        heads: int = 8,
        blocks: int = 2,
        process: Literal["flow", "diffusion", "ancestral"] = "flow",
        steps: int = 3,
        temperature: float | Sequence[float] = 1.0,
        candidates: int = 1,
        return_model: ReturnModel | None = None,
        noise: Noise = "sample",
        targets: bool = True,
        placement: str = "shifted",
        database: ExpertDatabase | None = None,
        relative: bool = False,
        condition: float | Sequence[float] | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("plan", "action"),
    ):
        levels = plan_levels(horizon, jumps)
        each = _one_a_level("temperature", temperature, len(levels))
        super().__init__(
            normalizer,
            make_process(process),
            steps,
            each,
            candidates,
            return_model,
            noise,
            targets,
            in_keys,
            out_keys,
        )
        tokens = getattr(return_model, "tokens", levels[0].tokens)
        if tokens != levels[0].tokens:
            raise ValueError(
                f"the return model sees {tokens} states; the first level of these plans has "
                f"{levels[0].tokens}."
            )
        self.levels, self.horizon = levels, horizon
        self.placement = TargetPlacement(placement)
        self.__dict__["database"] = database  # a handle, as in RetrievalTargetModule
        self.inverse_dynamics = inverse_dynamics
        state_dim = len(normalizer.mean)
        conditioned = condition is not None
        if condition is not None:
            self.condition = ReturnCondition(_one_a_level("condition", condition, len(levels)))
        self.networks = PlanNetworks(
            DiT(state_dim, level.tokens, width, heads, blocks, conditioned=conditioned)
            for level in self.levels
        )
        self.changes: nn.ModuleList | None = None
        if relative:
            self.changes = nn.ModuleList(Normalizer.identity(state_dim) for _ in levels)
        self.register_buffer("plan_times", plan_times(levels), persistent=False)

    def decide(self, state: Tensor, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        pins = self._pins(tensordict, len(state)) if self.targets else [None] * len(self.levels)
        plan = self._planned(state, pins)
        with torch.autocast(state.device.type, enabled=False):  # too small to be faster
            return plan, self.inverse_dynamics(state, plan[:, 1])

    # what is known

    def _pins(self, tensordict: TensorDictBase, rows: int) -> list[Pin | None]:
        told = self._told(tensordict, rows)
        pins: list[Pin | None] = []
        for number, level in enumerate(self.levels):
            place = self.placement(told.step, number, *level)
            state = told.target
            if told.row is not None:
                state = self._recorded(state, told.row, place.time - told.step)
            pins.append(Pin(place.token, state, told.found & place.active))
        return pins

    def _recorded(self, target: Tensor, index: Tensor, shift: Tensor) -> Tensor:
        """The state ``shift`` rows after row ``index``, cut to its episode; else the target."""
        database = self.database
        if database is None or len(database) == 0:
            return target
        rows = database.columns
        place = index.clamp_min(0).to(database.device)
        shift = shift.to(database.device)
        place = place + shift.maximum(-rows["step"][place]).minimum(rows["remaining"][place])
        recorded = rows[database.sampler.key][place].to(target)
        elsewhere = (index >= 0) & (shift != 0).to(index.device)
        return torch.where(elsewhere[:, None], recorded, target)

    # the plan

    def plan(self, state: Tensor, pins: Sequence[Pin | None]) -> Tensor:
        seeded = self._generator(state.device)
        networks = self._step_networks(state.device)
        end: Tensor | None = None
        finished: list[Tensor] = []
        with torch.autocast(state.device.type, enabled=False):
            for number, pin in enumerate(pins):
                network = networks[number]
                states = self._level(number, network, state, end, pin, seeded)  # [Q, n, S]
                finished = [states, *(part[:, 2:] for part in finished[:1]), *finished[1:]]
                end = states[:, 1]
        return torch.cat(finished, 1)

    def _level(
        self,
        number: int,
        network: StepNetwork,
        state: Tensor,
        end: Tensor | None,
        pin: Pin | None,
        generator: torch.Generator | None,
    ) -> Tensor:
        tokens = self.levels[number].tokens
        known = state.new_zeros(len(state), tokens, state.shape[-1])
        mask = torch.zeros(len(state), tokens, 1, dtype=torch.bool, device=state.device)
        known[:, 0], mask[:, 0] = state, True
        if end is not None:
            known[:, -1], mask[:, -1] = end, True
        if pin is not None:
            known, mask = pin.write(known, mask)
        copies = self.candidates if number == 0 else 1
        many, many_mask = known.repeat_interleave(copies, 0), mask.repeat_interleave(copies, 0)
        given = network.prepare(many_mask)
        change = change_of(self.changes, number)
        free = self.levels[number].free(number)
        sample = sample_plan(
            self.process,
            lambda x, step: network(x, given, step, free),
            self.temperatures[number] * self._draw(len(state), copies, tokens, generator, state),
            encode_states(many, self.normalizer, change),
            many_mask,
            self.steps,
            free,
            fresh=lambda: self._draw(len(state), copies, tokens, generator, state),
        )
        # exact in raw units: what is known is not sent through the normaliser and back
        raw = torch.where(
            many_mask, many, decode_states(sample, many[:, :1], self.normalizer, change)
        )
        if copies == 1:
            return raw
        assert self.return_model is not None
        plans = raw.unflatten(0, (len(state), copies))
        return best_plans(plans, self.return_model(plans))


def _one_a_level(name: str, value: float | Sequence[float], levels: int) -> list[float]:
    each = list(value) if isinstance(value, Sequence) else [value] * levels
    if len(each) != levels:
        raise ValueError(
            f"{name} is {each}; expected one number, or one for each of the {levels} levels."
        )
    return each
