"""Windows of consecutive steps: the sampler picks where they begin, the sample unit makes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import SampleUnit
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_rad.data.episodes import episode_lengths, step_and_remaining
from torchrl_rad.retrieval.sampler import storage_revision

__all__ = ["Window", "WindowSampler", "window_buffer"]


class Window(SampleUnit):
    """Expands each anchor row to the ``length`` rows that begin there: [B] becomes [B * length].

    Args:
        length (int): rows of a window.

    Examples:
        >>> Window(3).expand(torch.tensor([0, 5]), {}, None)[0]
        tensor([0, 1, 2, 5, 6, 7])
    """

    def __init__(self, length: int):
        self.length = length

    def expand(
        self, index: Tensor, info: dict[str, Any], storage: Any
    ) -> tuple[Tensor, dict[str, Any]]:
        rows = index[:, None] + torch.arange(self.length, device=index.device)
        info = {name: value.repeat_interleave(self.length, 0) for name, value in info.items()}
        return rows.reshape(-1), info


class WindowSampler(Sampler):
    """Draws the first rows of windows uniformly over all windows that lie inside one episode.

    Args:
        length (int): rows of a window.

    Raises:
        ValueError: (when sampling) no episode is as long as a window.

    Examples:
        >>> from tensordict import TensorDict
        >>> steps = TensorDict({"episode": torch.tensor([0, 0, 0, 1, 1])}, [5])
        >>> sampler = WindowSampler(3)
        >>> sampler.sample(TensorStorage(steps), 4)[0]
        tensor([0, 0, 0, 0])
    """

    def __init__(self, length: int):
        super().__init__()
        if length < 1:
            raise ValueError(f"length is {length}; a window has at least one row.")
        self.length = length
        self._revision: tuple | None = None
        self._starts: Tensor | None = None

    def starts(self, storage: Any) -> Tensor:
        """All rows at which a window can begin: int64 [M]."""
        revision = storage_revision(storage)
        if self._starts is None or self._revision != revision:
            lengths = episode_lengths(storage[:])
            _, remaining = step_and_remaining(lengths)
            starts = (remaining >= self.length - 1).nonzero().squeeze(-1)
            if len(starts) == 0:
                raise ValueError(
                    f"no episode has {self.length} steps (the longest has {int(lengths.max())}); "
                    "use a shorter horizon, or join the episodes of a stream (join_stream)."
                )
            self._starts, self._revision = starts, revision
        return self._starts

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict]:
        starts = self.starts(storage)
        return starts[torch.randint(len(starts), (batch_size,), generator=self._rng)], {}

    def _empty(self) -> None:
        self._starts = self._revision = None

    def state_dict(self) -> dict[str, Any]:
        return {"length": self.length}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.__init__(**state_dict)  # type: ignore[misc]

    def dumps(self, path: str | Path) -> None:
        Path(path).mkdir(parents=True, exist_ok=True)
        (Path(path) / "sampler.json").write_text(json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        self.load_state_dict(json.loads((Path(path) / "sampler.json").read_text()))

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_starts": None, "_revision": None}


def window_buffer(
    steps: TensorDictBase, length: int, batch_size: int, generator: torch.Generator | None = None
) -> TensorDictReplayBuffer:
    """A replay buffer whose batches are windows, flat.

    ``sample().reshape(-1, length)`` gives the windows back.

    Args:
        steps (TensorDictBase): flat table of whole episodes [T], used without a copy.
        length (int): rows of a window.
        batch_size (int): windows a batch.
        generator (torch.Generator, optional): source of randomness.

    Examples:
        >>> from tensordict import TensorDict
        >>> steps = TensorDict({"x": torch.arange(8), "episode": torch.arange(8) // 4}, [8])
        >>> batch = window_buffer(steps, 3, 16).sample().reshape(-1, 3)
        >>> bool((batch["episode"] == batch["episode"][:, :1]).all())
        True
    """
    return TensorDictReplayBuffer(
        storage=TensorStorage(steps),
        sampler=WindowSampler(length),
        sample_unit=Window(length),
        batch_size=batch_size,
        generator=generator,
    )
