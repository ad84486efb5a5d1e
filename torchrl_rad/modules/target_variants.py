"""Targets that are not chosen by return: what the target rule is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.target import OUT_KEYS

__all__ = ["PlainTargetModule"]

KEYS = (*OUT_KEYS, "target_offset", "target_source")


class PlainTargetModule(TensorDictModuleBase):
    """A target without a thought for return, in place of :class:`RetrievalTargetModule`.

    - ``rule="random"``: any recorded state (RAD's ablation -TSR).
    - ``rule="nearest"``: the most similar recorded state, where it is a neighbour (DRC, "direct
      retrieval combination").
    - ``rule="none"``: none at all; the planner fills in freely.

    It writes the keys of :class:`RetrievalTargetModule`; the offset is 0, since no demonstration is
    followed to the target.

    Args:
        database (ExpertDatabase): the demonstrations.
        rule (str): see above.
        in_keys (sequence of NestedKey, optional): the state. Defaults to ``["observation"]``.
        out_keys (sequence of NestedKey, optional): new names of the seven entries.

    Raises:
        ValueError: another rule, or another number of keys.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_rad import RetrievalSampler
        >>> database = ExpertDatabase(sampler=RetrievalSampler("euclidean", threshold=0.5))
        >>> end = {"reward": torch.zeros(2, 1), "done": torch.tensor([[False], [True]])}
        >>> state = torch.tensor([[1.0], [4.0]])
        >>> _ = database.extend(TensorDict({"observation": state, "next": end}, [2]))
        >>> select = PlainTargetModule(database, "nearest")
        >>> out = select(TensorDict({"observation": torch.tensor([[3.5], [9.0]])}, [2]))
        >>> out["target"].squeeze(-1).tolist(), out["found"].squeeze(-1).tolist()
        ([4.0, 9.0], [True, False])
    """

    def __init__(
        self,
        database: ExpertDatabase,
        rule: Literal["random", "nearest", "none"],
        in_keys: Sequence[NestedKey] = ("observation",),
        out_keys: Sequence[NestedKey] = KEYS,
    ):
        super().__init__()
        if rule not in ("random", "nearest", "none"):
            raise ValueError(f"rule is {rule!r}; expected 'random', 'nearest' or 'none'.")
        if len(in_keys) != 1 or len(out_keys) != len(KEYS):
            raise ValueError(
                f"expected one in_key and {len(KEYS)} out_keys, got {in_keys} and {out_keys}."
            )
        self.__dict__["database"] = database  # a handle, as in RetrievalTargetModule
        self.rule = rule
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the target of each row into ``tensordict`` and returns it."""
        state = tensordict.get(self.in_keys[0])
        shape = state.shape[:-1]
        query = state.reshape(shape.numel(), state.shape[-1])
        with self.database.lock:
            row, near = self._choose(query)
            hit = row >= 0
            columns = self._columns(query, row.clamp_min(0), hit)
        offset = torch.zeros_like(row)
        results = (columns[0], hit, near, columns[1], row, offset, columns[2])
        for key, result in zip(self.out_keys, results, strict=True):
            width = result.shape[-1] if result.ndim == 2 else 1
            tensordict.set(key, result.reshape(*shape, width))
        return tensordict

    def _choose(self, query: Tensor) -> tuple[Tensor, Tensor]:
        """Row, int64 [Q], -1 if none, and its similarity."""
        count, device = len(query), query.device
        row = torch.full((count,), -1, device=device)
        near = torch.full((count,), -torch.inf, device=device)
        if len(self.database) == 0:
            return row, near
        finite = query.isfinite().all(-1)
        if self.rule == "random":
            row = torch.randint(len(self.database), (count,), device=device)
            return torch.where(finite, row, -1), near
        found, similarity = self.database.sampler.nearest(self.database.storage, query, 1)
        near = similarity[:, 0].float().to(device)
        if self.rule == "none":
            return row, near
        valid = similarity[:, 0] >= self.database.sampler.threshold
        return torch.where(valid, found[:, 0], -1).to(device), near

    def _columns(self, query: Tensor, row: Tensor, hit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """State, return and source of rows; the query without NaN where there is none."""
        own = torch.nan_to_num(query, nan=0.0, posinf=0.0, neginf=0.0)
        if len(self.database) == 0:
            return own, torch.zeros_like(own[:, 0]), row[:, None].expand(-1, 2) * 0 - 1
        rows, place = self.database[:], row.to(self.database.device)
        target = rows[self.database.sampler.key][place].to(query)
        value = rows["return_to_go"][place].to(query.device)
        source = torch.stack([rows[name][place] for name in ("episode", "step")], -1).to(row)
        return (
            torch.where(hit[:, None], target, own),
            torch.where(hit, value, 0.0),
            torch.where(hit[:, None], source, -1),
        )
