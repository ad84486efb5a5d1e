"""The sampler of an expert database: uniform rows for training, nearest rows for a query."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_rad.retrieval import search
from torchrl_rad.retrieval.backends import BACKENDS, build_index, grow_index
from torchrl_rad.retrieval.choice import Candidates, Metric, choose, first_by_rank, similarity
from torchrl_rad.retrieval.index import SearchIndex

__all__ = ["RetrievalSampler", "storage_revision"]


def storage_revision(storage: Any) -> tuple[int, int, int | None]:
    """What a cache made from a storage must be keyed on.

    In-place writes on leaves do not show in it.
    """
    return id(storage), len(storage), getattr(storage, "_mutation_revision", None)


def _joined(parts: list[tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    """Columns of results, whole again."""
    return parts[0] if len(parts) == 1 else tuple(map(torch.cat, zip(*parts, strict=True)))


class RetrievalSampler(Sampler):
    """Finds the rows of a storage that are most similar to a query (TS of RAD, first step).

    :meth:`sample` draws rows uniformly, as any training batch wants them; :meth:`search` answers
    queries. The search structure is built at the first query, again when the storage changed (see
    :meth:`invalidate`), and is never pickled.

    Args:
        metric (str, optional): ``"cosine"`` or ``"euclidean"`` (similarity 1 / (1 + d)).
            Defaults to ``"cosine"``.
        dims (sequence of int, optional): entries of the state that are compared. Defaults to all.
        k (int, optional): number of neighbours. Defaults to ``500``.
        threshold (float, optional): a neighbour is at least this similar; in [0, 1].
            Defaults to ``0.8``.
        normalize (bool, optional): compare states standardised by the mean and deviation of the
            storage. Defaults to ``False``.
        backend (str, optional): ``"auto"``, ``"scan"`` or ``"tree"``, which are exact, or
            ``"faiss"`` (an extra), which finds 99 % of the neighbours. Defaults to ``"auto"``.
        key (NestedKey, optional): entry of the storage that is searched.
            Defaults to ``"observation"``.

    Raises:
        ValueError: an argument has a value that it cannot have.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> storage = LazyTensorStorage(4)
        >>> rows = TensorDict({"observation": torch.tensor([[0.0], [1.0], [2.0]])}, [3])
        >>> storage.set(range(3), rows)
        >>> sampler = RetrievalSampler(metric="euclidean", k=2, threshold=0.5)
        >>> index, info = sampler.search(storage, torch.tensor([[1.8]]))
        >>> index, info["valid"]
        (tensor([[2, 1]]), tensor([[True, True]]))
    """

    _revision: tuple | None
    _index: SearchIndex | None
    _scale: tuple[Tensor, Tensor] | None
    _width: int  # of a state in the storage
    _grown: bool  # rows were added since the index was built

    def __init__(
        self,
        metric: Metric = "cosine",
        dims: list[int] | None = None,
        k: int = 500,
        threshold: float = 0.8,
        normalize: bool = False,
        backend: Literal["auto", "scan", "tree", "faiss"] = "auto",
        key: str | tuple[str, ...] = "observation",
    ):
        super().__init__()
        self._configure(metric, dims, k, threshold, normalize, backend, key)

    def _configure(self, metric, dims, k, threshold, normalize, backend, key) -> None:
        if metric not in ("cosine", "euclidean"):
            raise ValueError(f"metric is {metric!r}; expected 'cosine' or 'euclidean'.")
        if backend not in BACKENDS:
            raise ValueError(f"backend is {backend!r}; expected one of {BACKENDS}.")
        if k < 1:
            raise ValueError(f"k is {k}; at least one neighbour is needed.")
        if not 0.0 <= threshold <= 1.0:
            raise ValueError(f"threshold is {threshold}; a similarity threshold lies in [0, 1].")
        if dims is not None and (len(dims) == 0 or min(dims) < 0):
            raise ValueError(
                f"dims are {dims}; expected places in a state, from 0, or None for all."
            )
        self.metric, self.k, self.threshold = metric, int(k), float(threshold)
        self.dims = None if dims is None else [int(dim) for dim in dims]
        self.normalize, self.backend = normalize, backend
        self.key = tuple(key) if isinstance(key, list) else key  # JSON knows no tuples
        self.invalidate()

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments."""
        names = ("metric", "dims", "k", "threshold", "normalize", "backend", "key")
        return {name: getattr(self, name) for name in names}

    # training batches

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict]:
        """Draws rows uniformly, with replacement."""
        if len(storage) == 0:
            raise RuntimeError("the database is empty: extend it with episodes before sampling.")
        return torch.randint(len(storage), (batch_size,), generator=self._rng), {}

    # queries

    def search(self, storage: Any, query: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The neighbours of each query, most similar first, ties by the lower row.

        Args:
            storage (Storage): where the rows are.
            query (Tensor): [*B, S] in raw units; a query with NaN or Inf has no neighbour.

        Returns:
            Rows, int64 [*B, k], -1 where there is none, and ``{"similarity", "valid"}``: float32
            and bool [*B, k]. The similarity of the nearest rows is given also where it lies below
            the threshold.

        Raises:
            ValueError: the query has another width than the rows.
        """
        shape, device = (*query.shape[:-1], self.k), query.device
        index, near = self.nearest(storage, query.reshape(-1, query.shape[-1]))
        valid = near >= self.threshold
        index = torch.where(valid, index, -1)
        missing = self.k - index.shape[-1]
        if missing:  # fewer rows than k: the shape stays
            pad = (0, missing)
            index = torch.nn.functional.pad(index, pad, value=-1)
            near = torch.nn.functional.pad(near, pad, value=-torch.inf)
            valid = torch.nn.functional.pad(valid, pad, value=False)
        info = {"similarity": near.float(), "valid": valid}
        info = {name: value.reshape(shape).to(device) for name, value in info.items()}
        return index.reshape(shape).to(device), info

    def nearest(
        self,
        storage: Any,
        query: Tensor,
        k: int | None = None,
        among: SearchIndex | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The nearest rows of queries [Q, S], whatever the threshold.

        Args:
            storage (Storage): where the rows are.
            query (Tensor): [Q, S] in raw units.
            k (int, optional): number of rows. Defaults to that of the sampler.
            among (SearchIndex, optional): of :meth:`subset`; rows are then numbers in it. Defaults
                to all rows.

        Returns:
            Rows, int64 [Q, min(k, N)], and similarities, float64, on the device of the rows; -1 and
            -inf for a query with NaN or Inf.
        """
        count = len(storage)
        if count == 0:
            rows = torch.full((len(query), 0), -1)
            return rows, torch.empty(len(query), 0, dtype=torch.float64)
        index, query, finite = self._ready(storage, query)
        index = index if among is None else among
        k = min(self.k if k is None else k, len(index.rows))
        near, rows = _joined([index.search(part, k) for part in self._parts(query, k)])
        if finite is not None:
            near, rows = torch.where(finite, near, -torch.inf), torch.where(finite, rows, -1)
        return rows, near

    def best(self, storage: Any, query: Tensor, rank: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The neighbour of the highest rank of each query [Q, S]; of equals the most similar.

        The same as looking for it among :meth:`nearest`, without putting these in order.

        Args:
            storage (Storage): where the rows are; not empty.
            query (Tensor): [Q, S] in raw units.
            rank (Tensor): int [N], not negative, of each row.

        Returns:
            Row, int64 [Q], its similarity, float64 [Q], and bool [Q] whether it is a neighbour: if
            not, it is the most similar row, or -1 and -inf for a query with NaN or Inf.
        """
        index, query, finite = self._ready(storage, query)
        k = min(self.k, len(storage))
        parts = self._parts(query, k)
        row, near, hit = _joined([self._best(index, part, k, rank) for part in parts])
        if finite is not None:
            finite = finite[:, 0]
            near, row = torch.where(finite, near, -torch.inf), torch.where(finite, row, -1)
            hit &= finite
        return row, near, hit

    def _best(
        self, index: SearchIndex, query: Tensor, k: int, rank: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        found = index.candidates(query, k)
        row, sure = choose(found, rank, self.threshold, index.metric, k)
        near = similarity(query, index.rows.index_select(0, row), index.metric)
        hit = torch.ones_like(sure)
        if not sure.all():
            doubt = ~sure
            again = Candidates(*(part[doubt] for part in found))
            nears, rows = index.order(again, query[doubt], k)
            valid = nears >= self.threshold
            place = first_by_rank(rank, rows, valid)
            near[doubt] = nears.gather(-1, place)[:, 0]
            row[doubt], hit[doubt] = rows.gather(-1, place)[:, 0], valid[:, 0]
        return row, near, hit

    def _parts(self, query: Tensor, k: int) -> tuple[Tensor, ...]:
        """Queries by so many that the states of their neighbours are SCAN_ENTRIES at most."""
        most = max(1, search.SCAN_ENTRIES // (k * max(1, query.shape[-1])))
        return query.split(most) if len(query) > most else (query,)

    def _ready(self, storage: Any, query: Tensor) -> tuple[SearchIndex, Tensor, Tensor | None]:
        """The search structure, queries as it wants them, and which are finite if not all are."""
        index = self.build(storage)
        return index, *self._asked(query, index.rows.device)

    def _asked(self, query: Tensor, device: Any) -> tuple[Tensor, Tensor | None]:
        """Queries as a search structure wants them, and which are finite if not all are."""
        self._check_query(query, self._width)
        query = query.detach().to(device, torch.float64)
        finite = query.isfinite().all(-1, keepdim=True)
        whole = bool(finite.all())
        if not whole:
            query = torch.where(finite, query, 0.0)
        return self._prepare(query), None if whole else finite

    def _check_query(self, query: Tensor, width: int) -> None:
        """Raises ValueError for a query of another width than the states."""
        if query.shape[-1] != width:
            raise ValueError(
                f"the query has {query.shape[-1]} entries, a state of the database {width}; "
                "pass states as wide as those it was filled with."
            )

    def _check_dims(self, width: int) -> None:
        """Raises ValueError for dims that states of a width do not have."""
        if self.dims is not None and max(self.dims) >= width:
            raise ValueError(f"dims are {self.dims}, but a state has {width} entries.")

    def _prepare(self, states: Tensor) -> Tensor:
        if self.dims is not None:
            states = states.index_select(-1, torch.tensor(self.dims, device=states.device))
        if self._scale is not None:
            mean, deviation = self._scale
            states = (states.double() - mean) / deviation
        return states

    def build(self, storage: Any) -> SearchIndex:
        """The search structure of the storage: the same object until the storage changes."""
        revision = storage_revision(storage)
        if self._index is None or self._revision != revision:
            self.invalidate()
            states = storage[:].get(self.key)
            self._width = states.shape[-1]
            self._check_dims(self._width)
            rows = self._prepare(states)
            if self.normalize:
                self._scale = self.fit_scale(rows)
                rows = self._prepare(states)
            self._index = build_index(rows, self.metric, self.backend, self.k)
            self._revision = revision
        elif self._grown:
            rows = self._prepare(storage[:].get(self.key))
            self._index = grow_index(self._index, rows, self.metric, self.backend, self.k)
            self._grown = False
        return self._index

    def fit_scale(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation, float64 [D], that rows [N, D] are standardised by."""
        rows = rows.double()
        # a constant entry stays as it is; its deviation may differ from 0 by rounding
        varies = rows.amax(0) > rows.amin(0)
        return rows.mean(0), torch.where(varies, rows.std(0, correction=0), 1.0)

    def compared(self, storage: Any) -> int:
        """Number of entries of a state that are compared."""
        return self.build(storage).rows.shape[-1]

    def subset(self, storage: Any, rows: Tensor) -> SearchIndex:
        """A search structure of some rows, int64 [M], of the storage as it is now."""
        states = self.build(storage).rows.index_select(0, rows)
        return build_index(states, self.metric, "auto", self.k)

    def extended(self, storage: Any, before: tuple) -> None:
        """Rows were added behind those that there were at a revision, which are unchanged."""
        if self._revision == before and self._index is not None and not self.normalize:
            self._grown, self._revision = True, storage_revision(storage)

    def invalidate(self) -> None:
        """Drops the search structure.

        Needed after in-place writes on the storage's leaves, which cannot be noticed.
        """
        self._index = self._revision = self._scale = None
        self._grown = False

    # TorchRL's sampler contract

    def _empty(self) -> None:
        self.invalidate()

    def state_dict(self) -> dict[str, Any]:
        return self.config

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._configure(**state_dict)

    def dumps(self, path: str | Path) -> None:
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        (path / "sampler.json").write_text(json.dumps(self.config))

    def loads(self, path: str | Path) -> None:
        self.load_state_dict(json.loads((Path(path) / "sampler.json").read_text()))

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        return {**state, "_index": None, "_revision": None, "_scale": None, "_grown": False}

    def __repr__(self) -> str:
        return f"RetrievalSampler({', '.join(f'{k}={v!r}' for k, v in self.config.items())})"
