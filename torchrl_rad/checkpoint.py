"""Checkpoints that outlive kills and full disks, and weights, as safetensors and JSON.

:mod:`torchrl.checkpoint` does not serve here: it writes tensors through memory maps, where a full
disk ends the process with SIGBUS, and its reader unpickles any sidecar file that a folder brings.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from torchrl_rad._files import (
    MANIFEST,
    STAGE,
    CheckpointError,
    read_json,
    sha256,
    staged_folder,
    verify_manifest,
    write_atomic,
    write_json,
    write_manifest,
)
from torchrl_rad._states import (
    load_state,
    load_tensors,
    save_state,
    save_tensors,
    set_state,
    state_digest,
)
from torchrl_rad.parallel import is_first

__all__ = [
    "CheckpointError",
    "Checkpointer",
    "latest_checkpoint",
    "load_checkpoint",
    "load_tensors",
    "load_weights",
    "read_json",
    "save_tensors",
    "save_weights",
    "sha256",
    "staged_folder",
    "state_digest",
    "verify_manifest",
    "write_atomic",
    "write_json",
    "write_manifest",
]

META = "meta.json"


class Checkpointer:
    """Writes the checkpoints of one run into a folder and keeps the newest.

    Each is a folder ``step-<step>-<number>``, the numbers counting the saves. It is written under
    another name, brought to the disk and then renamed, so a kill or power loss at any instant
    leaves the older ones and either the whole new one or nothing of it; what is left of an
    interrupted save is removed when the next run opens the folder. One run writes in a folder at a
    time; any number may read it with :func:`latest_checkpoint` and :func:`load_checkpoint`.

    Args:
        folder (path): made if need be, and tried for writing now, not after hours of training.
        keep (int, optional): how many checkpoints to keep; with 2, one is left should the newest be
            damaged later. Defaults to ``2``.

    Raises:
        CheckpointError: the folder cannot be written.
        ValueError: ``keep`` is less than 1.

    Examples:
        >>> import tempfile, torch
        >>> from torchrl.checkpoint import GlobalRNGState
        >>> net = nn.Linear(2, 1)
        >>> adam = torch.optim.AdamW(net.parameters())
        >>> parts = {"net": net, "optimizer": adam, "rng": GlobalRNGState()}
        >>> checkpointer = Checkpointer(tempfile.mkdtemp())
        >>> checkpointer.save(1000, parts, {"task": "pointmaze-umaze"}).name
        'step-00001000-0001'
        >>> checkpointer.load(None, parts, {"task": "pointmaze-umaze"})
        {'task': 'pointmaze-umaze', 'step': 1000}
    """

    def __init__(self, folder: str | Path, keep: int = 2):
        if keep < 1:
            raise ValueError(f"keep={keep}: at least one checkpoint must be kept.")
        self.folder, self.keep = Path(folder).absolute(), keep
        if not is_first():  # of a process group the others read alone
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomic(self.folder / f"{STAGE}probe", b"0")
        except OSError as error:
            raise CheckpointError(
                f"checkpoints cannot be written to {self.folder}: {_why(error)}. Choose another."
            ) from error
        for left in self.folder.glob(f"{STAGE}*"):
            _remove(left)

    def save(
        self, step: int, components: Mapping[str, Any], meta: Mapping[str, Any] | None = None
    ) -> Path:
        """Saves the state of every component, then removes checkpoints beyond ``keep``.

        Args:
            step (int): of training.
            components (mapping): name to module, loss module, optimizer, scheduler, generator
                (torch or numpy), :class:`torchrl.checkpoint.GlobalRNGState`, or anything with
                ``state_dict`` and ``load_state_dict``.
            meta (mapping, optional): what it belongs to, as JSON: task, hash of the normaliser.

        Returns:
            Path: the checkpoint.

        Raises:
            CheckpointError: the disk is full or the folder cannot be written; older checkpoints are
                intact.
            TypeError: a state holds something other than tensors, numbers, text, lists, tuples,
                dicts and None.
            ValueError: ``step`` is negative, or a component's name cannot be a file name.
        """
        if step < 0:
            raise ValueError(f"step={step} is negative.")
        for name in components:
            if not re.fullmatch(r"\w[\w.-]*", name) or f"{name}.json" in (META, MANIFEST):
                raise ValueError(f"component name {name!r} cannot be a file name; take another.")
        try:
            number = max((number for number, _ in _checkpoints(self.folder)), default=0) + 1
            target = self.folder / f"step-{step:08d}-{number:04d}"
            with staged_folder(target) as stage:
                for name, component in components.items():
                    save_state(stage, name, component)
                write_json(stage / META, {**(meta or {}), "step": step})
        except OSError as error:
            raise CheckpointError(self._failure(step, error)) from error
        self._prune()
        return target

    def _prune(self) -> None:
        paths = [path for _, path in _checkpoints(self.folder)]
        kept = [path for path in paths if (path / MANIFEST).exists()][-self.keep :]
        for path in paths:
            if path not in kept:
                _remove(path)

    def latest(self) -> Path | None:
        """See :func:`latest_checkpoint`."""
        return latest_checkpoint(self.folder)

    def load(
        self,
        path: str | Path | None,
        components: Mapping[str, Any],
        meta_expected: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """See :func:`load_checkpoint`; the newest where ``path`` is None."""
        path = self.latest() if path is None else path
        if path is None:
            raise CheckpointError(f"{self.folder} holds no checkpoint to resume from.")
        return load_checkpoint(path, components, meta_expected)

    def _failure(self, step: int, error: OSError) -> str:
        left = _checkpoints(self.folder)
        rest = f"the previous one, {left[-1][1]}, is intact" if left else "there is no earlier one"
        return f"checkpoint of step {step} not saved in {self.folder}: {_why(error)}; {rest}."


def latest_checkpoint(folder: str | Path) -> Path | None:
    """The checkpoint that was saved last, its files checked; None where there is none.

    Args:
        folder (path): of a :class:`Checkpointer`.

    Raises:
        CheckpointError: it is damaged; the message names the older one that could be used.

    Examples:
        >>> import tempfile
        >>> latest_checkpoint(tempfile.mkdtemp()) is None
        True
    """
    paths = [path for _, path in _checkpoints(Path(folder)) if (path / MANIFEST).exists()]
    failure: CheckpointError | None = None
    for path in reversed(paths):
        try:
            verify_manifest(path)
        except CheckpointError as error:
            failure = failure or error
            continue
        if failure is None:
            return path
        # going back in silence would throw away work that the user believes is there
        raise CheckpointError(
            f"{failure} The older {path} is whole: load it by its path, or remove {paths[-1]}."
        ) from failure
    if failure is not None:
        raise CheckpointError(f"{failure} No older checkpoint in {folder} is whole.") from failure
    return None


def load_checkpoint(
    path: str | Path, components: Mapping[str, Any], meta_expected: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Puts saved states back into components, bit for bit, each on the device it is on now.

    Build everything that draws random numbers while being built (data iterators too) before.

    Args:
        path (path): of one checkpoint.
        components (mapping): as in :meth:`Checkpointer.save`; some of those saved will do.
        meta_expected (mapping, optional): entries that the saved ``meta`` must have.

    Returns:
        dict: the saved ``meta``, with ``"step"``.

    Raises:
        CheckpointError: a file is damaged, cut short or missing, or the checkpoint belongs to
            another task or data: nothing was loaded. Or a component has another shape: those before
            it were loaded.
    """
    path = Path(path)
    listed = verify_manifest(path)
    meta = read_json(path / META)
    for key, value in (meta_expected or {}).items():
        if meta.get(key) != json.loads(json.dumps(value)):  # JSON turns tuples into lists
            raise CheckpointError(
                f"{path} is a checkpoint of {key} {meta.get(key)!r}, this run is {key} {value!r}: "
                f"resume with the same {key}, or start a new run in another folder."
            )
    saved = [name.removesuffix(".safetensors") for name in listed if name.endswith(".safetensors")]
    missing = [name for name in components if name not in saved]
    if missing:
        raise CheckpointError(f"{path} holds {saved}, not {missing}.")
    states = {name: load_state(path, name) for name in components}
    for name, component in components.items():
        try:
            set_state(component, states[name])
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise CheckpointError(f"{name!r} in {path} does not fit this run: {error}") from error
    return meta


def save_weights(folder: str | Path, name: str, module: nn.Module) -> None:
    """Saves a module as ``<name>.safetensors``; :func:`write_manifest` ends the folder.

    Examples:
        >>> import tempfile
        >>> folder, net = tempfile.mkdtemp(), nn.Linear(2, 1)
        >>> save_weights(folder, "net", net)
        >>> write_manifest(folder)
        >>> load_weights(folder, "net", nn.Linear(2, 1))
    """
    save_tensors(Path(folder) / f"{name}.safetensors", module.state_dict())


def load_weights(folder: str | Path, name: str, module: nn.Module) -> None:
    """Loads what :func:`save_weights` saved, if its sha256 is the one in the folder's manifest.

    Raises:
        CheckpointError: the file is damaged, cut short, missing or not listed, or of another
            architecture.
    """
    file = f"{name}.safetensors"
    verify_manifest(folder, [file])
    try:
        module.load_state_dict(load_tensors(Path(folder) / file))
    except RuntimeError as error:
        first, *others = [line.strip() for line in str(error).splitlines()[1:]] or [str(error)]
        more = f" (and {len(others)} more)" if others else ""
        raise CheckpointError(
            f"{Path(folder) / file} does not fit this module, of another task or with other "
            f"settings: {first}{more}"
        ) from error


def _checkpoints(folder: Path) -> list[tuple[int, Path]]:
    """In the order of saving: a run that went back must not find its abandoned future."""
    found = []
    for path in folder.glob("step-*"):
        match = re.fullmatch(r"step-\d+-(\d+)", path.name)
        if match:
            found.append((int(match[1]), path))
    return sorted(found)


def _remove(path: Path) -> None:
    """Removes a file or folder; no half-removed checkpoint keeps its name."""
    try:
        if not path.name.startswith(STAGE):
            hidden = path.with_name(f"{STAGE}{path.name}-{uuid.uuid4().hex}")
            os.replace(path, hidden)
            path = hidden
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    except OSError as error:  # the new checkpoint is safe, so training goes on
        warnings.warn(f"{path} could not be removed: {_why(error)}", stacklevel=3)


def _why(error: OSError) -> str:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return "the disk is full" if full else error.strerror or str(error)
