"""What the planners share: keys, raw units in and out, noise, the best of the candidates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_rad.graphs import CapturedPlan
from torchrl_rad.modules.condition import ReturnCondition
from torchrl_rad.modules.frozen import FrozenCache, StepNetwork, is_hooked, step_network
from torchrl_rad.modules.normalizer import Normalizer
from torchrl_rad.modules.process import Process

__all__ = ["Noise", "Pin", "PlanNetworks", "Planner", "Told"]

Noise = Literal["sample", "seeded", "zero"]


class Told(NamedTuple):
    """What a planner reads of the targets.

    Attributes:
        target: [Q, S], raw units.
        found: bool [Q], whether there is one.
        step: int64 [Q], steps to it.
        row: int64 [Q], where it is in the database; None if nobody wrote it.
    """

    target: Tensor
    found: Tensor
    step: Tensor
    row: Tensor | None


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

    def write(self, known: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """With the pinned states in it: states [Q, n, S] and mask of the known ones [Q, n, 1]."""
        here = torch.arange(known.shape[1], device=known.device) == self.token[:, None]  # [Q, n]
        here = (here & self.active[:, None])[..., None]
        return torch.where(here, self.state[:, None], known), mask | here


class PlanNetworks(nn.ModuleList):
    """One network a level; called with the level's number."""

    def forward(self, level: int, *args, **kwargs) -> Tensor:
        return self[level](*args, **kwargs)

    def reset_parameters_recursive(self) -> None:
        """Draws new weights, as a TensorDictModule does."""
        for network in self:
            network.reset_parameters()  # type: ignore[operator]


class Planner(TensorDictModuleBase):
    """Reads the state and its target, writes ``plan`` and ``action``.

    A planner defines :meth:`decide` and holds ``networks``, a :class:`PlanNetworks`.

    Args:
        normalizer (Normalizer): of states.
        process (Process): the generative process.
        steps (int): calls of the network a level.
        temperatures (sequence of float): scale of the initial noise of each level.
        candidates (int): plans a row, of which the return model keeps the best.
        return_model (nn.Module, optional): J.
        noise (str): ``"sample"``, ``"seeded"`` or ``"zero"``.
        targets (bool): False gives the backbone.
        in_keys, out_keys (sequence of NestedKey, optional): new names.

    Raises:
        ValueError: an argument has a value that it cannot have.
    """

    networks: PlanNetworks
    condition: ReturnCondition | None
    most_outputs = 2

    def __init__(
        self,
        normalizer: Normalizer,
        process: Process,
        steps: int,
        temperatures: Sequence[float],
        candidates: int,
        return_model: nn.Module | None,
        noise: Noise,
        targets: bool,
        in_keys: Sequence[NestedKey] | None,
        out_keys: Sequence[NestedKey],
    ):
        super().__init__()
        _check(steps, temperatures, candidates, return_model, noise)
        read = ["observation", "target", "found", "target_step", "target_index"]
        self.in_keys = list(in_keys) if in_keys is not None else read if targets else read[:1]
        self.out_keys = list(out_keys)
        written = 2 <= len(self.out_keys) <= self.most_outputs
        if len(self.in_keys) not in ((4, 5) if targets else (1,)) or not written:
            raise ValueError(
                f"in_keys are {self.in_keys} and out_keys {self.out_keys}; expected "
                f"{'five' if targets else 'one'} and two{' or three' * (self.most_outputs > 2)}, "
                "in the order of the table."
            )
        self.process, self.steps, self.temperatures = process, steps, list(temperatures)
        self.candidates, self.noise, self.targets = candidates, noise, targets
        self.normalizer, self.return_model = normalizer, return_model
        self.condition = None  # a planner whose networks are told returns sets it
        self._frozen = FrozenCache()
        self._captured: CapturedPlan | None = None

    def decide(self, state: Tensor, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """Plans [Q, L, S] and actions [Q, A] for raw states [Q, S]; targets are read from the rest.

        What else is asked for by an ``out_key`` comes behind them.

        Args:
            state (Tensor): what ``tensordict`` holds, flat and finite.
            tensordict (TensorDictBase): see :meth:`_told`.
        """
        raise NotImplementedError

    @dispatch(auto_batch_size=False)
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes plan and action into ``tensordict`` and returns it."""
        observation = self.normalizer.read(tensordict, self.in_keys[0])
        shape, width = observation.shape[:-1], observation.shape[-1]
        state = torch.nan_to_num(observation, nan=0.0, posinf=0.0, neginf=0.0).reshape(-1, width)
        for key, value in zip(self.out_keys, self.decide(state, tensordict), strict=True):
            tensordict.set(key, value.reshape(*shape, *value.shape[1:]))
        return tensordict

    def plan(self, state: Tensor, pins: Sequence[Pin | None]) -> Tensor:
        """Plans [Q, L, D] in raw units for raw states [Q, S].

        Args:
            state (Tensor): flat and finite.
            pins (sequence of Pin): what each level is told of the target; None if nothing.
        """
        raise NotImplementedError

    def capture(self) -> Self:
        """Plans run as CUDA graphs from now on, one for each number of rows; gives itself.

        What comes before and after, such as looking up a target's episode, stays as it is, and so
        do plans of the same noise each time. Call it again where settings such as ``candidates``
        were changed. Without a GPU it changes nothing.
        """
        self._captured = CapturedPlan()
        return self

    def _planned(self, state: Tensor, pins: Sequence[Pin | None]) -> Tensor:
        if self._captured is None or self._is_seeded():
            return self.plan(state, pins)
        return self._captured(self.plan, state, pins)

    def _told(self, tensordict: TensorDictBase, rows: int) -> Told:
        """The targets of all rows, flat; they must be there."""
        target = self.normalizer.read(tensordict, self.in_keys[1])
        target = target.reshape(rows, target.shape[-1])
        found, step = (tensordict.get(key, None) for key in self.in_keys[2:4])
        if found is None or step is None:
            raise KeyError(
                f"{self.in_keys[2 if found is None else 3]!r} is missing in the tensordict; a "
                "planner with targets reads it."
            )
        row = tensordict.get(self.in_keys[4], None) if len(self.in_keys) > 4 else None
        row = None if row is None else row.reshape(rows)
        return Told(target, found.reshape(rows), step.reshape(rows), row)

    def _step_networks(self, device: torch.device) -> list[StepNetwork]:
        """The networks of the levels at the sampler's times; under autocast in its precision."""
        lower = torch.is_autocast_enabled(device.type)
        dtype = torch.get_autocast_dtype(device.type) if lower else None
        times = self.process.grid(self.steps)[:-1]

        wanted = None if self.condition is None else self.condition()  # [L]

        def make() -> list[StepNetwork]:
            each = [None] * len(self.networks) if wanted is None else wanted.split(1)
            pairs = zip(self.networks, each, strict=True)
            return [self._step_network(network, times, dtype, told) for network, told in pairs]

        if device.type != "cpu":
            return make()  # nothing is packed there, and to compare weights would wait for it
        hooked = tuple(map(is_hooked, self.networks))
        told = None if wanted is None else tuple(wanted.tolist())
        return self._frozen.get(self.networks, (dtype, hooked, told, *times), make)

    def _step_network(
        self,
        network: nn.Module,
        times: Sequence[float],
        dtype: torch.dtype | None,
        condition: Tensor | None,
    ) -> StepNetwork:
        return step_network(network, times, dtype, condition)

    # noise and candidates

    def _is_seeded(self) -> bool:
        """Whether the same noise is asked for at each call."""
        deterministic = exploration_type() == ExplorationType.DETERMINISTIC
        return self.noise == "seeded" or (self.noise == "sample" and deterministic)

    def _generator(self, device: torch.device) -> torch.Generator | None:
        """A source of the same noise at each call, where that is asked for."""
        return torch.Generator(device=device).manual_seed(0) if self._is_seeded() else None

    def _draw(
        self, rows: int, copies: int, tokens: int, generator: torch.Generator | None, like: Tensor
    ) -> Tensor:
        """Standard normal noise [rows * copies, tokens, D], or zeros."""
        shape = (rows * copies, tokens, like.shape[-1])
        if self.noise == "zero":
            return like.new_zeros(shape)
        if generator is None:
            return torch.randn(shape, device=like.device)
        # one draw for every row, so that a row does not depend on those beside it
        noise = torch.randn((copies, *shape[1:]), generator=generator, device=like.device)
        return noise.repeat(rows, 1, 1)


def best_plans(plans: Tensor, returns: Tensor) -> Tensor:
    """The plan of each row with the largest return [Q, C]: [Q, C, n, D] -> [Q, n, D]."""
    return plans[torch.arange(len(plans), device=plans.device), returns.argmax(-1)]


def _check(
    steps: int,
    temperatures: Sequence[float],
    candidates: int,
    return_model: nn.Module | None,
    noise: str,
) -> None:
    """Raises ValueError for arguments of a planner that they cannot have."""
    if steps < 1:
        raise ValueError(f"steps is {steps}; a plan needs at least one inference step.")
    if min(temperatures) < 0:
        raise ValueError(f"temperature is {min(temperatures)}; it must not be negative.")
    if candidates < 1 or (candidates > 1 and return_model is None):
        raise ValueError(
            f"candidates is {candidates}: expected 1, or more and a return_model to rank them."
        )
    if noise not in ("sample", "seeded", "zero"):
        raise ValueError(f"noise is {noise!r}; expected 'sample', 'seeded' or 'zero'.")
