"""PL of DL-RAD: a plan of states, coarse to fine, around the current state and the target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.dit import DiT
from torchrl_rad.modules.frozen import FrozenCache, StepNetwork, is_hooked, step_network
from torchrl_rad.modules.inverse import InverseDynamics
from torchrl_rad.modules.levels import Level, plan_levels, plan_times
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.placement import TargetPlacement
from torchrl_rad.modules.process import make_process
from torchrl_rad.modules.return_model import ReturnModel
from torchrl_rad.modules.sampling import sample_plan

__all__ = ["DiffuserLitePlanner"]


class Pin(NamedTuple):
    """What one level is told of the target.

    Attributes:
        token: int64 [Q], grid point.
        state: [Q, S], the state there, raw units.
        active: bool [Q], whether it is pinned.
    """

    token: Tensor
    state: Tensor
    active: Tensor


class PlanNetworks(nn.ModuleList):
    """One network a level; called with the level's number."""

    def forward(self, level: int, *args: Any, **kwargs: Any) -> Tensor:
        return self[level](*args, **kwargs)

    def reset_parameters_recursive(self) -> None:
        """Draws new weights, as a TensorDictModule does."""
        for network in self:
            network.reset_parameters()  # type: ignore[operator]


class DiffuserLitePlanner(TensorDictModuleBase):
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
        process (str, optional): ``"flow"`` or ``"diffusion"``. Defaults to ``"flow"``.
        steps (int, optional): calls of the network a level. Defaults to ``3``.
        temperature (float, optional): scale of the initial noise. Defaults to ``1.0``.
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
        process: Literal["flow", "diffusion"] = "flow",
        steps: int = 3,
        temperature: float = 1.0,
        candidates: int = 1,
        return_model: ReturnModel | None = None,
        noise: Literal["sample", "seeded", "zero"] = "sample",
        targets: bool = True,
        placement: str = "shifted",
        database: ExpertDatabase | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("plan", "action"),
    ):
        super().__init__()
        levels = plan_levels(horizon, jumps)
        _check(steps, temperature, candidates, return_model, noise, levels)
        read = ["observation", "target", "found", "target_step", "target_index"]
        self.in_keys = list(in_keys) if in_keys is not None else read if targets else read[:1]
        self.out_keys = list(out_keys)
        if len(self.in_keys) not in ((4, 5) if targets else (1,)) or len(self.out_keys) != 2:
            raise ValueError(
                f"in_keys are {self.in_keys} and out_keys {self.out_keys}; expected "
                f"{'five' if targets else 'one'} and two, in the order of the table."
            )
        self.levels, self.horizon, self.targets = levels, horizon, targets
        self.process, self.steps, self.temperature = make_process(process), steps, temperature
        self.candidates, self.noise = candidates, noise
        self.placement = TargetPlacement(placement)
        self.__dict__["database"] = database  # a handle, as in RetrievalTargetModule
        self.normalizer, self.inverse_dynamics = normalizer, inverse_dynamics
        self.return_model = return_model
        state_dim = len(normalizer.mean)
        self.networks = PlanNetworks(
            DiT(state_dim, level.tokens, width, heads, blocks) for level in self.levels
        )
        self.register_buffer("plan_times", plan_times(levels), persistent=False)
        self._frozen = FrozenCache()

    @dispatch(auto_batch_size=False)
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes plan and action into ``tensordict`` and returns it."""
        observation = self.normalizer.read(tensordict, self.in_keys[0])
        shape, width = observation.shape[:-1], observation.shape[-1]
        state = torch.nan_to_num(observation, nan=0.0, posinf=0.0, neginf=0.0).reshape(-1, width)
        pins = self._pins(tensordict, len(state)) if self.targets else [None] * len(self.levels)
        plan = self.plan(state, pins)
        with torch.autocast(state.device.type, enabled=False):  # too small to be faster
            action = self.inverse_dynamics(state, plan[:, 1])
        tensordict.set(self.out_keys[0], plan.reshape(*shape, *plan.shape[1:]))
        tensordict.set(self.out_keys[1], action.reshape(*shape, action.shape[-1]))
        return tensordict

    # what is known

    def _pins(self, tensordict: TensorDictBase, rows: int) -> list[Pin | None]:
        target = self.normalizer.read(tensordict, self.in_keys[1])
        target = target.reshape(rows, target.shape[-1])
        found, step = (tensordict.get(key, None) for key in self.in_keys[2:4])
        if found is None or step is None:
            raise KeyError(
                f"{self.in_keys[2 if found is None else 3]!r} is missing in the tensordict; a "
                "planner with targets reads it."
            )
        found, step = found.reshape(rows), step.reshape(rows)
        index = tensordict.get(self.in_keys[4], None) if len(self.in_keys) > 4 else None
        pins: list[Pin | None] = []
        for number, level in enumerate(self.levels):
            place = self.placement(step, number, *level)
            state = target
            if index is not None:
                state = self._recorded(target, index.reshape(rows), place.time - step)
            pins.append(Pin(place.token, state, found & place.active))
        return pins

    def _recorded(self, target: Tensor, index: Tensor, shift: Tensor) -> Tensor:
        """The state ``shift`` rows after row ``index``, cut to its episode; else the target."""
        database = self.database
        if database is None or len(database) == 0:
            return target
        rows = database[:]
        place = index.clamp_min(0).to(database.device)
        shift = shift.to(database.device)
        place = place + shift.maximum(-rows["step"][place]).minimum(rows["remaining"][place])
        recorded = rows[database.sampler.key][place].to(target)
        elsewhere = (index >= 0) & (shift != 0).to(index.device)
        return torch.where(elsewhere[:, None], recorded, target)

    # the plan

    def _networks(self, device: torch.device) -> list[StepNetwork]:
        """The networks of the levels at the sampler's times; under autocast in its precision."""
        lower = torch.is_autocast_enabled(device.type)
        dtype = torch.get_autocast_dtype(device.type) if lower else None
        times = self.process.grid(self.steps)[:-1]

        def make() -> list[StepNetwork]:
            return [step_network(network, times, dtype) for network in self.networks]

        if device.type != "cpu":
            return make()  # nothing is packed there, and to compare weights would wait for it
        hooked = tuple(map(is_hooked, self.networks))
        return self._frozen.get(self.networks, (dtype, hooked, *times), make)

    def plan(self, state: Tensor, pins: Sequence[Pin | None]) -> Tensor:
        """Plans [Q, L, S] for raw states [Q, S]; ``pins`` holds a :class:`Pin` or None a level."""
        seeded = torch.Generator(device=state.device).manual_seed(0) if self._is_seeded() else None
        networks = self._networks(state.device)
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
            here = torch.arange(tokens, device=state.device) == pin.token[:, None]  # [Q, n]
            here &= pin.active[:, None]
            known = torch.where(here[..., None], pin.state[:, None], known)
            mask = mask | here[..., None]
        copies = self.candidates if number == 0 else 1
        many, many_mask = known.repeat_interleave(copies, 0), mask.repeat_interleave(copies, 0)
        given = network.prepare(many_mask)
        free = self.levels[number].free(number)
        sample = sample_plan(
            self.process,
            lambda x, step: network(x, given, step, free),
            self._noise(len(state), copies, tokens, generator, state),
            self.normalizer(many),
            many_mask,
            self.steps,
            free,
        )
        # exact in raw units: what is known is not sent through the normaliser and back
        raw = torch.where(many_mask, many, self.normalizer.inverse(sample))
        return self._best(raw.unflatten(0, (len(state), copies))) if copies > 1 else raw

    def _best(self, plans: Tensor) -> Tensor:
        """The plan of each row that the return model prefers: [Q, C, n, S] -> [Q, n, S]."""
        assert self.return_model is not None
        best = self.return_model(plans).argmax(-1)
        return plans[torch.arange(len(plans), device=plans.device), best]

    def _is_seeded(self) -> bool:
        deterministic = exploration_type() == ExplorationType.DETERMINISTIC
        return self.noise == "seeded" or (self.noise == "sample" and deterministic)

    def _noise(
        self, rows: int, copies: int, tokens: int, generator: torch.Generator | None, like: Tensor
    ) -> Tensor:
        shape = (rows * copies, tokens, like.shape[-1])
        if self.noise == "zero":
            return like.new_zeros(shape)
        if generator is None:
            return self.temperature * torch.randn(shape, device=like.device)
        # one draw for every row, so that a row does not depend on those beside it
        noise = torch.randn((copies, *shape[1:]), generator=generator, device=like.device)
        return self.temperature * noise.repeat(rows, 1, 1)


def _check(
    steps: int,
    temperature: float,
    candidates: int,
    return_model: nn.Module | None,
    noise: str,
    levels: Sequence[Level],
) -> None:
    """Raises ValueError for arguments of a planner that they cannot have."""
    if steps < 1:
        raise ValueError(f"steps is {steps}; a plan needs at least one inference step.")
    if temperature < 0:
        raise ValueError(f"temperature is {temperature}; it must not be negative.")
    if candidates < 1 or (candidates > 1 and return_model is None):
        raise ValueError(
            f"candidates is {candidates}: expected 1, or more and a return_model to rank them."
        )
    tokens = getattr(return_model, "tokens", levels[0].tokens)
    if tokens != levels[0].tokens:
        raise ValueError(
            f"the return model sees {tokens} states; the first level of these plans has "
            f"{levels[0].tokens}."
        )
    if noise not in ("sample", "seeded", "zero"):
        raise ValueError(f"noise is {noise!r}; expected 'sample', 'seeded' or 'zero'.")
