"""The expert database: demonstrations in a TorchRL replay buffer that answers queries."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer, TensorStorage

from torchrl_rad.data.episodes import episode_lengths, return_to_go, step_and_remaining
from torchrl_rad.data.experts import Expert, expert_from_config
from torchrl_rad.retrieval.sampler import RetrievalSampler, storage_revision
from torchrl_rad.retrieval.windows import WindowMax

__all__ = ["ExpertDatabase"]

FORMAT = 1


class ExpertDatabase(TensorDictReplayBuffer):
    r"""Recorded demonstrations, searched by state (TS of RAD; paper section "Target Selection").

    A :class:`~torchrl.data.TensorDictReplayBuffer` that is filled with whole episodes. To the entries given it adds

    ================  ===============  =========================================================================
    column            shape, dtype     meaning
    ================  ===============  =========================================================================
    ``episode``       [N] int64        which recorded episode
    ``step``          [N] int64        which step in it
    ``return_to_go``  [N] float32      :math:`v_i = \sum_{t \ge i} \gamma^{t-i} r_t` inside the episode
    ``remaining``     [N] int64        steps to the episode's last row
    ================  ===============  =========================================================================

    ``deepcopy`` gives the same database and pickling passes a path, under which another process opens it memory-mapped:
    a policy that holds a database can be copied and sent to workers at no cost.

    Args:
        storage (Storage): a lazy storage; its size is the capacity.
        gamma (float, optional): discount of ``return_to_go``, in [0, 1]. Defaults to ``0.99``.
        expert (callable, optional): one episode -> bool, which episodes to keep; ``None`` keeps all.
        sampler (RetrievalSampler, optional): how rows are found.
        **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

    Examples:
        >>> from tensordict import TensorDict
        >>> database = ExpertDatabase(LazyTensorStorage(10), gamma=0.5, sampler=RetrievalSampler("euclidean", k=2))
        >>> episode = TensorDict({"observation": torch.tensor([[0.0], [1.0], [2.0]]), "next": {
        ...     "reward": torch.tensor([[0.0], [0.0], [1.0]]), "done": torch.tensor([[False], [False], [True]])}}, [3])
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
        super().__init__(
            storage=LazyTensorStorage(1_000_000) if storage is None else storage,
            sampler=RetrievalSampler() if sampler is None else sampler,
            **kwargs,
        )
        self.gamma, self.expert = float(gamma), expert
        self.path: Path | None = None  # where this content is saved
        self._saved: tuple | None = None
        self._window_max: tuple[tuple, WindowMax] | None = None

    # filling

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Adds the episodes that the expert rule keeps; a query sees either all rows of an episode or none.

        Args:
            tensordicts (TensorDictBase): flat steps [T] of whole episodes with ``observation`` [T, S],
                ``("next", "reward")`` and ``("next", "done")`` [T, 1] or ``episode`` [T].
            update_priority (bool, optional): passed on.

        Returns:
            The rows written, int64 [M].

        Raises:
            KeyError: an entry is missing.
            ValueError: states of another width or type, NaN or Inf (named by episode and step), no episode kept by the
                expert rule, or more rows than there is room for.
        """
        steps = tensordicts.copy()
        lengths = episode_lengths(steps)
        self._check(steps, lengths)
        steps.set("episode", self._ids(steps, lengths))
        step, remaining = step_and_remaining(lengths)
        steps.set("step", step)
        steps.set("remaining", remaining)
        steps.set("return_to_go", return_to_go(steps["next", "reward"], lengths, self.gamma))
        keep = self._select(steps, lengths)
        if not keep.any():
            raise ValueError(
                f"none of the {len(lengths)} episodes is an expert's by the rule {self.expert}; choose another rule "
                "(top_share_by_return(0.1) always keeps some), or None for all episodes."
            )
        if not keep.all():
            steps = steps[torch.repeat_interleave(keep, lengths)]
        room = self._storage.max_size - len(self)
        if len(steps) > room:
            raise ValueError(
                f"{len(steps)} rows do not fit: the storage has room for {self._storage.max_size}, of which "
                f"{len(self)} are taken. Give the database a larger storage."
            )
        with self._replay_lock, self._write_lock:
            return super().extend(steps, update_priority=update_priority)

    def _check(self, steps: TensorDictBase, lengths: Tensor) -> None:
        for key in (self._sampler.key, ("next", "reward")):
            if steps.get(key, None) is None:
                raise KeyError(f"an episode needs the entry {key!r}; got {sorted(map(str, steps.keys(True, True)))}.")
        states = steps[self._sampler.key]
        if not states.is_floating_point() or states.ndim != 2:
            raise ValueError(
                f"{self._sampler.key!r} must be floating point [T, S]; got {states.dtype} {tuple(states.shape)}."
            )
        if len(self) and states.shape[-1] != self.width:
            raise ValueError(f"states have width {states.shape[-1]}, those in the database {self.width}.")
        for key in (self._sampler.key, "action", ("next", "reward")):
            value = steps.get(key, None)
            if value is None:
                continue
            bad = ~value.reshape(len(steps), -1).isfinite().all(-1)
            if bad.any():
                row = int(bad.nonzero()[0])
                step, _ = step_and_remaining(lengths)
                ids = self._ids(steps, lengths)
                raise ValueError(
                    f"{key!r} has NaN or Inf in {int(bad.sum())} row(s), the first in episode {int(ids[row])} "
                    f"at step {int(step[row])}; remove or repair these episodes."
                )

    def _ids(self, steps: TensorDictBase, lengths: Tensor) -> Tensor:
        given = steps.get("episode", None)
        taken = self[:]["episode"] if len(self) else None
        free = 0 if taken is None else int(taken.max()) + 1
        if given is None:
            return torch.repeat_interleave(torch.arange(len(lengths)) + free, lengths)
        given = given.reshape(-1).long()
        # ids that are in use already are shifted past them
        return given if taken is None or not torch.isin(given, taken).any() else given - given.min() + free

    def _select(self, steps: TensorDictBase, lengths: Tensor) -> Tensor:
        if self.expert is None:
            return torch.ones(len(lengths), dtype=torch.bool)
        episodes = list(steps.split(lengths.tolist()))
        if isinstance(self.expert, Expert):
            return self.expert.select(episodes)
        return torch.tensor([bool(self.expert(episode)) for episode in episodes])

    # asking

    @property
    def width(self) -> int:
        """Number of entries of a state."""
        return self[:][self._sampler.key].shape[-1]

    def retrieve(self, query: Tensor) -> TensorDict:
        """The neighbours of each query: as :meth:`sample`, with a search in place of the draw.

        Args:
            query (Tensor): [*B, S], raw units.

        Returns:
            TensorDict [*B, k]: ``index`` (int64, -1 where there is none), ``similarity`` (float32), ``valid`` (bool)
            and the columns of the rows found (those of row 0 where ``valid`` is False).

        Raises:
            RuntimeError: the database is empty.
        """
        with self._replay_lock:
            if len(self) == 0:
                raise RuntimeError("the database is empty: extend it with episodes before asking.")
            index, info = self._sampler.search(self._storage, query)
            hits = self._storage.get(index.clamp_min(0).reshape(-1).to(self.device)).reshape(index.shape)
        if self._transform is not None and len(self._transform):
            hits = self._transform(hits)
        hits = hits.to(query.device).exclude("index")
        hits.update({"index": index, **info})
        return hits

    @property
    def device(self) -> torch.device:
        """Where the rows are."""
        return torch.device(self._storage.device if self._storage.device != "auto" else "cpu")

    def window_max(self, longest: int) -> WindowMax:
        """Look-up of the best return within ``longest`` rows, made at the first call after a change."""
        revision = storage_revision(self._storage)
        made = self._window_max
        if made is None or made[0] != revision or made[1].longest < min(longest, len(self)):
            made = self._window_max = (revision, WindowMax(self[:]["return_to_go"], longest))
        return made[1]

    def digest(self) -> str:
        """sha256 of the states, returns and settings: the identity of a database."""
        rows = self[:] if len(self) else {}
        hashed = hashlib.sha256(json.dumps(self._config(), sort_keys=True, default=str).encode())
        for key in (self._sampler.key, "episode", "step", "return_to_go") if len(self) else ():
            hashed.update(rows[key].contiguous().cpu().numpy().tobytes())
        return hashed.hexdigest()

    # saving, copying, sending

    def _config(self) -> dict[str, Any]:
        rule = self.expert.config if isinstance(self.expert, Expert) else None
        return {
            "format": FORMAT, "gamma": self.gamma, "expert": rule, "capacity": self._storage.max_size,
            "sampler": self._sampler.config, "memmap": isinstance(self._storage, LazyMemmapStorage),
        }  # fmt: skip

    def dumps(self, path: str | Path) -> None:
        """Saves rows and settings in a folder, which appears only when it is complete.

        Raises:
            RuntimeError: the database is empty.
        """
        path = Path(path).absolute()
        if len(self) == 0:
            raise RuntimeError("an empty database cannot be saved.")
        path.parent.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            with self._replay_lock:
                self[:].clone().memmap(stage / "rows")
            (stage / "database.json").write_text(json.dumps(self._config(), indent=1))
            if path.exists():
                shutil.rmtree(path)
            os.replace(stage, path)
        except BaseException:
            shutil.rmtree(stage, ignore_errors=True)
            raise
        self.path, self._saved = path, storage_revision(self._storage)

    @classmethod
    def loads(cls, path: str | Path, memmap: bool = False, **kwargs: Any) -> ExpertDatabase:  # type: ignore[override]
        """Opens a saved database.

        Args:
            path (path): the folder.
            memmap (bool, optional): read the rows from the file as they are asked for; such a database cannot grow.
                Defaults to ``False``: a storage of the kind and capacity that was saved.
            **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

        Raises:
            FileNotFoundError: the folder does not hold a database.
        """
        path = Path(path).absolute()
        if not (path / "database.json").exists():
            raise FileNotFoundError(f"{path} holds no database: database.json is missing.")
        config = json.loads((path / "database.json").read_text())
        rows = TensorDict.load_memmap(path / "rows")
        sampler = RetrievalSampler(**{**config["sampler"], "key": _as_key(config["sampler"]["key"])})
        expert = None if config["expert"] is None else expert_from_config(config["expert"])
        if memmap:
            storage: Any = TensorStorage(rows)
        else:
            kind = LazyMemmapStorage if config["memmap"] else LazyTensorStorage
            storage = kind(config["capacity"])
        database = cls(storage, config["gamma"], expert, sampler, **kwargs)
        if not memmap:
            TensorDictReplayBuffer.extend(database, rows)
        database.path, database._saved = path, storage_revision(database._storage)
        return database

    def __deepcopy__(self, memo: dict[int, Any]) -> ExpertDatabase:
        return self

    def __reduce__(self) -> tuple:
        if self.path is None or self._saved != storage_revision(self._storage):
            folder = tempfile.mkdtemp(prefix="torchrl_rad-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            self.dumps(Path(folder) / "database")
        return _open, (str(self.path),)


def _open(path: str) -> ExpertDatabase:
    return ExpertDatabase.loads(path, memmap=True)


def _as_key(key: Any) -> Any:
    return tuple(key) if isinstance(key, list) else key
