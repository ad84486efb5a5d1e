"""The expert database: demonstrations in a TorchRL replay buffer that answers queries."""

from __future__ import annotations

import atexit
import errno
import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer, TensorStorage

from torchrl_rad._files import staged_folder, write_json
from torchrl_rad.data.checks import check_finite, check_same_columns, check_steps, flat_steps
from torchrl_rad.data.episodes import (
    episode_ids,
    episode_lengths,
    return_to_go,
    step_and_remaining,
)
from torchrl_rad.data.experts import Expert, select_episodes
from torchrl_rad.data.saved import FORMAT, build, read_config, replaceable, require_space
from torchrl_rad.retrieval.sampler import RetrievalSampler, storage_revision

__all__ = ["ExpertDatabase"]


class ExpertDatabase(TensorDictReplayBuffer):
    r"""Recorded demonstrations, searched by state (TS of RAD; paper section "Target Selection").

    A :class:`~torchrl.data.TensorDictReplayBuffer` that is filled with whole episodes. To the
    entries given it adds

    ================  ===========  =============================================================
    column            shape        meaning
    ================  ===========  =============================================================
    ``episode``       [N] int64    which recorded episode
    ``step``          [N] int64    which step in it
    ``return_to_go``  [N] float32  :math:`v_i = \sum_{t \ge i} \gamma^{t-i} r_t` in the episode
    ``remaining``     [N] int64    steps to the episode's last row
    ================  ===========  =============================================================

    ``deepcopy`` gives the same database and pickling passes a path, under which another process
    opens it memory-mapped: a policy that holds a database can be copied and sent to workers at no
    cost. A collector fills it with ``replay_buffer=database``, ``trajs_per_batch=n`` and
    ``traj_format="cat"``.

    Args:
        storage (Storage, optional): a lazy storage; its size is the capacity. Defaults to
            ``LazyTensorStorage(1_000_000)``.
        gamma (float, optional): discount of ``return_to_go``, in [0, 1]. Defaults to ``0.99``.
        expert (callable, optional): one episode -> bool, which episodes to keep. Defaults to all.
        sampler (RetrievalSampler, optional): how rows are found.
        **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        ValueError: ``gamma`` lies outside [0, 1].
        TypeError: ``sampler`` is no RetrievalSampler, or ``storage`` holds no tensors.

    Examples:
        >>> from tensordict import TensorDict
        >>> sampler = RetrievalSampler("euclidean", k=2)
        >>> database = ExpertDatabase(LazyTensorStorage(10), gamma=0.5, sampler=sampler)
        >>> reward, done = torch.zeros(3, 1), torch.zeros(3, 1, dtype=torch.bool)
        >>> reward[2], done[2] = 1.0, True
        >>> episode = TensorDict({
        ...     "observation": torch.tensor([[0.0], [1.0], [2.0]]),
        ...     "next": {"reward": reward, "done": done}}, [3])
        >>> _ = database.extend(episode)
        >>> database[:]["return_to_go"].tolist(), database[:]["remaining"].tolist()
        ([0.25, 0.5, 1.0], [2, 1, 0])
        >>> database.retrieve(torch.tensor([1.1]))["index"].tolist()
        [1, -1]
    """

    def __init__(
        self,
        storage: Any = None,
        gamma: float = 0.99,
        expert: Callable[[TensorDictBase], bool] | None = None,
        sampler: RetrievalSampler | None = None,
        **kwargs: Any,
    ):
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma is {gamma}; a discount lies in [0, 1].")
        if sampler is not None and not isinstance(sampler, RetrievalSampler):
            raise TypeError(f"sampler must be a RetrievalSampler, got {type(sampler).__name__}.")
        if storage is not None and not isinstance(storage, TensorStorage):
            raise TypeError(
                "storage must be a LazyTensorStorage or a LazyMemmapStorage, got "
                f"{type(storage).__name__}."
            )
        super().__init__(
            storage=LazyTensorStorage(1_000_000) if storage is None else storage,
            sampler=RetrievalSampler() if sampler is None else sampler,
            **kwargs,
        )
        self.gamma, self.expert = float(gamma), expert
        self.path: Path | None = None  # where this content is saved
        self._saved: tuple | None = None

    # filling

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Adds those of the episodes that the expert rule keeps, all at once.

        A query from another thread sees all of these rows or none. Ids that are in use already are
        shifted past those.

        Args:
            tensordicts (TensorDictBase): flat steps [T] of whole episodes: ``observation`` [T, S],
                ``("next", "reward")`` [T, 1] and, to tell episodes apart, ``episode`` [T],
                ``("collector", "traj_ids")`` or ``("next", "done")`` [T, 1]. Left as it is.
            update_priority (bool, optional): passed on.

        Returns:
            The rows written, int64 [M].

        Raises:
            TypeError: something else than a TensorDict came.
            KeyError: an entry is missing, or not among those of earlier episodes.
            ValueError: steps that are not flat or not whole episodes; an entry of another width or
                dtype than before; NaN or Inf (named by episode and step); no episode kept by the
                expert rule; more rows than there is room for.
        """
        steps = flat_steps(tensordicts)
        check_steps(steps, self._sampler.key)
        if self._storage.device != "auto":
            steps = steps.to(self._storage.device)
        lengths = episode_lengths(steps)
        with self._replay_lock, self._write_lock:
            steps = self._with_columns(steps, lengths)
            if len(self):
                check_same_columns(steps, self._storage[:])
            steps = self._experts(steps, lengths)
            room = self._storage.max_size - len(self)
            if len(steps) > room:
                raise ValueError(
                    f"{len(steps)} rows do not fit: the storage has room for "
                    f"{self._storage.max_size}, of which {len(self)} are taken. Give the database "
                    "a larger storage (one opened with memmap=True cannot grow)."
                )
            return super().extend(steps, update_priority=update_priority)

    def add(self, data: TensorDictBase) -> NoReturn:
        """Refuses single steps: what a step is worth shows when its episode is over.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "an ExpertDatabase takes whole episodes, not steps one by one: "
            "gather the steps of an episode and pass them to extend()."
        )

    def _with_columns(self, steps: TensorDictBase, lengths: Tensor) -> TensorDictBase:
        device = steps[self._sampler.key].device
        step, remaining = (column.to(device) for column in step_and_remaining(lengths))
        ids = episode_ids(steps, lengths).to(device)
        check_finite(steps, (self._sampler.key, "action", ("next", "reward")), ids, step)
        if len(self):
            taken = self._storage[:]["episode"]
            if torch.isin(ids, taken).any():
                ids = ids - ids.min() + taken.max() + 1
        value = return_to_go(steps["next", "reward"], lengths, self.gamma)
        columns = {"episode": ids, "step": step, "remaining": remaining}
        return steps.update({**columns, "return_to_go": value.to(device)})

    def _experts(self, steps: TensorDictBase, lengths: Tensor) -> TensorDictBase:
        if self.expert is None:
            return steps
        keep = select_episodes(self.expert, steps.split(lengths.tolist()))
        if not keep.any():
            raise ValueError(
                f"none of the {len(lengths)} episodes is an expert's by the rule {self.expert}; "
                "choose another rule (top_share_by_return(0.1) always keeps some), or None for all."
            )
        return steps[torch.repeat_interleave(keep, lengths).to(steps["step"].device)]

    # asking

    @property
    def lock(self) -> Any:
        """Re-entrant, held while rows are written: hold it over reads that belong together."""
        return self._replay_lock

    @property
    def width(self) -> int:
        """Number of entries of a state.

        Raises:
            RuntimeError: the database is empty.
        """
        self._require_rows("asking for the width of its states")
        return self._storage[:][self._sampler.key].shape[-1]

    @property
    def device(self) -> torch.device:
        """Where the rows are."""
        device = self._storage.device
        return torch.device("cpu" if device in ("auto", None) else device)

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

    def digest(self) -> str:
        """sha256 of the rows, discount, expert rule and search settings.

        Where the rows are kept does not matter: a saved database has the digest of its source,
        memory-mapped or not.
        """
        settings = {name: self._config()[name] for name in ("gamma", "expert", "sampler")}
        hashed = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
        with self._replay_lock:
            rows = self._storage[:] if len(self) else TensorDict()
            for key in sorted(rows.keys(True, True), key=str):
                value = rows.get(key)
                if key == "index" or not isinstance(value, Tensor):
                    continue
                value = value.detach().cpu().contiguous()
                hashed.update(f"{key} {value.dtype} {list(value.shape)}".encode())
                hashed.update(value.reshape(-1).view(torch.uint8).numpy().data)
        return hashed.hexdigest()

    # saving, copying, sending

    def _config(self) -> dict[str, Any]:
        rule: Any = None
        if isinstance(self.expert, Expert):
            rule = self.expert.config
        elif self.expert is not None:
            rule = getattr(self.expert, "__qualname__", type(self.expert).__qualname__)
        return {
            "format": FORMAT,
            "gamma": self.gamma,
            "expert": rule,
            "capacity": self._storage.max_size,
            "sampler": json.loads(json.dumps(self._sampler.config)),
            "memmap": isinstance(self._storage, LazyMemmapStorage),
        }

    def dumps(self, path: str | Path) -> None:
        """Saves rows and settings in a folder, which appears only when it is complete.

        A database that lies there is replaced, once the new one is whole.

        Args:
            path (path): a new or empty folder, or one of a saved database.

        Raises:
            RuntimeError: the database is empty.
            FileExistsError: something else lies there.
            OSError: it cannot be written, for one thing because the disk is full; what lay there
                before is untouched.
        """
        path = Path(path).absolute()
        self._require_rows("saving it")
        if path.exists() and not replaceable(path):
            raise FileExistsError(
                errno.EEXIST,
                "dumps writes a folder of its own; this one has other content",
                str(path),
            )
        with self._replay_lock:
            rows = self._storage[:]
            path.parent.mkdir(parents=True, exist_ok=True)
            require_space(path.parent, rows.bytes())
            with staged_folder(path, replace=True) as stage:
                rows.memmap(stage / "rows", copy_existing=True)
                write_json(stage / "database.json", self._config())
            self.path, self._saved = path, storage_revision(self._storage)

    @classmethod
    def loads(  # type: ignore[override]
        cls,
        path: str | Path,
        memmap: bool = False,
        expert: Callable[[TensorDictBase], bool] | None = None,
        **kwargs: Any,
    ) -> ExpertDatabase:
        """Opens a saved database.

        Args:
            path (path): the folder.
            memmap (bool, optional): read the rows from the file as they are asked for; such a
                database cannot grow. Their sizes are checked, not their sha256. Defaults to
                ``False``: a storage of the kind and capacity that was saved.
            expert (callable, optional): the rule for further episodes. Defaults to the one saved;
                a plain function cannot be saved, and has to be passed again before extending.
            **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

        Raises:
            FileNotFoundError: the folder does not hold a database.
            CheckpointError: a file is missing, damaged or cut short.
        """
        path = Path(path).absolute()
        config = read_config(path, memmap)
        rows = TensorDict.load_memmap(path / "rows")
        kind = LazyMemmapStorage if config["memmap"] else LazyTensorStorage
        storage = TensorStorage(rows) if memmap else kind(config["capacity"])
        database = build(cls, config, storage, expert, kwargs)
        if not memmap:
            TensorDictReplayBuffer.extend(database, rows)
        database.path, database._saved = path, storage_revision(database._storage)
        return database

    def __copy__(self) -> ExpertDatabase:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> ExpertDatabase:
        return self

    def __reduce__(self) -> tuple:
        transform = (
            self._transform if self._transform is not None and len(self._transform) else None
        )
        kwargs = {"batch_size": self._batch_size, "transform": transform}
        if len(self) == 0:
            return _empty, (self._config(), kwargs)
        current = self._saved == storage_revision(self._storage)
        if self.path is None or not current or not (self.path / "database.json").exists():
            folder = tempfile.mkdtemp(prefix="torchrl_rad-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            self.dumps(Path(folder) / "database")
        return _open, (str(self.path), kwargs)


def _open(path: str, kwargs: dict[str, Any]) -> ExpertDatabase:
    return ExpertDatabase.loads(path, memmap=True, **kwargs)


def _empty(config: dict[str, Any], kwargs: dict[str, Any]) -> ExpertDatabase:
    kind = LazyMemmapStorage if config["memmap"] else LazyTensorStorage
    return build(ExpertDatabase, config, kind(config["capacity"]), None, kwargs)
