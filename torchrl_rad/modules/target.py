"""TS: the target of each state, from the expert database."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Unbounded
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_rad.data.database import ExpertDatabase

__all__ = ["RetrievalTargetModule"]

OUT_KEYS = ("target", "found", "similarity", "target_return", "target_index")


class RetrievalTargetModule(TensorDictModuleBase):
    r"""Chooses a close, rewarding and long-lasting demonstration state for each state.

    RAD's "Target Selection". For one state: its neighbours :math:`C_s` are the rows that
    :class:`~torchrl_rad.retrieval.RetrievalSampler` finds.

    - ``rule="highest"``, the paper's: candidates are the rows ``i + min_offset`` to
      ``i + horizon - 1`` of each neighbour's own episode (cut at its end); of those whose return
      is at most ``tolerance`` below the best, the one with the most steps left, then the larger
      return, then the lower row.
    - ``rule="followed"``: the neighbour with the largest return of its own is followed; the target
      is the row with the largest return among it and the next ``ahead`` rows of its episode (ties:
      more steps left).

    Rows of a batch are independent of each other. The database is neither a parameter nor a buffer:
    no weight synchronisation moves it, ``deepcopy`` shares it.

    ==================  ========================  ==================================================
    key                 shape, dtype              meaning
    ==================  ========================  ==================================================
    ``observation``     [*B, S], read             state, raw units
    ``target``          [*B, S] of its dtype      recorded state, raw units; the observation itself
                                                  if none was found
    ``found``           [*B, 1] bool              False: no neighbour, NaN or Inf in the state,
                                                  empty database
    ``similarity``      [*B, 1] float32           of the neighbour through which the target was
                                                  reached; the best there was if none was found
                                                  (-inf if there is none)
    ``target_return``   [*B, 1] float32           return from the target on; 0 if none was found
    ``target_index``    [*B, 1] int64             row of the database; -1 if none was found
    ``target_offset``   [*B, 1] int64, on demand  recorded steps from that neighbour to the target;
                                                  0 if none
    ==================  ========================  ==================================================

    Args:
        database (ExpertDatabase): the demonstrations.
        horizon (int, optional): H of the planner; a target is at most H - 1 recorded steps ahead.
            Defaults to ``129``.
        rule (str, optional): ``"highest"`` or ``"followed"``. Defaults to ``"highest"``.
        tolerance (float, optional): in units of return (the paper's eta). Defaults to ``0.0``.
        ahead (int, optional): steps looked ahead by ``"followed"``. Defaults to ``16``.
        retrieval_interval (int, optional): policy steps for which a row keeps its target; renewed
            where ``is_init`` is True. What is kept lies in the tensordict
            (``("retrieval", "kept")``), see :meth:`make_tensordict_primer`. Defaults to ``1``.
        min_offset (int, optional): smallest step ahead by ``"highest"``, as far as the episode
            goes. Defaults to ``0``.
        in_keys (sequence of NestedKey, optional): the state. Defaults to ``["observation"]``.
        out_keys (sequence of NestedKey, optional): new names, in the order of the table; a sixth
            one asks for the offset.

    Raises:
        ValueError: an argument has a value that it cannot have.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_rad import RetrievalSampler
        >>> sampler = RetrievalSampler("euclidean", k=1)
        >>> database = ExpertDatabase(LazyTensorStorage(10), gamma=0.5, sampler=sampler)
        >>> end = {
        ...     "reward": torch.tensor([[0.0], [0.0], [1.0]]),
        ...     "done": torch.tensor([[False], [False], [True]]),
        ... }
        >>> state = torch.tensor([[0.0], [1.0], [2.0]])
        >>> _ = database.extend(TensorDict({"observation": state, "next": end}, [3]))
        >>> select = RetrievalTargetModule(database, horizon=3)
        >>> out = select(TensorDict({"observation": torch.tensor([[0.1], [9.0]])}, [2]))
        >>> out["target"].squeeze(-1).tolist(), out["found"].squeeze(-1).tolist()
        ([2.0, 9.0], [True, False])
    """

    def __init__(
        self,
        database: ExpertDatabase,
        horizon: int = 129,
        rule: Literal["highest", "followed"] = "highest",
        tolerance: float = 0.0,
        ahead: int = 16,
        retrieval_interval: int = 1,
        min_offset: int = 0,
        in_keys: Sequence[NestedKey] = ("observation",),
        out_keys: Sequence[NestedKey] = OUT_KEYS,
    ):
        super().__init__()
        if rule not in ("highest", "followed"):
            raise ValueError(f"rule is {rule!r}; expected 'highest' or 'followed'.")
        if horizon < 2:
            raise ValueError(
                f"horizon is {horizon}; a target lies at least one step ahead: use 2 or more."
            )
        if tolerance < 0:
            raise ValueError(f"tolerance is {tolerance}; it must not be negative.")
        if rule == "followed" and not 0 <= ahead < horizon:
            raise ValueError(f"ahead is {ahead}; expected 0 to horizon - 1 = {horizon - 1}.")
        if not 0 <= min_offset < horizon:
            raise ValueError(
                f"min_offset is {min_offset}; expected 0 to horizon - 1 = {horizon - 1}."
            )
        if retrieval_interval < 1:
            raise ValueError(f"retrieval_interval is {retrieval_interval}; expected 1 or more.")
        if len(in_keys) != 1 or len(out_keys) not in (5, 6):
            raise ValueError(
                f"expected one in_key and five or six out_keys, got {in_keys} and {out_keys}."
            )
        # a handle, out of reach of parameters, buffers and state_dict
        self.__dict__["database"] = database
        self.horizon, self.rule, self.tolerance, self.ahead = horizon, rule, tolerance, ahead
        self.retrieval_interval, self.min_offset = retrieval_interval, min_offset
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        self.named_out = list(out_keys)
        if retrieval_interval > 1:
            self.in_keys += ["is_init", ("retrieval", "kept")]
            self.out_keys += [("next", "retrieval", "kept")]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the target of each row into ``tensordict`` and returns it."""
        state = tensordict.get(self.in_keys[0])
        if state is None:
            raise KeyError(
                f"{self.in_keys[0]!r} is missing in the tensordict; RetrievalTargetModule reads it."
            )
        shape = state.shape[:-1]
        query = state.reshape(-1, state.shape[-1])
        if self.retrieval_interval > 1:
            found = self._kept(tensordict, query)
        else:
            found = self.select(query)
        index, similarity, offset = found
        row = index.clamp_min(0)
        table = self.database[:] if len(self.database) else None
        hit = index >= 0
        device = query.device
        if table is None:
            target, value = query, torch.zeros_like(similarity)
        else:
            place = row.to(self.database.device)
            target = table[self.database.sampler.key][place].to(query)
            value = table["return_to_go"][place].to(device)
        finite = torch.nan_to_num(query, nan=0.0, posinf=0.0, neginf=0.0)
        target = torch.where(hit[:, None], target, finite)
        value = torch.where(hit, value, 0.0)
        results = (target, hit, similarity, value, index, offset)
        for key, result in zip(self.named_out, results, strict=False):
            tensordict.set(key, result.reshape(*shape, -1))
        return tensordict

    # the rule

    def select(self, query: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The rule itself.

        Args:
            query (Tensor): [Q, S], raw units.

        Returns:
            Row of the target (int64 [Q], -1 if none), similarity (float32 [Q]) and recorded offset
            (int64 [Q]).
        """
        database = self.database
        near, similar = database.sampler.nearest(database.storage, query)  # [Q, k]
        if near.shape[-1] == 0:
            none = torch.full((len(query),), -1, device=query.device)
            return none, torch.full_like(none, -torch.inf, dtype=torch.float32), none * 0
        valid = (similar >= database.sampler.threshold) & (near >= 0)
        rows = near.clamp_min(0)
        choose = self._highest if self.rule == "highest" else self._followed
        target, anchor = choose(rows, valid)  # row [Q], place of its neighbour in C_s [Q]
        hit = valid.any(-1)
        anchor = torch.where(hit, anchor, 0)[:, None]
        similarity = similar.gather(-1, anchor).squeeze(-1).float()
        offset = torch.where(hit, target - rows.gather(-1, anchor).squeeze(-1), 0)
        index = torch.where(hit, target, -1)
        return index.to(query.device), similarity.to(query.device), offset.to(query.device)

    def _highest(self, rows: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        remaining = self.database[:]["remaining"]
        table = self.database.window_max(self.horizon)
        left = remaining[rows]
        low = rows + left.clamp_max(self.min_offset)
        high = rows + left.clamp_max(self.horizon - 1)  # inside the neighbour's own episode
        best = torch.where(valid, table.max(low, high), -torch.inf)
        top = best.amax(-1, keepdim=True)
        # inside one episode the first row within tolerance is the one with the most steps left
        first = table.first(low, high, top, self.tolerance).minimum(high)
        fits = valid & (top - best <= self.tolerance)
        longest = torch.where(fits, remaining[first], -1)
        fits &= longest == longest.amax(-1, keepdim=True)
        value = torch.where(fits, table.values[first], -torch.inf)
        fits &= value == value.amax(-1, keepdim=True)
        target = torch.where(fits, first, torch.iinfo(torch.int64).max).amin(-1)
        # neighbours are ordered: the first that reaches the target is the most similar one
        reaches = valid & (low <= target[:, None]) & (target[:, None] <= high)
        return target, reaches.int().argmax(-1)

    def _followed(self, rows: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        remaining = self.database[:]["remaining"]
        table = self.database.window_max(self.ahead + 1)
        value = torch.where(valid, table.values[rows], -torch.inf)
        anchor = value.argmax(-1)  # the first of equals: more similar, then the lower row
        low = rows.gather(-1, anchor[:, None]).squeeze(-1)
        high = low + remaining[low].clamp_max(self.ahead)
        return table.first(low, high, table.max(low, high), 0.0), anchor

    # keeping a target for several steps

    def _kept(self, tensordict: TensorDictBase, query: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        kept = tensordict.get(("retrieval", "kept")).reshape(-1, 4)
        age = kept[:, 3]  # before it index, similarity, offset
        fresh = tensordict.get("is_init").reshape(-1)
        fresh = fresh | (age >= self.retrieval_interval) | (age == 0)
        # a kept target comes one recorded step nearer with each step
        state = kept + kept.new_tensor([0.0, 0.0, -1.0, 1.0])
        if fresh.any():
            renewed = torch.stack([value.double() for value in self.select(query[fresh])], -1)
            state[fresh] = torch.nn.functional.pad(renewed, (0, 1), value=1.0)
        tensordict.set(("next", "retrieval", "kept"), state.reshape(*tensordict.batch_size, 4))
        return state[:, 0].long(), state[:, 1].float(), state[:, 2].long()

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The environment transform that carries what is kept from step to step.

        Needed where ``retrieval_interval`` is larger than 1.
        """
        spec = Unbounded((4,), dtype=torch.float64)
        return TensorDictPrimer({("retrieval", "kept"): spec}, default_value=0.0, expand_specs=True)

    def extra_repr(self) -> str:
        names = ("rule", "horizon", "tolerance", "ahead", "min_offset", "retrieval_interval")
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
