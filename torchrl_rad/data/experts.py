"""Which recorded episodes are demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = [
    "Expert",
    "episode_length",
    "expert_from_config",
    "first_hit_within",
    "near_best_return",
    "reaches_goal",
    "return_at_least",
    "select_episodes",
    "subtasks_done",
    "top_share_by_return",
]


class Expert:
    """A named rule that says which episodes are demonstrations.

    Rules combine with ``&``, ``|`` and ``~``.

    Calling it with one episode (a TensorDict [L]) gives a bool. ``select`` answers for a list of
    episodes and is what :class:`~torchrl_rad.data.ExpertDatabase` asks, since some rules compare
    episodes with each other.

    Args:
        config (dict): name and arguments, from which :func:`expert_from_config` builds the rule
            again.
        predicate (callable): one episode -> bool.

    Examples:
        >>> rule = episode_length(1000) & ~reaches_goal()
        >>> rule
        (episode_length(1000) & ~reaches_goal())
    """

    def __init__(self, config: dict[str, Any], predicate: Callable[[TensorDictBase], bool]):
        self.config = config
        self.predicate = predicate

    def __call__(self, episode: TensorDictBase) -> bool:
        return bool(self.predicate(episode))

    def select(self, episodes: list[TensorDictBase]) -> Tensor:
        """Answers for each episode: bool [E]."""
        return torch.tensor([self(episode) for episode in episodes], dtype=torch.bool)

    def __and__(self, other: Expert) -> Expert:
        return _Combined("&", self, other)

    def __or__(self, other: Expert) -> Expert:
        return _Combined("|", self, other)

    def __invert__(self) -> Expert:
        return _Combined("~", self)

    def __repr__(self) -> str:
        arguments = ", ".join(str(value) for value in self.config["args"])
        return f"{self.config['rule']}({arguments})"


class _Combined(Expert):
    def __init__(self, operator: str, *parts: Expert):
        super().__init__({"rule": operator, "args": [part.config for part in parts]}, self._decide)
        self.parts = parts

    def _decide(self, episode: TensorDictBase) -> bool:
        return bool(self.select([episode])[0])

    def select(self, episodes: list[TensorDictBase]) -> Tensor:
        masks = [part.select(episodes) for part in self.parts]
        if self.config["rule"] == "~":
            return ~masks[0]
        return masks[0] & masks[1] if self.config["rule"] == "&" else masks[0] | masks[1]

    def __repr__(self) -> str:
        if self.config["rule"] == "~":
            return f"~{self.parts[0]}"
        return f"({self.parts[0]} {self.config['rule']} {self.parts[1]})"


class _ByReturn(Expert):
    """Compares episodes that come together; one alone is the best of its kind."""

    def __init__(self, rule: str, share: float, least: Callable[[Tensor], Tensor]):
        super().__init__({"rule": rule, "args": [share]}, lambda episode: True)
        self.least = least  # of the returns [E], what is enough

    def select(self, episodes: list[TensorDictBase]) -> Tensor:
        returns = torch.stack([_rewards(episode).double().sum() for episode in episodes])
        return returns >= self.least(returns)


def _rewards(episode: TensorDictBase) -> Tensor:
    return episode["next", "reward"].reshape(-1)


def episode_length(steps: int) -> Expert:
    """Episodes of exactly ``steps`` steps (the paper's rule for locomotion, 1000)."""
    config = {"rule": "episode_length", "args": [steps]}
    return Expert(config, lambda episode: episode.batch_size[0] == steps)


def first_hit_within(low: int, high: int) -> Expert:
    """Episodes that first earn a positive reward at a step in [low, high].

    The paper's rule for mazes.

    The reward of row i is that of the state after it, so that the step of the first hit is the
    row's number plus one.

    Raises:
        ValueError: ``low`` is larger than ``high``.
    """
    if low > high:
        raise ValueError(f"first_hit_within({low}, {high}) is empty: low must not exceed high.")

    def predicate(episode: TensorDictBase) -> bool:
        hit = _rewards(episode) > 0
        return bool(hit.any()) and low <= int(hit.float().argmax()) + 1 <= high

    return Expert({"rule": "first_hit_within", "args": [low, high]}, predicate)


def near_best_return(share: float) -> Expert:
    """Episodes whose undiscounted return is nearly that of the best of those added together.

    Where most episodes are bad, a share of them (:func:`top_share_by_return`) may hold bad ones.

    Args:
        share (float): how much less is good enough, as a share of the best return, in [0, 1).

    Raises:
        ValueError: ``share`` lies outside [0, 1).
    """
    if not 0.0 <= share < 1.0:
        raise ValueError(f"share is {share}; expected a number in [0, 1).")
    return _ByReturn("near_best_return", share, lambda r: r.max() - share * r.max().abs())


def reaches_goal() -> Expert:
    """Episodes that earn a positive reward at some step."""
    return Expert(
        {"rule": "reaches_goal", "args": []}, lambda episode: bool((_rewards(episode) > 0).any())
    )


def return_at_least(value: float) -> Expert:
    """Episodes whose rewards sum to ``value`` or more.

    The paper's rule for Kitchen, 3, once the rewards are tasks newly done
    (:func:`~torchrl_rad.data.relabel_tasks`).
    """
    config = {"rule": "return_at_least", "args": [value]}
    return Expert(config, lambda episode: bool(_rewards(episode).double().sum() >= value))


def subtasks_done(count: int) -> Expert:
    """Episodes whose step reward reaches ``count`` (Kitchen as recorded: tasks in place at once).

    A task that comes undone is not counted then; :func:`return_at_least` counts it.
    """
    config = {"rule": "subtasks_done", "args": [count]}
    return Expert(config, lambda episode: bool((_rewards(episode) >= count).any()))


def top_share_by_return(share: float) -> Expert:
    """The best of the episodes added together, by undiscounted return; equal ones stay together.

    Args:
        share (float): share of the episodes to keep, in (0, 1]; at least one is kept.

    Raises:
        ValueError: ``share`` lies outside (0, 1].
    """
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share is {share}; expected a number in (0, 1].")

    def least(returns: Tensor) -> Tensor:
        keep = max(1, round(share * len(returns)))
        return returns.sort(descending=True).values[keep - 1]

    return _ByReturn("top_share_by_return", share, least)


def select_episodes(
    rule: Callable[[TensorDictBase], bool], episodes: Sequence[TensorDictBase]
) -> Tensor:
    """Answers for each episode, bool [E]; a rule with ``select`` is asked for all at once.

    Args:
        rule (callable): an :class:`Expert`, or any function of one episode.
        episodes (sequence of TensorDictBase): each [L].

    Examples:
        >>> from tensordict import TensorDict
        >>> select_episodes(lambda episode: len(episode) > 1, [TensorDict({}, [n]) for n in (1, 2)])
        tensor([False,  True])
    """
    if hasattr(rule, "select"):
        return rule.select(list(episodes))
    return torch.tensor([bool(rule(episode)) for episode in episodes], dtype=torch.bool)


RULES: dict[str, Callable[..., Expert]] = {
    "episode_length": episode_length,
    "first_hit_within": first_hit_within,
    "near_best_return": near_best_return,
    "reaches_goal": reaches_goal,
    "return_at_least": return_at_least,
    "subtasks_done": subtasks_done,
    "top_share_by_return": top_share_by_return,
}


def expert_from_config(config: dict[str, Any]) -> Expert:
    """Builds a rule from its ``config``.

    Raises:
        KeyError: the rule's name is not known.
        TypeError: it takes other arguments.

    Examples:
        >>> expert_from_config({"rule": "first_hit_within", "args": [150, 600]})
        first_hit_within(150, 600)
    """
    rule, args = config["rule"], config["args"]
    if rule in ("&", "|", "~"):
        return _Combined(rule, *(expert_from_config(part) for part in args))
    if rule not in RULES:
        raise KeyError(f"unknown expert rule {rule!r}; known rules are {sorted(RULES)}.")
    return RULES[rule](*args)
