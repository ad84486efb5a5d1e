"""States of modules, optimizers and generators as safetensors and JSON: nothing to unpickle."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from torchrl_rad._files import CheckpointError, read_json, write_atomic, write_json

__all__ = ["load_state", "load_tensors", "save_state", "save_tensors", "set_state", "state_digest"]


def save_tensors(path: str | Path, tensors: Mapping[str, Tensor]) -> None:
    """Writes named tensors as one safetensors file, atomically.

    Args:
        path (path): see :func:`write_atomic`.
        tensors (mapping of str to Tensor): of any device; those that share memory are saved apart.

    Raises:
        OSError: see :func:`write_atomic`.
        TypeError: safetensors has no form for a tensor (sparse, quantised, complex128).

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "w.safetensors"
        >>> save_tensors(path, {"w": torch.ones(2, dtype=torch.bfloat16)})
        >>> load_tensors(path)
        {'w': tensor([1., 1.], dtype=torch.bfloat16)}
    """
    own: dict[str, Tensor] = {}
    seen = set()
    for name, tensor in tensors.items():
        if tensor.layout != torch.strided or tensor.is_quantized:
            raise TypeError(f"tensor {name!r} cannot be saved: use to_dense() or dequantize().")
        tensor = tensor.detach().cpu().contiguous()
        pointer = tensor.untyped_storage().data_ptr()
        # safetensors refuses tensors that share memory
        own[name] = tensor.clone() if pointer in seen else tensor
        seen.add(pointer)
    try:
        data = save(own)
    except (KeyError, SafetensorError) as error:
        raise TypeError(f"{Path(path).name} cannot hold these tensors: {error}.") from error
    write_atomic(path, data)


def load_tensors(path: str | Path, device: str | torch.device = "cpu") -> dict[str, Tensor]:
    """Reads what :func:`save_tensors` wrote; the tensors own their memory.

    Args:
        path (path): the file.
        device (str or torch.device, optional): where the tensors are put. Defaults to ``"cpu"``.

    Raises:
        CheckpointError: the file is not a whole safetensors file.
        FileNotFoundError: there is none.
    """
    try:
        tensors = load(Path(path).read_bytes())
    except (SafetensorError, ValueError, KeyError, AssertionError, RuntimeError) as error:
        raise CheckpointError(f"{path} is damaged: it is not safetensors ({error}).") from error
    return {name: tensor.to(device, copy=True) for name, tensor in tensors.items()}


def state_digest(state_dict: Mapping[str, Any]) -> str:
    """sha256 over names, shapes, dtypes and bytes: the identity of a normaliser or a data set.

    Args:
        state_dict (mapping): tensors on any device, numbers or text; the order does not matter.

    Examples:
        >>> state_digest({"mean": torch.zeros(2)})[:8] == state_digest({"mean": torch.zeros(2)})[:8]
        True
        >>> state_digest({"mean": torch.zeros(2)}) == state_digest({"mean": torch.zeros(1, 2)})
        False
    """
    hashed = hashlib.sha256()
    for name in sorted(state_dict):
        tensors: dict[str, Tensor] = {}
        form = _encode(state_dict[name], tensors, name)
        shapes = [[str(tensor.dtype), list(tensor.shape)] for tensor in tensors.values()]
        hashed.update(json.dumps([name, form, shapes]).encode())
        for tensor in tensors.values():
            flat = tensor.detach().cpu().contiguous().reshape(-1)
            hashed.update(flat.view(torch.uint8).numpy().data)
    return hashed.hexdigest()


def save_state(folder: Path, name: str, component: Any) -> None:
    """Writes a component's state as ``<name>.json`` and ``<name>.safetensors``."""
    tensors: dict[str, Tensor] = {}
    write_json(folder / f"{name}.json", _encode(_get_state(component), tensors, name))
    save_tensors(folder / f"{name}.safetensors", tensors)


def load_state(folder: Path, name: str) -> Any:
    """Reads what :func:`save_state` wrote, for :func:`set_state`."""
    tensors = load_tensors(folder / f"{name}.safetensors")
    try:
        return _decode(read_json(folder / f"{name}.json"), tensors)
    except (KeyError, TypeError, ValueError, OSError, RecursionError) as error:
        raise CheckpointError(f"{folder / name}.json is not a saved state: {error!r}.") from error


def set_state(component: Any, state: Any) -> None:
    """Puts a state into a module, optimizer, scheduler or random generator."""
    if isinstance(component, torch.Generator):
        component.set_state(state["state"])
    elif isinstance(component, np.random.Generator):
        component.bit_generator.state = state
    else:
        component.load_state_dict(state)


def _get_state(component: Any) -> Any:
    if isinstance(component, torch.Generator):
        return {"state": component.get_state()}
    if isinstance(component, np.random.Generator):
        return component.bit_generator.state
    return component.state_dict()


def _encode(value: Any, tensors: dict[str, Tensor], name: str) -> Any:
    """JSON for a nested state; its tensors are put into ``tensors`` under readable names."""
    if isinstance(value, Tensor):
        while name in tensors:  # {"a.b": ...} beside {"a": {"b": ...}}
            name += "_"
        tensors[name] = value
        return {"tensor": name}
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, (str, int, float)):
                raise TypeError(f"{name} has the key {key!r}; only text and numbers can be saved.")
        # pairs, since JSON's own keys are text and an optimizer's are numbers
        pairs = [[key, _encode(item, tensors, f"{name}.{key}")] for key, item in value.items()]
        return {"dict": pairs}
    if isinstance(value, (list, tuple)):
        items = [_encode(item, tensors, f"{name}.{index}") for index, item in enumerate(value)]
        return {"tuple" if isinstance(value, tuple) else "list": items}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    kind = type(value).__name__
    raise TypeError(f"{name} is a {kind}, which cannot be saved: make it a tensor or a number.")


def _decode(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "dict":
        return {key: _decode(item, tensors) for key, item in content}
    items = [_decode(item, tensors) for item in content]
    return tuple(items) if kind == "tuple" else items
