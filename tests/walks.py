"""Episodes of random walks."""

from __future__ import annotations

import torch
from tensordict import TensorDict


def episodes(states, lengths, rewards=None):
    """Flat steps of whole episodes: states [T, S]."""
    states = torch.as_tensor(states)
    done = torch.zeros(len(states), 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    reward = torch.zeros(len(states)) if rewards is None else torch.as_tensor(rewards)
    following = TensorDict({"reward": reward.reshape(-1, 1), "done": done}, [len(states)])
    return TensorDict({"observation": states, "next": following}, [len(states)])


def random_walks(count, length, width, seed, unpaid):
    """Walks of which a share of the steps is unpaid."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.randn(count, length, width, generator=generator).cumsum(1) * 0.2
    rewards = (torch.rand(count * length, generator=generator) > unpaid).float()
    return episodes(states.reshape(-1, width), [length] * count, rewards)
