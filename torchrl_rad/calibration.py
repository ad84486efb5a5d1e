"""From which similarity on a demonstration can be trusted, measured on episodes held out."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.episodes import episode_lengths

__all__ = ["similarity_threshold"]


def similarity_threshold(
    database: ExpertDatabase, held_out: TensorDictBase, level: float = 0.05, seed: int = 0
) -> float:
    r"""The similarity that a state like those recorded falls short of with probability ``level``.

    One state is drawn from each episode held out, and the similarity of its nearest row taken. By
    split conformal prediction (Vovk et al., 2005) the :math:`\lfloor \alpha (n + 1) \rfloor`-th
    smallest of these n is, for a state of a further episode of that kind, undercut with a
    probability of at most :math:`\alpha`. As ``database.sampler.threshold`` it is where a policy
    begins to plan without a target, and says so (``found`` False).

    Args:
        database (ExpertDatabase): holds none of these episodes.
        held_out (TensorDictBase): flat steps [T] of whole episodes, as for
            :meth:`ExpertDatabase.extend`.
        level (float, optional): share of states like those recorded that may fall back.
            Defaults to ``0.05``.
        seed (int, optional): of the draw. Defaults to ``0``.

    Returns:
        A similarity; 0 where there are too few episodes for the level, so that none falls back.

    Raises:
        RuntimeError: the database is empty.
        ValueError: ``level`` lies outside (0, 1), or there is no episode.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_rad import RetrievalSampler
        >>> database = ExpertDatabase(sampler=RetrievalSampler("euclidean"))
        >>> def steps(states):
        ...     end = {"reward": torch.zeros(len(states), 1)}
        ...     ids = torch.arange(len(states))
        ...     return TensorDict({"observation": states, "episode": ids, "next": end}, [len(ids)])
        >>> _ = database.extend(steps(torch.zeros(1, 1)))
        >>> similarity_threshold(database, steps(torch.arange(9.0)[:, None]), level=0.2)
        0.125
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level}; expected a share between 0 and 1.")
    if len(database) == 0:
        raise RuntimeError("the database is empty: extend it with episodes before calibrating.")
    lengths = episode_lengths(held_out)
    if len(lengths) == 0:
        raise ValueError("no episode was held out; pass some that are not in the database.")
    draw = torch.rand(len(lengths), generator=torch.Generator().manual_seed(seed))
    row = lengths.cumsum(0) - lengths + (draw * lengths).long()
    states = held_out[database.sampler.key][row.to(held_out[database.sampler.key].device)]
    with database.lock:
        _, near = database.sampler.nearest(database.storage, states, 1)
    rank = math.floor(level * (len(lengths) + 1))
    return float(near[:, 0].sort().values[rank - 1]) if rank else 0.0
