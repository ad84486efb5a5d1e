"""Scoring a policy: one full episode of every row, then means with intervals."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy import stats
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase

__all__ = [
    "episode_results",
    "evaluate",
    "interval",
    "measure_latency",
    "steps_inside",
    "summarise",
]

KEPT = (
    "observation", "goal", "action", "target", "found", "similarity", "target_return",
    "target_index", "target_offset", "target_source", "target_step",
)  # fmt: skip


def evaluate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    max_steps: int,
    progress: Callable[[], Any] | None = None,
) -> TensorDict:
    """Lets a policy act for one episode in each row of a batched environment.

    Each row counts once, whatever the length of its episode: collecting a fixed number of finished
    episodes would favour short ones. A row that has ended waits for the others.

    Args:
        env (EnvBase): [n] rows, seeded.
        policy (callable): reads and writes a tensordict.
        max_steps (int): limit of an episode.
        progress (callable, optional): called at each step.

    Returns:
        TensorDict [n, T] with ``observation``, ``action``, the goal, what TS and SE wrote, and
        under ``"next"`` ``observation``, ``reward``, ``done``. Steps after a row's end have
        ``done`` True.

    Examples:
        >>> from torchrl.envs import GymEnv, SerialEnv
        >>> env = SerialEnv(2, lambda: GymEnv("CartPole-v1"))
        >>> steps = evaluate(env, lambda td: env.rand_action(td), max_steps=500)
        >>> bool(steps["next", "done"][:, -1].all())
        True
    """

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        acted = policy(tensordict)
        if progress is not None:
            progress()
        # plans of every step would fill the memory
        return acted.exclude("plan")

    with torch.no_grad():
        steps = env.rollout(
            max_steps,
            act,
            break_when_any_done=False,
            break_when_all_done=True,
        )
    kept = [key for key in KEPT if key in steps.keys()]
    following = steps["next"].select("observation", "reward", "done")
    return TensorDict({**{key: steps[key] for key in kept}, "next": following}, steps.batch_size)


def steps_inside(steps: TensorDictBase) -> np.ndarray:
    """Which steps [n, T] belong to an episode: those up to its first ``done``, that one included.

    Examples:
        >>> done = torch.tensor([[False, True, False]]).unsqueeze(-1)
        >>> steps_inside(TensorDict({"next": {"done": done}}, [1, 3]))
        array([[ True,  True, False]])
    """
    done = steps["next", "done"].squeeze(-1).cpu().numpy()
    length = np.where(done.any(1), done.argmax(1) + 1, done.shape[1])
    return np.arange(done.shape[1]) < length[:, None]


def episode_results(steps: TensorDictBase) -> dict[str, np.ndarray]:
    """What each episode came to, up to its first ``done``, that step included.

    Args:
        steps (TensorDictBase): [n, T] of :func:`evaluate`.

    Returns:
        Arrays [n]: ``return``; ``length``; ``success`` (a positive reward was earned); ``arrival``
        (the step of the first one, NaN if none); ``share`` (of the steps from there on that earned
        one, NaN if none); ``found`` and ``similarity`` (means over steps, where the policy
        retrieves; over those that had a similarity, NaN if none).

    Examples:
        >>> reward = torch.tensor([[0.0, 1.0, 0.0, 1.0, 5.0]]).unsqueeze(-1)
        >>> done = torch.tensor([[False, False, False, True, True]]).unsqueeze(-1)
        >>> steps = TensorDict({"next": {"reward": reward, "done": done}}, [1, 5])
        >>> results = episode_results(steps)
        >>> [float(results[key][0].round(2)) for key in ("return", "length", "arrival", "share")]
        [2.0, 4.0, 2.0, 0.67]
    """
    reward = steps["next", "reward"].squeeze(-1).cpu().double().numpy()
    inside = steps_inside(steps)
    length = inside.sum(1)
    paid = (reward > 0) & inside
    success = paid.any(1)
    arrival = np.where(success, paid.argmax(1) + 1.0, np.nan)
    results = {
        "return": np.where(inside, reward, 0.0).sum(1),
        "length": length.astype(float),
        "success": success.astype(float),
        "arrival": arrival,
        "share": paid.sum(1) / (length - arrival + 1),
    }
    if "found" in steps.keys():
        found = steps["found"].squeeze(-1).cpu().numpy()
        results["found"] = (found & inside).sum(1) / length
        similarity = steps["similarity"].squeeze(-1).cpu().double().numpy()
        finite = np.isfinite(similarity) & inside
        count = np.where(finite.any(1), finite.sum(1), np.nan)
        results["similarity"] = np.where(finite, similarity, 0.0).sum(1) / count
    return results


def interval(values: Sequence[float] | np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Mean and half width of its Student t interval, NaN for less than two entries.

    NaN entries do not count.

    Examples:
        >>> mean, half = interval([1.0, 2.0, 3.0])
        >>> round(mean, 2), round(half, 2)
        (2.0, 2.48)
    """
    kept = np.asarray(values, dtype=float)
    kept = kept[np.isfinite(kept)]
    if len(kept) < 2:
        return (float(kept.mean()) if len(kept) else float("nan")), float("nan")
    half = stats.t.ppf(0.5 + level / 2, len(kept) - 1) * kept.std(ddof=1) / np.sqrt(len(kept))
    return float(kept.mean()), float(half)


def summarise(
    results: dict[str, np.ndarray],
    score: Callable[[np.ndarray], np.ndarray],
    names: Sequence[str] = ("success", "arrival", "share"),
) -> dict[str, float]:
    """Figures of a table row: means over episodes, the score with its 95 % interval.

    Args:
        results (dict): of :func:`episode_results`.
        score (callable): return -> normalised score.
        names (sequence of str, optional): further figures; those of retrieval come where there are
            any. Defaults to those of mazes.
    """
    mean, half = interval(score(results["return"]))
    figures = {"return": float(results["return"].mean()), "score": mean, "interval": half}
    for key in (*names, "found", "similarity"):
        if key in results:
            figures[key] = interval(results[key])[0]
    return {**figures, "episodes": len(results["return"])}


def measure_latency(
    policy: TensorDictSequential,
    states: Tensor,
    rows: int,
    calls: int = 50,
    goals: Tensor | None = None,
) -> dict[str, dict[str, float]]:
    """Time of each module of a policy on recorded states, in milliseconds.

    Args:
        policy (TensorDictSequential): TS, SE and PL, or PL alone.
        states (Tensor): [n, T, S], episodes that the policy drove; consecutive ones are asked for,
            as in acting, on the policy's device.
        rows (int): states of a call, at most n.
        calls (int, optional): timed calls, after five that are not. Defaults to ``50``.
        goals (Tensor, optional): [n, G], of a policy that reads ``goal``.

    Returns:
        For each module (named by its class) and ``"total"``: ``p50`` and ``p95``.
    """
    names = [type(module).__name__ for module in policy.module]
    weight = next(policy.parameters(), None)
    states = states if weight is None else states.to(weight.device)
    spent = np.zeros((calls + 5, len(names)))
    for call in range(calls + 5):
        tensordict = TensorDict({"observation": states[:rows, call % states.shape[1]]}, [rows])
        if goals is not None:
            tensordict.set("goal", goals[:rows].to(states.device))
        for number, module in enumerate(policy.module):
            begin = time.perf_counter()
            with torch.no_grad():
                tensordict = module(tensordict)
            if states.is_cuda:
                torch.cuda.synchronize()
            spent[call, number] = time.perf_counter() - begin
    spent = 1e3 * spent[5:]
    columns = {**{name: spent[:, i] for i, name in enumerate(names)}, "total": spent.sum(1)}
    return {
        name: {"p50": float(np.percentile(column, 50)), "p95": float(np.percentile(column, 95))}
        for name, column in columns.items()
    }
