"""Data-parallel training under ``torchrun``: the process group, and each one's share of a batch."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import torch
from torch import Tensor, distributed

__all__ = [
    "Share",
    "draw_rows",
    "drawing_for",
    "first_before_others",
    "first_decides",
    "is_first",
    "mean_over_processes",
    "process_group",
    "share_of_batch",
    "wait_for_all",
    "wanted_by_any",
]


class Share(NamedTuple):
    """Which part of each batch is this process's: number ``rank`` of ``world`` equal ones.

    Examples:
        >>> Share(1, 2).of(torch.arange(6))
        tensor([3, 4, 5])
    """

    rank: int = 0
    world: int = 1

    def of(self, batch):
        """The part of a batch [B, ...] that is this process's: [B / world, ...].

        Raises:
            ValueError: there are no equal parts.
        """
        if len(batch) % self.world:
            raise ValueError(
                f"a batch of {len(batch)} has no equal parts for {self.world} processes; choose "
                "replay_buffer.batch_size as a multiple of their number."
            )
        size = len(batch) // self.world
        return batch[self.rank * size : (self.rank + 1) * size]


WHOLE = Share()
_DRAWN: ContextVar[Share] = ContextVar("drawn", default=WHOLE)


def share_of_batch() -> Share:
    """This process's share: the whole batch where no process group was made."""
    if not distributed.is_available() or not distributed.is_initialized():
        return WHOLE
    return Share(distributed.get_rank(), distributed.get_world_size())


def is_first() -> bool:
    """Whether this process is the one that writes."""
    return share_of_batch().rank == 0


@contextmanager
def drawing_for(share: Share) -> Iterator[None]:
    """Within it, :func:`draw_rows` draws for whole batches."""
    token = _DRAWN.set(share)
    try:
        yield
    finally:
        _DRAWN.reset(token)


def draw_rows(draw: Callable[[int], Tensor], rows: int) -> Tensor:
    """Random numbers of each row of a batch, which do not depend on how many processes share it.

    All processes draw for the whole batch, with generators in the same state, and keep their part.

    Args:
        draw (callable): number of rows B -> tensor [B, ...].
        rows (int): of this process.

    Examples:
        >>> draw = lambda rows: torch.rand(rows, generator=torch.Generator().manual_seed(0))
        >>> with drawing_for(Share(1, 2)):
        ...     bool((draw_rows(draw, 3) == draw(6)[3:]).all())
        True
    """
    share = _DRAWN.get()
    return draw(rows) if share.world == 1 else share.of(draw(rows * share.world))


@contextmanager
def process_group(device: str) -> Iterator[str]:
    """The process group that ``torchrun`` asks for by its environment variables, if it does.

    Args:
        device (str): ``"cpu"`` or ``"cuda"``.

    Yields:
        The device of this process: of several on GPUs each has its own.

    Raises:
        ValueError: there is no GPU, or there are fewer than processes.
    """
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"device is {device!r}, but torch sees no GPU; use device=cpu.")
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield device
        return
    cuda = device.startswith("cuda")
    if cuda:
        local, asked = int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"])
        if torch.cuda.device_count() < asked:
            raise ValueError(
                f"torchrun started {asked} processes on this machine, but torch sees "
                f"{torch.cuda.device_count()} GPUs here; use --nproc-per-node of that number, or "
                "device=cpu."
            )
        device = f"cuda:{local}"
        torch.cuda.set_device(local)
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield device
    finally:
        distributed.destroy_process_group()


def first_decides(make: Callable[[], Any]) -> Any:
    """What ``make`` gives in the first process, in all of them; the others do not call it."""
    share = share_of_batch()
    if share.world == 1:
        return make()
    given = [make() if share.rank == 0 else None]
    distributed.broadcast_object_list(given)
    return given[0]


def first_before_others(make: Callable[[], Any]) -> Any:
    """What ``make`` gives in each process; the others call it when the first has done so."""
    if not is_first():
        wait_for_all()
        return make()
    made = make()
    wait_for_all()
    return made


def wait_for_all() -> None:
    """Returns when all processes have come here."""
    if share_of_batch().world > 1:
        distributed.barrier()


def wanted_by_any(wanted: bool, device: torch.device | str = "cpu") -> bool:
    """Whether one of the processes wants something, such as to stop; all learn it."""
    if share_of_batch().world == 1:
        return wanted
    flag = torch.tensor(float(wanted), device=device)
    distributed.all_reduce(flag, distributed.ReduceOp.MAX)
    return bool(flag)


def mean_over_processes(
    values: Mapping[str, float], device: torch.device | str = "cpu"
) -> dict[str, float]:
    """Means of figures that each process has of its share, under the same names in all of them."""
    share = share_of_batch()
    if share.world == 1:
        return dict(values)
    total = torch.tensor(list(values.values()), dtype=torch.float64, device=device)
    distributed.all_reduce(total)
    return dict(zip(values, (total / share.world).tolist(), strict=True))
