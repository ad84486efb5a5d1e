"""One state vector from recorded data and from the live environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

__all__ = ["ObservationAdapter"]


class ObservationAdapter:
    """Turns an observation, recorded or live, into one flat float32 vector.

    A dict observation is reduced to the named entries, concatenated in the order given; a plain
    array is passed on. The same object serves the data loader and the environment, so that the two
    cannot differ.

    Args:
        keys (sequence of str, optional): entries of a dict observation. Defaults to
            ``("observation",)``.

    Raises:
        KeyError: an entry named in ``keys`` is missing.

    Examples:
        >>> import numpy as np
        >>> adapter = ObservationAdapter(("achieved_goal", "observation"))
        >>> adapter({"observation": np.zeros((5, 2)), "achieved_goal": np.ones((5, 1))}).shape
        (5, 3)
    """

    def __init__(self, keys: Sequence[str] = ("observation",)):
        self.keys = tuple(keys)

    def __call__(self, observation: Mapping[str, Any] | np.ndarray) -> np.ndarray:
        if not isinstance(observation, Mapping):
            return np.asarray(observation, dtype=np.float32)
        missing = [key for key in self.keys if key not in observation]
        if missing:
            raise KeyError(
                f"observation has entries {sorted(observation)}, but {missing} were asked for; "
                "name existing entries in ObservationAdapter(keys)."
            )
        parts = [np.asarray(observation[key], dtype=np.float32) for key in self.keys]
        return np.concatenate(parts, axis=-1)

    def space(self, space: gym.Space) -> gym.spaces.Box:
        """Of the vectors that it makes of the observations of a space.

        Examples:
            >>> import gymnasium as gym
            >>> ObservationAdapter().space(gym.spaces.Box(-1.0, 1.0, (3,))).shape
            (3,)
        """
        return gym.spaces.Box(-np.inf, np.inf, self(space.sample()).shape, np.float32)

    def __repr__(self) -> str:
        return f"ObservationAdapter({self.keys})"
