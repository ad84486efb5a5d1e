"""What any expert database answers, wherever its rows are."""

from __future__ import annotations

from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

__all__ = ["AskedReplayBuffer"]


class AskedReplayBuffer(TensorDictReplayBuffer):
    """The part that an expert database in memory and a sharded one have in common."""

    @property
    def lock(self) -> Any:
        """Re-entrant, held while rows are written: hold it over reads that belong together."""
        return self._replay_lock

    @property
    def device(self) -> torch.device:
        """Where the rows are."""
        device = self._storage.device
        return torch.device("cpu" if device in ("auto", None) else device)

    @property
    def columns(self) -> Any:
        """The columns by their keys, for reading some rows: ``columns["step"][index]``."""
        return self[:]

    @property
    def tables(self) -> list[TensorDictBase]:
        """All rows, in tables of whole episodes."""
        return [self[:]]

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    def _sent_options(self) -> dict[str, Any]:
        """What a pickle passes to the constructor beside a path."""
        used = self._transform is not None and len(self._transform)
        return {"batch_size": self._batch_size, "transform": self._transform if used else None}

    def _require_rows(self, purpose: str) -> None:
        if len(self) == 0:
            raise RuntimeError(f"the database is empty: extend it with episodes before {purpose}.")

    def retrieve(self, query: Tensor) -> TensorDict:
        """The neighbours of each query: as :meth:`sample`, with a search in place of the draw.

        Args:
            query (Tensor): [*B, S], raw units.

        Returns:
            TensorDict [*B, k]: ``index`` (int64, -1 where there is none), ``similarity`` (float32),
            ``valid`` (bool) and the columns of the rows found (those of row 0 where ``valid`` is
            False).

        Raises:
            RuntimeError: the database is empty.
            ValueError: the query has another width than the rows.
        """
        with self._replay_lock:
            self._require_rows("asking for neighbours")
            index, info = self._sampler.search(self._storage, query)
            rows = index.clamp_min(0).reshape(-1).to(self.device)
            hits = self._storage.get(rows).reshape(index.shape)
        if self._transform is not None and len(self._transform):
            hits = self._transform(hits)
        hits = hits.to(query.device).exclude("index")
        hits.update({"index": index, **info})
        return hits
