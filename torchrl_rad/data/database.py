"""The expert database: demonstrations in a TorchRL replay buffer that answers queries."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorStorage

from torchrl_rad.data.checks import check_finite, check_same_columns, check_steps, flat_steps
from torchrl_rad.data.episodes import (
    episode_ids,
    episode_lengths,
    return_to_go,
    step_and_remaining,
)
from torchrl_rad.data.experts import select_episodes
from torchrl_rad.data.growth import EVICTIONS, copies, evicted, kept_names, new_reward
from torchrl_rad.data.saving import SavedReplayBuffer
from torchrl_rad.retrieval.sampler import RetrievalSampler, storage_revision

__all__ = ["ExpertDatabase"]


class ExpertDatabase(SavedReplayBuffer):
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
        evict (str, optional): whole episodes give way to new ones where these do not fit:
            ``"oldest"``, those added first, or ``"lowest_return"``, those that pay least from their
            first step on. Defaults to none: what does not fit is refused.
        **kwargs: of :class:`~torchrl.data.TensorDictReplayBuffer`.

    Raises:
        ValueError: ``gamma`` lies outside [0, 1], or ``evict`` is another word.
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
        evict: str | None = None,
        **kwargs: Any,
    ):
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma is {gamma}; a discount lies in [0, 1].")
        if evict not in (None, *EVICTIONS):
            raise ValueError(f"evict is {evict!r}; expected one of {EVICTIONS}, or None.")
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
        self.gamma, self.expert, self.evict = float(gamma), expert, evict
        self.version = 0  # raised when rewards change or rows move

    # filling

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Adds those of the episodes that the expert rule keeps, all at once.

        A query from another thread sees all of these rows or none. Ids that are in use already are
        shifted past those; episodes that are there already count twice, with a warning. The search
        structure is extended, and built anew when a fifth of the rows are new.

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
            self._make_room(len(steps))
            before = storage_revision(self._storage)
            written = super().extend(steps, update_priority=update_priority)
            self._sampler.extended(self._storage, before)
            return written

    def _make_room(self, count: int) -> None:
        size, taken = self._storage.max_size, len(self)
        if taken + count <= size:
            return
        if self.evict is None or count > size:
            raise ValueError(
                f"{count} rows do not fit: the storage has room for {size}, of which {taken} are "
                "taken. Give the database a larger storage (one opened with memmap=True cannot "
                'grow), or let old episodes give way, with evict="oldest".'
            )
        self._remove(evicted(self._storage[:], taken + count - size, self.evict))

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
        value = return_to_go(steps["next", "reward"], lengths, self.gamma).to(device)
        columns = {"episode": ids, "step": step, "remaining": remaining, "return_to_go": value}
        steps = steps.update(columns)
        if len(self):
            for name in kept_names(self._storage[:]):  # of before relabelling: as they are now
                steps.set((name, "reward"), steps["next", "reward"])
                steps.set((name, "return_to_go"), value)
        again = copies(self._storage[:] if len(self) else steps[:0], steps, self._sampler.key)
        if again:
            number, other = again[0]
            warnings.warn(
                f"{len(again)} episodes are in the database already and now count twice: "
                f"episode {number} has the states of episode {other}. "
                f"forget([{number}]) removes it.",
                stacklevel=3,
            )
        return steps

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

    # changing what is there

    def relabel(self, reward: Any, keep: str | None = None) -> None:
        """Gives all rows another reward, and the returns that follow from it.

        A policy in use answers with the new returns at its next step. The expert rule is not asked
        again: a database for several goals holds all episodes.

        Args:
            reward: [N] or [N, 1]; a function of the rows (TensorDict [N]) that gives it; or the
                name of an entry, such as ``("before", "reward")``.
            keep (str, optional): a name under which ``reward`` and ``return_to_go`` of before stay
                as columns: ``(keep, "reward")`` [N, 1] and ``(keep, "return_to_go")`` [N].

        Raises:
            RuntimeError: the database is empty.
            KeyError: there is no entry of that name.
            TypeError: no numbers came.
            ValueError: another length; NaN or Inf, named by episode and step; ``keep`` is the name
                of a column.

        Examples:
            >>> from tensordict import TensorDict
            >>> database = ExpertDatabase(LazyTensorStorage(2), gamma=0.5)
            >>> end = {"reward": torch.zeros(2, 1), "done": torch.tensor([[False], [True]])}
            >>> steps = {"observation": torch.tensor([[0.0], [1.0]]), "next": end}
            >>> _ = database.extend(TensorDict(steps, [2]))
            >>> database.relabel(lambda rows: (rows["observation"] > 0.5).float(), keep="before")
            >>> database[:]["return_to_go"], database[:]["before", "return_to_go"]
            (tensor([0.5000, 1.0000]), tensor([0., 0.]))
        """
        with self._replay_lock, self._write_lock:
            self._require_rows("relabelling them")
            rows = self._storage[:]
            if keep is not None and keep in rows.keys() and keep not in kept_names(rows):
                raise ValueError(f"keep is {keep!r}, which is a column of the database.")
            new, value = new_reward(rows, reward, self.gamma)
            changed: dict[Any, Tensor] = {("next", "reward"): new, "return_to_go": value}
            if keep is not None:
                changed[keep, "reward"] = rows["next", "reward"]
                changed[keep, "return_to_go"] = rows["return_to_go"]
            self._set_columns(changed)

    def _set_columns(self, columns: dict[Any, Tensor]) -> None:
        """Replaces or adds columns [N, ...], out of place: files of a memory map stay."""
        whole = self._storage._storage.copy()  # a new table of the same tensors
        for key, column in columns.items():
            present = whole.get(key, None)
            room = column.new_zeros(len(whole), *column.shape[1:])
            room[: len(column)] = column
            whole.set(key, room if present is None else room.to(present.device))
        self._storage._storage = whole
        self.version += 1
        self._saved = None

    def forget(self, episodes: Iterable[int]) -> int:
        """Removes demonstrations: they are not found again, and not saved again.

        A folder that was saved before keeps them until :meth:`dumps` replaces it.

        Args:
            episodes (iterable of int): ids, as in the column ``episode``.

        Returns:
            Number of rows removed.

        Raises:
            KeyError: an id that is not there; nothing is removed then.
        """
        with self._replay_lock, self._write_lock:
            return self._remove(self._rows_of(episodes))

    def keep(self, episodes: Iterable[int]) -> int:
        """Removes all demonstrations but these; see :meth:`forget`."""
        with self._replay_lock, self._write_lock:
            return self._remove(~self._rows_of(episodes))

    def _rows_of(self, episodes: Iterable[int]) -> Tensor:
        """Which rows are of some episodes, bool [N] on the CPU."""
        wanted = torch.as_tensor(list(episodes), dtype=torch.int64)
        ids = self._storage[:]["episode"].cpu() if len(self) else wanted.new_zeros(0)
        unknown = wanted[~torch.isin(wanted, ids)]
        if len(unknown):
            raise KeyError(
                f"episodes {unknown.tolist()} are not in the database, which holds "
                f"{len(ids.unique())} others."
            )
        return torch.isin(ids, wanted)

    def _remove(self, gone: Tensor) -> int:
        """Closes the gaps that some rows, bool [N], leave; gives their number."""
        if not gone.any():
            return 0
        if type(self._storage) is TensorStorage:
            raise RuntimeError(
                "a database opened with memmap=True cannot change; open it with loads(path)."
            )
        kept = self._storage[:][~gone.to(self.device)].clone()
        self._storage._storage.zero_()  # what is removed does not stay in a file beyond the end
        self.empty()
        if len(kept):
            super().extend(kept.exclude("index"))
        self.version += 1
        self._saved = None
        return int(gone.sum())

    # asking

    @property
    def width(self) -> int:
        """Number of entries of a state.

        Raises:
            RuntimeError: the database is empty.
        """
        self._require_rows("asking for the width of its states")
        return self._storage[:][self._sampler.key].shape[-1]
