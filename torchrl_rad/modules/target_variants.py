"""Targets that are not chosen by return: what the target rule is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.modules.target import OUT_KEYS, RetrievalTargetModule
from torchrl_rad.retrieval.rules import Choice, TargetRule
from torchrl_rad.retrieval.sampler import RetrievalSampler

__all__ = ["PlainTargetModule"]

KEYS = (*OUT_KEYS, "target_offset", "target_source")


class PlainTargetModule(RetrievalTargetModule):
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
        if rule not in ("random", "nearest", "none"):
            raise ValueError(f"rule is {rule!r}; expected 'random', 'nearest' or 'none'.")
        if len(in_keys) != 1 or len(out_keys) != len(KEYS):
            raise ValueError(
                f"expected one in_key and {len(KEYS)} out_keys, got {in_keys} and {out_keys}."
            )
        super().__init__(database, in_keys=in_keys, out_keys=out_keys)
        self.rule = rule

    def _make_rule(self, rows: Any) -> TargetRule:
        return PlainRule(self.rule, rows["return_to_go"])


class PlainRule(NamedTuple):
    """The rule of :class:`PlainTargetModule`.

    Attributes:
        name: ``"random"``, ``"nearest"`` or ``"none"``.
        values: float32 [N], returns.
    """

    name: str
    values: Tensor

    def choose(
        self, sampler: RetrievalSampler, storage: Any, query: Tensor, goals: Tensor | None = None
    ) -> Choice:
        """As :meth:`~torchrl_rad.retrieval.rules.TargetRule.choose`."""
        if self.name == "random":
            row = torch.randint(len(storage), (len(query),), device=self.values.device)
            near = torch.full_like(row, -torch.inf, dtype=torch.float64)
            return Choice(row, row, near, query.isfinite().all(-1).to(row.device))
        rows, nears = sampler.nearest(storage, query, 1)
        row, near = rows[:, 0], nears[:, 0]
        hit = (near >= sampler.threshold) & (self.name == "nearest")
        return Choice(row, row, near, hit)

    def value(self, rows: Tensor, goals: Tensor | None = None) -> Tensor:
        """As :meth:`~torchrl_rad.retrieval.rules.TargetRule.value`."""
        return self.values.index_select(0, rows)
