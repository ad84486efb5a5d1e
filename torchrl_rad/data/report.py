"""A report on recorded data: what it holds, and what would make training on it wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.spatial import cKDTree
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_rad.data.experts import select_episodes

__all__ = ["DataReport", "describe_rows", "report"]

SCHEMA = {  # entry: (dtype, shape)
    "observation": (torch.float32, "[T, S]"),
    "action": (torch.float32, "[T, A]"),
    "episode": (torch.int64, "[T]"),
    ("next", "observation"): (torch.float32, "[T, S]"),
    ("next", "reward"): (torch.float32, "[T, 1]"),
    ("next", "terminated"): (torch.bool, "[T, 1]"),
    ("next", "truncated"): (torch.bool, "[T, 1]"),
    ("next", "done"): (torch.bool, "[T, 1]"),
}
NUMBERS = ("observation", "action", ("next", "observation"), ("next", "reward"))
FLAGS = ("terminated", "truncated", "done")
NEAR = 0.5  # a start state counts as covered within this distance (the goal radius of the mazes)
SHOWN = 5  # places named in one line
NAN = float("nan")


@dataclass
class DataReport:
    """What :func:`report` found.

    ``faults`` make training wrong; ``warnings`` are facts to know. Shares lie in [0, 1]; what was
    not asked for is None. The three numbers of ``length`` and ``returns`` (undiscounted sums of the
    rewards) are minimum, mean and maximum. ``duplicate_rows`` is the share of rows that repeat an
    earlier one (observation, action, next observation and reward).

    Examples:
        >>> found = DataReport(episodes=2, steps=10, faults=["no end"])
        >>> found.ok
        False
        >>> print(found)
        10 steps in 2 episodes: 1 fault
          length                   nan / nan / nan (min / mean / max)
          return                   nan / nan / nan (min / mean / max)
          repeated rows            0.0 %
          actions outside [-1, 1]  0.0 %
          FAULT no end
    """

    episodes: int = 0
    steps: int = 0
    length: tuple[float, float, float] = (NAN, NAN, NAN)
    returns: tuple[float, float, float] = (NAN, NAN, NAN)
    constant_observation: list[int] = field(default_factory=list)
    constant_action: list[int] = field(default_factory=list)
    duplicate_episodes: int = 0
    duplicate_rows: float = 0.0
    actions_outside: float = 0.0
    expert_share: float | None = None
    coverage: float | None = None
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether there is no fault."""
        return not self.faults

    def __str__(self) -> str:
        count = len(self.faults)
        verdict = "no faults" if count == 0 else f"{count} fault{'s' * (count > 1)}"
        three = "{:.6g} / {:.6g} / {:.6g} (min / mean / max)"
        facts = {
            "length": three.format(*self.length),
            "return": three.format(*self.returns),
            "repeated rows": f"{self.duplicate_rows:.1%}".replace("%", " %"),
            "actions outside [-1, 1]": f"{self.actions_outside:.1%}".replace("%", " %"),
        }
        if self.expert_share is not None:
            facts["expert episodes"] = f"{self.expert_share:.1%}".replace("%", " %")
        if self.coverage is not None:
            facts["start states covered"] = f"{self.coverage:.1%}".replace("%", " %")
        lines = [f"{self.steps} steps in {self.episodes} episodes: {verdict}"]
        lines += [f"  {name:<25}{value}" for name, value in facts.items()]
        lines += [f"  FAULT {fault}" for fault in self.faults]
        lines += [f"  note: {warning}" for warning in self.warnings]
        return "\n".join(lines)


def report(
    td: TensorDictBase,
    expert: Callable[[TensorDictBase], bool] | None = None,
    starts: Tensor | None = None,
) -> DataReport:
    """Examines recorded data before anything is trained on it.

    Faults are NaN/Inf, flags that contradict each other (``done`` against ``terminated |
    truncated``, inside an episode, missing at its end), an episode whose rows do not lie together,
    a next observation that is not the observation of the next row, episodes recorded twice, an
    entry of another dtype or shape, observations or actions that never change, and an expert rule
    that keeps nothing. Each is named with the episode and the step where it lies. Single constant
    features, actions outside [-1, 1], rewards that are all 0 and starts far from the data are
    warnings.

    Args:
        td (TensorDict): [T], one row a step: ``observation`` [T, S], ``action`` [T, A] float32,
            ``episode`` [T] int64, ``("next", "observation")`` [T, S] and ``("next", "reward")``
            [T, 1] float32, ``("next", "terminated")``, ``("next", "truncated")`` and
            ``("next", "done")`` [T, 1] bool.
        expert (callable, optional): one episode (TensorDict [L]) -> bool, whether it is a
            demonstration; or a rule with ``select``, which sees all episodes at once.
        starts (Tensor, optional): [M, S'] start states of the evaluation, S' <= S. One is covered
            if a recorded state lies within 0.5 of it in the first S' dimensions.

    Raises:
        KeyError: an entry of the table is missing.
        ValueError: ``starts`` is not [M, S'] with S' <= S, or holds NaN/Inf.

    Examples:
        >>> from tensordict import TensorDict
        >>> end = torch.tensor([[False], [True]])
        >>> steps = TensorDict({
        ...     "observation": torch.tensor([[0.0], [1.0]]),
        ...     "action": torch.tensor([[0.5], [-0.5]]),
        ...     "episode": torch.tensor([3, 3]),
        ...     "next": {"observation": torch.tensor([[7.0], [2.0]]), "reward": torch.ones(2, 1),
        ...              "terminated": torch.zeros_like(end), "truncated": end, "done": end}}, [2])
        >>> found = report(steps, starts=torch.tensor([[1.2], [9.0]]))
        >>> found.returns, found.coverage, found.ok
        ((2.0, 2.0, 2.0), 0.5, False)
        >>> found.faults
        ["('next', 'observation') is not the next row's observation at 1 row: episode 3 step 0"]
    """
    missing = [key for key in SCHEMA if td.get(key, None) is None]
    if missing:
        raise KeyError(
            f"entries {missing} are missing; the data has {sorted(map(str, td.keys(True, True)))}. "
            "Load it with one of the loaders, or add the entries."
        )
    if len(td) == 0:
        return DataReport(faults=["there are no steps"])
    ids, segment, lengths = _segments(td["episode"])
    duplicates, duplicate_rows, repeats = _repeated(td, ids, segment, lengths)
    found = DataReport(
        episodes=len(torch.unique(ids)),
        steps=len(td),
        length=_three(lengths.double()),
        returns=_three(_returns(td, segment, len(lengths))),
        constant_observation=_constant(td["observation"]),
        constant_action=_constant(td["action"]),
        duplicate_episodes=duplicates,
        duplicate_rows=duplicate_rows,
        actions_outside=_outside(td).double().mean().item(),
        faults=[*_schema(td), *_not_finite(td), *_flags(td, lengths), *_split(ids, lengths)],
    )
    found.faults += _broken_chain(td, segment) + repeats
    _constants(td, found)
    _examine_rewards_and_actions(td, found)
    _examine_experts(td, lengths, expert, found)
    _examine_starts(td, starts, found)
    return found


def describe_rows(episode: Tensor, rows: Tensor) -> str:
    """Names rows of a flat table by episode and step, the first few of them.

    Args:
        episode (Tensor): int64 [T], id of each row's episode.
        rows (Tensor): bool [T], which rows to name.

    Examples:
        >>> describe_rows(torch.tensor([4, 4, 4, 9]), torch.tensor([False, False, True, True]))
        '2 rows: episode 4 step 2, episode 9 step 0'
    """
    _, segment, lengths = _segments(episode)
    first = lengths.cumsum(0) - lengths
    at = rows.nonzero().squeeze(-1)
    places = [
        f"episode {episode[row].item()} step {(row - first[segment[row]]).item()}"
        for row in at[:SHOWN]
    ]
    return f"{len(at)} row{'s' * (len(at) != 1)}: {_listed(places, len(at))}"


def _listed(places: list[str], count: int) -> str:
    more = [f"and {count - len(places)} more"] if count > len(places) else []
    return ", ".join(places + more)


def _segments(episode: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Runs of equal ids: id [E], run of each row [T], length [E]."""
    return torch.unique_consecutive(episode.reshape(-1), return_inverse=True, return_counts=True)


def _three(values: Tensor) -> tuple[float, float, float]:
    return values.min().item(), values.mean().item(), values.max().item()


def _returns(td: TensorDictBase, segment: Tensor, count: int) -> Tensor:
    reward = td["next", "reward"].reshape(len(td), -1)[:, 0].double()
    return reward.new_zeros(count).index_add_(0, segment, reward)


def _constant(values: Tensor) -> list[int]:
    """Features that are equal in all rows; a single row says nothing."""
    values = values.reshape(len(values), -1)
    if len(values) < 2:
        return []
    low, high = values.aminmax(dim=0)
    return (low == high).nonzero().squeeze(-1).tolist()


def _outside(td: TensorDictBase) -> Tensor:
    return (td["action"].reshape(len(td), -1).abs() > 1.0).any(-1)


def _flag(td: TensorDictBase, name: str) -> Tensor:
    return td["next", name].reshape(len(td), -1)[:, 0].bool()


def _schema(td: TensorDictBase) -> list[str]:
    faults = []
    for key, (dtype, shape) in SCHEMA.items():
        value = td[key]
        if value.dtype != dtype:
            faults.append(f"{key!r} is {value.dtype}, expected {dtype}")
        wide = value.dim() > 1 and value.shape[1] != 1
        if value.dim() != shape.count(",") + 1 or (shape == "[T, 1]" and wide):
            faults.append(f"{key!r} has shape {list(value.shape)}, expected {shape}")
    now, following = td["observation"], td["next", "observation"]
    if now.shape != following.shape:
        faults.append(
            f"'observation' has shape {list(now.shape)}, "
            f"but ('next', 'observation') has {list(following.shape)}"
        )
    return faults


def _not_finite(td: TensorDictBase) -> list[str]:
    faults = []
    for key in NUMBERS:
        bad = ~td[key].reshape(len(td), -1).isfinite().all(-1)
        if bad.any():
            faults.append(f"NaN or Inf in {key!r} at {describe_rows(td['episode'], bad)}")
    return faults


def _flags(td: TensorDictBase, lengths: Tensor) -> list[str]:
    terminated, truncated, done = (_flag(td, name) for name in FLAGS)
    last = torch.zeros_like(done)
    last[lengths.cumsum(0) - 1] = True
    ended = done | terminated | truncated
    rules = {
        "done is not terminated | truncated": done != (terminated | truncated),
        "an episode goes on after done": ended & ~last,
        "an episode does not end with done": last & ~ended,
    }
    return [
        f"{name} at {describe_rows(td['episode'], rows)}"
        for name, rows in rules.items()
        if rows.any()
    ]


def _split(ids: Tensor, lengths: Tensor) -> list[str]:
    """Ids that come back after another one."""
    order = torch.argsort(ids, stable=True)
    again = order[1:][ids[order[1:]] == ids[order[:-1]]].sort().values
    first = lengths.cumsum(0) - lengths
    places = [f"episode {ids[i].item()} comes back at row {first[i].item()}" for i in again[:SHOWN]]
    if not places:
        return []
    return [f"the rows of an episode do not lie together: {_listed(places, len(again))}"]


def _broken_chain(td: TensorDictBase, segment: Tensor) -> list[str]:
    """Rows whose next observation is not the next row's observation, inside an episode."""
    now, following = td["observation"], td["next", "observation"]
    if now.shape != following.shape or len(td) < 2:
        return []
    now, following = now.reshape(len(td), -1), following.reshape(len(td), -1)
    differs = (following[:-1] != now[1:]).any(-1) & (segment[:-1] == segment[1:])
    at = differs.nonzero().squeeze(-1)  # few: the tolerance is looked at only there
    later, next_row = following[at].double(), now[at + 1].double()
    close = torch.isclose(later, next_row, rtol=1e-5, atol=1e-6, equal_nan=True).all(-1)
    broken = torch.zeros(len(td), dtype=torch.bool)
    broken[at[~close]] = True
    if not broken.any():
        return []
    where = describe_rows(td["episode"], broken)
    return [f"('next', 'observation') is not the next row's observation at {where}"]


def _mix(value: Tensor) -> Tensor:
    """Scrambles int64 (as splitmix64 ends), so that sums and chains of them hardly ever collide."""
    value = (value ^ (value >> 30)) * -4658895280553007687
    value = (value ^ (value >> 27)) * -7723592293110705685
    return value ^ (value >> 31)


def _row_hash(td: TensorDictBase) -> Tensor:
    """64 bits of each row's content: int64 [T]. Sorting these is far cheaper than sorting rows."""
    code = torch.zeros(len(td), dtype=torch.int64)
    for key in NUMBERS:
        # adding 0 makes -0.0 and 0.0 one content
        bits = (td[key].reshape(len(td), -1).float() + 0.0).contiguous().view(torch.int32)
        for column in bits.unbind(-1):
            code = _mix((code ^ column) + 0x1E3779B97F4A7C15)
    return code


def _repeated(
    td: TensorDictBase, ids: Tensor, segment: Tensor, lengths: Tensor
) -> tuple[int, float, list[str]]:
    """Number of repeated episodes, share of repeated rows, the fault that names the episodes."""
    code = _row_hash(td)
    share = 1.0 - len(torch.unique(code)) / len(code)
    step = torch.arange(len(code)) - (lengths.cumsum(0) - lengths)[segment]
    whole = torch.zeros(len(ids), dtype=torch.int64).index_add_(
        0, segment, _mix(code + _mix(step + 1))
    )
    order = torch.argsort(whole, stable=True)  # stable: the first of equal episodes comes first
    same = whole[order[1:]] == whole[order[:-1]]
    pairs = sorted(zip(order[1:][same].tolist(), order[:-1][same].tolist(), strict=True))
    if not pairs:
        return 0, share, []
    places = [
        f"episode {ids[late].item()} repeats episode {ids[early].item()} "
        f"from step 0 on ({lengths[late].item()} steps)"
        for late, early in pairs[:SHOWN]
    ]
    return len(pairs), share, [f"episodes with identical content: {_listed(places, len(pairs))}"]


def _constants(td: TensorDictBase, found: DataReport) -> None:
    for key, dims in (
        ("observation", found.constant_observation),
        ("action", found.constant_action),
    ):
        if not dims:
            continue
        width = td[key].reshape(len(td), -1).shape[-1]
        if len(dims) == width:
            found.faults.append(f"{key!r} is the same in all {len(td)} rows")
        else:
            found.warnings.append(f"{key!r} never changes in dimensions {dims} of {width}")


def _examine_rewards_and_actions(td: TensorDictBase, found: DataReport) -> None:
    if not td["next", "reward"].any():
        found.warnings.append("every reward is 0: label the data before retrieving from it")
    outside = _outside(td)
    if outside.any():
        found.warnings.append(f"actions outside [-1, 1] at {describe_rows(td['episode'], outside)}")


def _examine_experts(td: TensorDictBase, lengths: Tensor, expert, found: DataReport) -> None:
    if expert is None:
        return
    episodes = td.split(lengths.tolist())
    kept = int(select_episodes(expert, episodes).sum())
    found.expert_share = kept / len(episodes)
    if kept == 0:
        name = getattr(expert, "__name__", expert)
        found.faults.append(f"the expert rule {name} keeps none of {len(episodes)} episodes")


def _examine_starts(td: TensorDictBase, starts: Tensor | None, found: DataReport) -> None:
    if starts is None:
        return
    states = td["observation"].reshape(len(td), -1)
    if starts.dim() != 2 or not 0 < starts.shape[-1] <= states.shape[-1] or len(starts) == 0:
        raise ValueError(
            f"starts has shape {list(starts.shape)}; expected [M, S'] with M >= 1 and "
            f"1 <= S' <= {states.shape[-1]}, the width of the observation."
        )
    if not starts.isfinite().all():
        raise ValueError("starts holds NaN or Inf; pass finite start states.")
    states = states[:, : starts.shape[-1]]
    states = states[states.isfinite().all(-1)].double().numpy()
    # Split at the middle, not the median: faster to build, and safe where many states are equal.
    tree = cKDTree(states, balanced_tree=False, compact_nodes=False)
    bound = np.nextafter(NEAR, 1.0)  # scipy's bound is exclusive
    distance, _ = tree.query(starts.double().cpu().numpy(), distance_upper_bound=bound)
    far = ~np.isfinite(distance)
    found.coverage = 1.0 - far.mean().item()
    if far.any():
        place = starts[int(far.argmax())].tolist()
        found.warnings.append(
            f"{int(far.sum())} of {len(far)} start states have no recorded state within {NEAR}, "
            f"the first is start {int(far.argmax())} at {[round(x, 3) for x in place]}"
        )
