"""Whole plans and whole training steps as CUDA graphs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

from tensordict import TensorDict
from tensordict.nn import CudaGraphModule
from torch import Tensor

__all__ = ["CapturedPlan", "in_graph"]


def in_graph(function: Callable[..., Any]) -> CudaGraphModule:
    """A function of tensors that runs as one CUDA graph from its third call on.

    It must not wait for the GPU, and its inputs must keep their shapes. Without a GPU it is called
    as it is.

    Examples:
        >>> import torch
        >>> in_graph(lambda x: x + 1)(torch.zeros(1))
        tensor([1.])
    """
    with warnings.catch_warnings():  # whoever asks for a GPU that is not there is told elsewhere
        warnings.filterwarnings("ignore", "This module is instantiated on a machine without CUDA")
        warnings.filterwarnings("ignore", "Tensordict is registered in PyTree")
        return CudaGraphModule(function)


class CapturedPlan:
    """Runs a planner's ``plan`` as CUDA graphs, one for each number of rows.

    Examples:
        >>> import torch
        >>> def plan(state, pins):
        ...     return state[:, None] + pins[1][0]
        >>> CapturedPlan()(plan, torch.ones(2, 1), [None, (torch.ones(1),)]).squeeze().tolist()
        [2.0, 2.0]
    """

    def __init__(self) -> None:
        self.graphs: dict[tuple[Any, ...], CudaGraphModule] = {}

    def __reduce__(self):
        return CapturedPlan, ()  # copies and pickles are empty

    def __call__(
        self, plan: Callable[[Tensor, Sequence[Any]], Tensor], state: Tensor, pins: Sequence[Any]
    ) -> Tensor:
        """``plan(state, pins)``, whose pins are tuples of tensors, or None."""
        owner = id(getattr(plan, "__self__", plan))  # a shallow copy has graphs of its own
        key = (owner, len(state), *(pin is not None for pin in pins))
        if key not in self.graphs:
            self.graphs[key] = in_graph(_of_entries(plan, pins))
        return self.graphs[key](_entries(state, pins))["plan"]


def _entries(state: Tensor, pins: Sequence[Any]) -> TensorDict:
    """What a plan is made from, as one TensorDict []."""
    parts = {
        f"{number}_{place}": part
        for number, pin in enumerate(pins)
        if pin is not None
        for place, part in enumerate(pin)
    }
    return TensorDict({"state": state, **parts})


def _of_entries(
    plan: Callable[[Tensor, Sequence[Any]], Tensor], like: Sequence[Any]
) -> Callable[[TensorDict], TensorDict]:
    """``plan`` of :func:`_entries`, for pins like these."""
    kinds = [None if pin is None else (type(pin), len(pin)) for pin in like]

    def of_entries(entries: TensorDict) -> TensorDict:
        pins: list[Any] = []
        for number, kind in enumerate(kinds):
            if kind is None:
                pins.append(None)
                continue
            parts = [entries[f"{number}_{place}"] for place in range(kind[1])]
            pins.append(kind[0](*parts) if hasattr(kind[0], "_fields") else tuple(parts))
        return TensorDict({"plan": plan(entries["state"], pins)})

    return of_entries
