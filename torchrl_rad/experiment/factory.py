"""A policy and its environment as another process builds them: by name and path, never pickled."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from torchrl_rad._files import CheckpointError
from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.data.saved import database_stamp
from torchrl_rad.envs.task import Task
from torchrl_rad.envs.tasks import make_task
from torchrl_rad.experiment.episodes import HeldRows, load_starts
from torchrl_rad.modules.replanning import with_replanning
from torchrl_rad.policy import load_policy
from torchrl_rad.runs import package_versions

__all__ = ["PolicyFactory", "TaskRows"]


@dataclass(frozen=True)
class PolicyFactory:
    """Loads a saved policy where it is called: a ``policy_factory`` for TorchRL's collectors.

    It is sent as the paths below, some hundred bytes; weights and rows are read by the process that
    calls it, the rows through a memory map that processes of one machine share.

    Attributes:
        folder: written by :func:`~torchrl_rad.policy.save_policy`; seen by all processes.
        database: another database than the policy's own, of
            :meth:`~torchrl_rad.data.ExpertDatabase.dumps`.
        stamp: of that database, as of :func:`~torchrl_rad.data.saved.database_stamp`, if it
            changes: who finds another content refuses to act.
        replan: steps from plan to plan.
        versions: of the packages on which results depend, where this was made.

    Examples:
        >>> PolicyFactory("nowhere")()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        FileNotFoundError: ... does not see nowhere...
    """

    folder: str
    database: str | None = None
    stamp: str | None = None
    replan: int = 1
    versions: Mapping[str, str] = field(default_factory=package_versions)

    def __call__(self) -> TensorDictModuleBase:
        """The policy, on the CPU.

        Raises:
            CheckpointError: this process has other versions, the database is not the one of
                ``stamp``, or a file is damaged.
            FileNotFoundError: this process does not see a folder.
        """
        host = socket.gethostname()
        check_versions(self.versions, host)
        for path in filter(None, (self.folder, self.database)):
            if not Path(path).is_dir():
                raise FileNotFoundError(
                    f"a worker on {host} does not see {path}. Put it on a drive that all machines "
                    "mount under the same path."
                )
        database = None
        if self.database is not None:
            database = ExpertDatabase.loads(self.database, memmap=True)
            found = database_stamp(self.database)
            if self.stamp not in (None, found):
                raise CheckpointError(
                    f"a worker on {host} sees another content of {self.database} than was saved "
                    f"there: its stamp is {found[:12]}, expected {str(self.stamp)[:12]}. Save each "
                    "version in a folder of its own if the drive is slow to show changes."
                )
        policy = load_policy(self.folder, database, memmap=True)
        return policy if self.replan == 1 else with_replanning(policy, self.replan)


def check_versions(expected: Mapping[str, str], host: str) -> None:
    """Compares the versions of packages with those of this process.

    Raises:
        CheckpointError: names those that differ.

    Examples:
        >>> check_versions({**package_versions(), "torchrl_rad": "0.0.1"}, "node7")
        Traceback (most recent call last):
        torchrl_rad._files.CheckpointError: a worker on node7 has torchrl_rad 0.1.0, ...
    """
    here = package_versions()
    other = {name: here.get(name) for name in expected if here.get(name) != expected[name]}
    if other:
        has = ", ".join(f"{name} {version}" for name, version in other.items())
        needs = ", ".join(f"{name} {expected[name]}" for name in other)
        raise CheckpointError(
            f"a worker on {host} has {has}, but the process that asks has {needs}; results would "
            "differ. Install the same versions on all machines."
        )


@dataclass(frozen=True)
class TaskRows:
    """Rows of a task by the ``env`` and ``evaluation.starts`` of a config.

    Attributes:
        env: as of :func:`~torchrl_rad.envs.make_task`.
        starts: as of :func:`~torchrl_rad.experiment.load_starts`.
    """

    env: Mapping[str, Any]
    starts: Mapping[str, Any] | None = None

    def task(self) -> Task:
        """What they are of."""
        return make_task(self.env)

    def open(self) -> HeldRows:
        """The environments."""
        return HeldRows(self.task(), load_starts(self.starts))
