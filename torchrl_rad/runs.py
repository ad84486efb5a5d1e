"""What a run leaves in its folder: config, metrics, episodes, results."""

from __future__ import annotations

import csv
import fcntl
import io
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_rad._files import CheckpointError, read_json, write_atomic, write_json
from torchrl_rad._states import load_tensors, save_tensors
from torchrl_rad.results import ERROR

__all__ = ["MetricsLog", "RunFolder", "environment_facts", "package_versions"]

PACKAGES = ("torchrl_rad", "torch", "torchrl", "tensordict", "gymnasium", "gymnasium_robotics",
            "mujoco", "numpy", "scipy")  # fmt: skip


class MetricsLog:
    r"""A csv table with one row for each logged step; a resumed run drops the rows it does again.

    Args:
        path (path): the file; read if it exists.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "metrics.csv"
        >>> log = MetricsLog(path)
        >>> log.write(10, {"loss": 0.5})
        >>> log.write(20, {"loss": 0.25})
        >>> MetricsLog(path).rewind(10)
        >>> path.read_text()
        'step,loss\n10,0.5\n'
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def rows(self) -> list[dict[str, float]]:
        """All rows; a last line that was cut short by a kill is left out."""
        if not self.path.exists():
            return []
        lines = self.path.read_text().splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("\n")]
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(whole)]

    def rewind(self, step: int) -> None:
        """Drops the rows after ``step``."""
        kept = [row for row in self.rows() if row["step"] <= step]
        text = io.StringIO()
        for row in kept:
            self._write(text, row, header=row is kept[0])
        write_atomic(self.path, text.getvalue())

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Appends a row."""
        empty = not self.path.exists() or self.path.stat().st_size == 0
        with open(self.path, "a", newline="") as file:
            self._write(file, {"step": step, **values}, header=empty)

    def _write(self, file, row: Mapping[str, float], header: bool) -> None:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        if header:
            writer.writeheader()
        # repr of a float reads back as the same number
        writer.writerow({**row, "step": int(row["step"])})


class RunFolder:
    """A folder with everything that a run made, from which it can be resumed.

    ==========================  ===========================================================
    ``config.json``             the resolved config
    ``metrics.csv``             losses and errors while training
    ``checkpoints/``            see :class:`~torchrl_rad.checkpoint.Checkpointer`
    ``value/``, ``value.csv``   the same of a learned value, where there is one
    ``policies/<name>/``        see :func:`~torchrl_rad.policy.save_policy`
    ``episodes/<name>``         every episode of the evaluation, safetensors
    ``results.json``            each figure of the table and each episode's return
    ``curves.png``              losses
    ``targets.png``             paths, retrieved targets and plans
    ``error.txt``               what the run died of, if it did
    ==========================  ===========================================================

    Args:
        path (path): the folder.

    Examples:
        >>> import tempfile
        >>> run = RunFolder.create(Path(tempfile.mkdtemp()) / "run", {"seed": 0})
        >>> RunFolder.open(run.path).config()
        {'seed': 0}
    """

    def __init__(self, path: str | Path):
        self.path = Path(path).absolute()
        self.metrics = MetricsLog(self.path / "metrics.csv")
        self.value_metrics = MetricsLog(self.path / "value.csv")

    @classmethod
    def create(cls, path: str | Path, config: Mapping[str, Any]) -> RunFolder:
        """Makes the folder and writes the config.

        Raises:
            CheckpointError: it cannot be written, or holds another run.
        """
        run = cls(path)
        try:
            run.path.mkdir(parents=True, exist_ok=True)
            if (run.path / "config.json").exists():
                raise CheckpointError(
                    f"{run.path} holds a run already; go on with it by resume={run.path}, "
                    "or choose another folder."
                )
            write_json(run.path / "config.json", config)
        except OSError as error:
            raise CheckpointError(
                f"the run folder {run.path} cannot be written: {error.strerror}. "
                "Choose another with folder=<path>."
            ) from error
        return run

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Opens the folder of an earlier run.

        Raises:
            FileNotFoundError: it holds no run.
        """
        run = cls(path)
        if not (run.path / "config.json").exists():
            raise FileNotFoundError(
                f"{run.path} holds no run: config.json is missing. "
                "Pass the folder that the run printed when it began."
            )
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps other runs from writing here; a killed process holds nothing.

        Raises:
            CheckpointError: another one is writing.
        """
        with open(self.path / ".lock", "a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise CheckpointError(
                    f"another run is writing to {self.path}; wait for its end, or choose another "
                    "folder with folder=<path>."
                ) from error
            yield

    def config(self) -> dict[str, Any]:
        """The config of the run."""
        return read_json(self.path / "config.json")

    def note_error(self, text: str | None) -> None:
        """Notes what the run died of, or that it lives, in ``error.txt``."""
        file = self.path / ERROR
        if text is None:
            file.unlink(missing_ok=True)
        else:
            write_atomic(file, f"{text}\n")

    def results(self) -> dict[str, Any]:
        """The content of ``results.json``; empty before there are any."""
        file = self.path / "results.json"
        return read_json(file) if file.exists() else {}

    def save_episodes(self, name: str, steps: TensorDictBase) -> None:
        """Saves the steps [n, T] of an evaluation."""
        (self.path / "episodes").mkdir(exist_ok=True)
        flat = {_joined(key): value for key, value in steps.items(True, True)}
        save_tensors(self.path / "episodes" / f"{name}.safetensors", flat)

    def load_episodes(self, name: str) -> TensorDict | None:
        """What :meth:`save_episodes` saved; None if there is nothing."""
        file = self.path / "episodes" / f"{name}.safetensors"
        if not file.exists():
            return None
        tensors = load_tensors(file)
        batch = tensors["observation"].shape[:2]
        return TensorDict({tuple(k.split("/")): v for k, v in tensors.items()}, batch)


def _joined(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else "/".join(key)


def environment_facts(command: Sequence[str] | None = None) -> dict[str, Any]:
    """Versions, processor, threads and command of this process, for ``results.json``.

    Examples:
        >>> sorted(environment_facts(["dl_rad.py"]))
        ['command', 'cpus', 'machine', 'python', 'threads', 'versions']
    """
    return {
        "command": " ".join(["python", *(sys.argv if command is None else command)]),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "versions": package_versions(),
    }


def package_versions() -> dict[str, str]:
    """Versions of the packages on which results depend, in this process.

    Examples:
        >>> package_versions()["torchrl_rad"]
        '0.1.0'
    """
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions
