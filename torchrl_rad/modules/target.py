"""TS: the target of each state, from the expert database."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.experts import select_episodes
from torchrl_rad.data.shard_storage import ShardColumn, ShardColumns
from torchrl_rad.data.sharded import ShardedExpertDatabase
from torchrl_rad.modules.kept import KEPT, keep_or_renew, kept_primer
from torchrl_rad.retrieval.goal_rules import GoalRule
from torchrl_rad.retrieval.goals import GoalReward, GoalTable
from torchrl_rad.retrieval.rules import (
    NoisyRule,
    RankedRule,
    TargetRule,
    TolerantRule,
    followed_rule,
    highest_rule,
)
from torchrl_rad.retrieval.windowed import WindowedRule

__all__ = ["RetrievalTargetModule"]

OUT_KEYS = ("target", "found", "similarity", "target_return", "target_index")
QUERIES = 4096  # asked at a time: each has k neighbours


class _Columns(NamedTuple):
    source: object  # the search structure that they belong to
    content: tuple[int, int]  # rows of the database, and its version
    states: Tensor | ShardColumn
    rule: TargetRule


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

    With ``goal_key`` each row of the batch has a goal of its own: neighbours are rows of episodes
    that reach it, returns and ends of episodes those of :class:`~torchrl_rad.retrieval.GoalReward`,
    computed from the recorded states; the database should hold all episodes then. A goal that no
    recorded episode reaches gives no target.

    Rows of a batch are independent of each other. The database is neither a parameter nor a buffer:
    no weight synchronisation moves it, ``deepcopy`` shares it.

    ==================  ========================  ==================================================
    key                 shape, dtype              meaning
    ==================  ========================  ==================================================
    ``observation``     [*B, S], read             state, raw units
    ``goal_key``        [*B, G], read on demand   goal, in units of the state
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
    ``target_source``   [*B, 2] int64, on demand  episode and step of that neighbour, of which the
                                                  target is ``target_offset`` further on; -1 if none
    ==================  ========================  ==================================================

    Args:
        database (ExpertDatabase or ShardedExpertDatabase): the demonstrations. Of a sharded one,
            ``goal_key`` holds 16 bytes a row in memory, beside the entries compared with a goal.
        horizon (int, optional): H; a target is at most H - 1 recorded steps ahead. The planner's H,
            or less: the paper's rule does not count the way, so that with a large one it leaves
            what pays for what pays later. Defaults to ``129``.
        rule (str, optional): ``"highest"`` or ``"followed"``. Defaults to ``"highest"``.
        tolerance (float, optional): in units of return (the paper's eta). Defaults to ``0.0``.
        ahead (int, optional): steps looked ahead by ``"followed"``. Defaults to ``16``.
        retrieval_interval (int, optional): policy steps for which a row keeps its target; renewed
            where ``is_init`` is True. What is kept lies in the tensordict
            (``("retrieval", "kept")``), see :meth:`make_tensordict_primer`. Defaults to ``1``.
        min_offset (int, optional): smallest step ahead by ``"highest"``, as far as the episode
            goes. Defaults to ``0``.
        among (int, optional): the target is drawn from so many of the best ones, with torch's
            global generator, to see what a spoiled ranking costs. Defaults to ``1``: the best.
        goal_key (NestedKey, optional): the goal of each row. Defaults to none: returns are the
            recorded ones.
        goal_reward (GoalReward, optional): when a goal is reached. Defaults to within 0.5 of it.
        in_keys (sequence of NestedKey, optional): the state. Defaults to ``["observation"]``.
        out_keys (sequence of NestedKey, optional): new names, in the order of the table; a sixth
            one asks for the offset, a seventh one for the source.

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

    rule: str

    def __init__(
        self,
        database: ExpertDatabase | ShardedExpertDatabase,
        horizon: int = 129,
        rule: Literal["highest", "followed"] = "highest",
        tolerance: float = 0.0,
        ahead: int = 16,
        retrieval_interval: int = 1,
        min_offset: int = 0,
        among: int = 1,
        goal_key: NestedKey | None = None,
        goal_reward: GoalReward | None = None,
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
        if not tolerance >= 0:
            raise ValueError(f"tolerance is {tolerance}; it must not be negative.")
        if rule == "followed" and not 0 <= ahead < horizon:
            raise ValueError(f"ahead is {ahead}; expected 0 to horizon - 1 = {horizon - 1}.")
        if not 0 <= min_offset < horizon:
            raise ValueError(
                f"min_offset is {min_offset}; expected 0 to horizon - 1 = {horizon - 1}."
            )
        if retrieval_interval < 1:
            raise ValueError(f"retrieval_interval is {retrieval_interval}; expected 1 or more.")
        if len(in_keys) != 1 or len(out_keys) not in (5, 6, 7):
            raise ValueError(
                f"expected one in_key and five to seven out_keys, got {in_keys} and {out_keys}."
            )
        if among < 1 or (among > 1 and (tolerance > 0 or goal_key is not None)):
            raise ValueError(
                f"among is {among}; expected 1, or more without a tolerance and a goal_key."
            )
        if goal_key is not None and tolerance > 0:
            raise ValueError(f"tolerance is {tolerance}; with a goal_key it must be 0.")
        if goal_key is None and goal_reward is not None:
            raise ValueError("goal_reward is given without a goal_key; pass both or neither.")
        # a handle, out of reach of parameters, buffers and state_dict
        self.__dict__["database"] = database
        self.horizon, self.rule, self.tolerance, self.ahead = horizon, rule, tolerance, ahead
        self.retrieval_interval, self.min_offset = retrieval_interval, min_offset
        self.among = among
        self.goal_key = goal_key
        self.goal_reward = GoalReward() if goal_reward is None else goal_reward
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)
        if goal_key is not None:
            self.in_keys.append(goal_key)
        self.named_out = list(out_keys)
        if retrieval_interval > 1:
            self.in_keys += ["is_init", KEPT]
            self.out_keys += [("next", *KEPT)]
        self._columns: _Columns | None = None

    @dispatch(auto_batch_size=False)  # of a state alone, all of its dims would be taken
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the target of each row into ``tensordict`` and returns it.

        Raises:
            KeyError: the state or the goal is missing, or with ``retrieval_interval`` what is kept.
            ValueError: the state or the goal has another width than those of the database.
        """
        state = tensordict.get(self.in_keys[0])
        if state is None:
            raise KeyError(
                f"{self.in_keys[0]!r} is missing in the tensordict; RetrievalTargetModule reads it."
            )
        shape = state.shape[:-1]
        query = state.reshape(shape.numel(), state.shape[-1])
        goals = None if self.goal_key is None else self._goals(tensordict, shape)
        with self.database.lock:  # rows chosen and rows read are of the same content
            if self.retrieval_interval > 1:
                index, similarity, offset = self._kept(tensordict, query, goals)
            else:
                index, similarity, offset = self.select(query, goals)
            hit = index >= 0
            target, value = self._read(query, goals, index, hit)
            results = [target, hit, similarity, value, index, offset]
            if len(self.named_out) == 7:
                results.append(self._source(index, offset, hit))
        for key, result in zip(self.named_out, results, strict=False):
            width = result.shape[-1] if result.ndim == 2 else 1
            tensordict.set(key, result.reshape(*shape, width))
        return tensordict

    def _source(self, index: Tensor, offset: Tensor, hit: Tensor) -> Tensor:
        """Episode and step of the neighbours through which targets were reached, [Q, 2]."""
        if not bool(hit.any()):
            return index.new_full((len(index), 2), -1)
        rows = self.database.columns
        place = (index - offset).clamp_min(0).to(self.database.device)
        columns = [rows[name][place].to(index) for name in ("episode", "step")]
        return torch.where(hit[:, None], torch.stack(columns, -1), -1)

    def _goals(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor:
        goals = tensordict.get(self.goal_key, None)
        if goals is None:
            raise KeyError(
                f"{self.goal_key!r} is missing in the tensordict; RetrievalTargetModule reads the "
                "goal of each row there."
            )
        if goals.shape[:-1] != shape:
            raise ValueError(
                f"goals are {list(goals.shape)}, of {list(shape)} states; expected a goal a row."
            )
        return goals.reshape(shape.numel(), goals.shape[-1])

    def _read(
        self, query: Tensor, goals: Tensor | None, index: Tensor, hit: Tensor
    ) -> tuple[Tensor, Tensor]:
        """State [Q, S] and return [Q] of the rows chosen."""
        whole = bool(hit.all())
        if not whole:
            own = torch.nan_to_num(query, nan=0.0, posinf=0.0, neginf=0.0)
            if not bool(hit.any()):
                return own, torch.zeros(len(query), device=query.device)
            index = index.clamp_min(0)
        columns = self._prepare()
        place = index.to(columns.states.device)
        target = columns.states.index_select(0, place).to(query)
        value = columns.rule.value(place, goals).to(query.device)
        if not whole:
            target = torch.where(hit[:, None], target, own)
            value = torch.where(hit, value, 0.0)
        return target, value

    # the rule

    def select(self, query: Tensor, goals: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """The rule itself.

        Args:
            query (Tensor): [Q, S], raw units.
            goals (Tensor, optional): [Q, G], where there is a ``goal_key``.

        Returns:
            Row of the target (int64 [Q], -1 if none), similarity (float32 [Q]) and recorded offset
            (int64 [Q]).
        """
        if len(query) > QUERIES:
            many = [None] * len(query) if goals is None else goals.split(QUERIES)
            parts = [self.select(*part) for part in zip(query.split(QUERIES), many, strict=False)]
            return tuple(torch.cat(column) for column in zip(*parts, strict=True))  # type: ignore
        database, device = self.database, query.device
        with database.lock:
            if len(database) == 0:
                none = torch.full((len(query),), -1, device=device)
                return none, torch.full_like(none, -torch.inf, dtype=torch.float32), none * 0
            found = self._prepare().rule.choose(database.sampler, database.storage, query, goals)
        index = torch.where(found.hit, found.target, -1)
        offset = torch.where(found.hit, found.target - found.row, 0)
        return index.to(device), found.similarity.float().to(device), offset.to(device)

    def _experts(self) -> Callable[[Sequence[TensorDictBase]], Tensor] | None:
        """Which of the episodes that reach a goal are demonstrations; None for all."""
        rule = self.goal_reward.expert or self.database.expert
        asks = rule is not None and repr(rule) != "reaches_goal()"
        return partial(select_episodes, rule) if asks else None

    def _prepare(self) -> _Columns:
        """The columns of the database as it is; made anew when its search structure was."""
        database = self.database
        source = database.sampler.build(database.storage)
        content, columns = (len(database), database.version), self._columns
        if columns is None or columns.source is not source or columns.content != content:
            rows = database.columns
            rule, states = self._make_rule(rows), rows[database.sampler.key]
            self._columns = columns = _Columns(source, content, states, rule)
        return columns

    def _make_rule(self, rows: TensorDictBase | ShardColumns) -> TargetRule:
        """The rule on the content of the database, [N]."""
        ahead = self.ahead if self.rule == "followed" else None
        if self.goal_key is not None:
            database, limits = self.database, (self._experts(), self.horizon)
            about = (database.sampler.key, database.gamma, self.goal_reward)
            table = GoalTable(database.tables, *about, *limits)
            return GoalRule(table, self.horizon, self.min_offset, ahead)
        window = (self.horizon, self.min_offset, self.tolerance)
        rule: WindowedRule | RankedRule | TolerantRule
        if isinstance(rows, ShardColumns):
            rule = WindowedRule(rows["return_to_go"], rows["remaining"], *window, ahead)
        elif ahead is not None:
            rule = followed_rule(rows["return_to_go"], rows["remaining"], ahead)
        else:
            rule = highest_rule(rows["return_to_go"], rows["remaining"], *window)
        if self.among == 1:
            return rule
        assert not isinstance(rule, TolerantRule)
        return NoisyRule(rule, self.among)

    # keeping a target for several steps

    def _kept(
        self, tensordict: TensorDictBase, query: Tensor, goals: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        def select(which: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return self.select(query[which], None if goals is None else goals[which])

        finite, database = query.isfinite().all(-1), self.database
        content = (len(database), database.version)
        return keep_or_renew(tensordict, finite, self.retrieval_interval, *content, select)

    @property
    def make_tensordict_primer(self) -> Callable[[], TensorDictPrimer]:
        """Makes the environment transform that carries what is kept from step to step.

        Absent where ``retrieval_interval`` is 1: a collector asks every module that has it.
        """
        if self.retrieval_interval == 1:
            raise AttributeError("make_tensordict_primer: retrieval_interval=1 keeps nothing")
        return kept_primer

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_columns": None}

    def __repr__(self) -> str:
        names = ("rule", "horizon", "tolerance", "ahead", "min_offset", "retrieval_interval")
        settings = ", ".join(f"{name}={getattr(self, name)!r}" for name in names)
        return (
            f"RetrievalTargetModule({settings}, in_keys={self.in_keys}, out_keys={self.out_keys})"
        )
