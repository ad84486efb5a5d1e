"""Episodes driven by workers of TorchRL's Ray collector.

The workers are the remote collectors of a :class:`~torchrl.collectors.distributed.RayCollector`,
each with a policy that a factory loads from a path. Its iterator yields frames, which do not stop
at the end of a row's episode, and which a worker started anew would count from the beginning. So
the workers are asked for whole units instead: Ray's own ActorPool hands them out, and options of
Ray's actors, which a RayCollector passes on, start a dead worker anew and drive its unit again.
"""

from __future__ import annotations

import logging
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.collectors.distributed import RayCollector
from tqdm import tqdm

from torchrl_rad._files import CheckpointError
from torchrl_rad.experiment.episodes import Unit, collect_episodes, join_units
from torchrl_rad.experiment.factory import PolicyFactory, TaskRows

__all__ = ["EpisodeCollector", "RayEpisodes", "require_ray"]

ACTOR = {
    "num_cpus": 1,
    "max_restarts": 1000,
    "max_task_retries": 20,  # a unit that kills its worker each time ends the run at last
}


def require_ray() -> ModuleType:
    """Ray, if it is installed.

    Raises:
        ImportError: it is not.
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError(
            f"collector.backend=ray needs the package ray ({error}); install it with "
            'pip install "torchrl_rad[ray]", or use collector.backend=direct.'
        ) from error
    return ray


class EpisodeCollector(Collector):
    """A TorchRL collector that drives whole episodes, unit by unit.

    Args:
        create_env_fn (TaskRows): what it drives in.
        policy_factory (PolicyFactory): whose policy it has at first.
        frames_per_batch (int): rows of a unit; what the collector's own iterator would yield.
        **kwargs: of :class:`~torchrl.collectors.Collector`.
    """

    def __init__(
        self,
        create_env_fn: TaskRows,
        *,
        policy_factory: PolicyFactory,
        frames_per_batch: int,
        **kwargs: Any,
    ):
        self.source, self.held = policy_factory, create_env_fn.open()
        policy = policy_factory()
        env = self.held(Unit(0, 0, frames_per_batch, 0))
        super().__init__(env, policy, frames_per_batch=frames_per_batch, **kwargs)

    def __bool__(self) -> bool:
        # Ray asks for it where a method raised, and a collector without end has no len(): the
        # worker would die of that, again and again, and its error be lost
        return True

    def __repr__(self) -> str:
        return type(self).__name__  # in the messages of Ray, the whole policy otherwise

    def drive(
        self,
        unit: Unit,
        source: PolicyFactory,
        max_steps: int,
        dtype: torch.dtype | None,
        threads: int,
    ) -> tuple[int, TensorDictBase]:
        """The number of a unit and its episodes [rows, T], which depend on the arguments alone.

        Args:
            unit (Unit): which ones.
            source (PolicyFactory): the policy; loaded if it is another one than before.
            max_steps, dtype: as of :func:`~torchrl_rad.experiment.collect_episodes`.
            threads (int): of matrix products, whose sums depend on it in the last digits.
        """
        if source != self.source:
            self.policy, self.source = source(), source
        self.env = self.held(unit)
        torch.set_num_threads(threads)
        steps = collect_episodes(
            self.env, self.policy, max_steps, unit.seed, dtype=dtype, progress=False
        )
        return unit.number, steps


class RayEpisodes:
    """Workers of a Ray collector that drive units of episodes.

    Ray is started on this machine unless it runs already or ``RAY_ADDRESS`` names a cluster.

    Args:
        rows (TaskRows): what is driven in.
        source (PolicyFactory): whose policy, with its own database, workers load at first.
        workers (int): number of processes, each of one CPU.
        unit_rows (int): rows of a unit, to make their environments at the start.

    Raises:
        ImportError: Ray is not installed.
        ValueError: there are fewer CPUs than workers, or ``workers`` is below 1.
        CheckpointError: a worker cannot start: it has other versions, or does not see a path.
    """

    def __init__(self, rows: TaskRows, source: PolicyFactory, workers: int, unit_rows: int):
        ray = require_ray()
        if workers < 1:
            raise ValueError(f"collector.workers is {workers}; at least one is needed.")
        self._started = not ray.is_initialized()
        if self._started:
            ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
        try:
            _require_cpus(ray, workers)
            # a worker that starts anew begins with this too, when a growing database has grown
            source = replace(source, database=None, stamp=None)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "The policy is not an nn.Module")
                self.collector = RayCollector(
                    [rows] * workers,
                    policy_factory=[source] * workers,
                    collector_class=EpisodeCollector,
                    collector_kwargs={"trust_policy": True, "use_buffers": False},
                    frames_per_batch=unit_rows,
                    remote_configs=dict(ACTOR),
                    weight_sync_schemes={},  # policies come from paths
                )
        except BaseException as error:
            # the half-made collector goes now: its `__del__` calls Ray, which would start it anew
            traceback.clear_frames(error.__traceback__)
            self._stop(ray)
            if isinstance(error, ray.exceptions.RayActorError):
                raise _refusal(error) from error
            raise

    def drive(
        self,
        units: Sequence[Unit],
        source: PolicyFactory,
        max_steps: int,
        name: str = "policy",
        dtype: torch.dtype | None = None,
        progress: bool = True,
    ) -> TensorDictBase:
        """The episodes [n, T] of all units, in their order.

        Each unit gives one result, however many workers die; without a death each is driven once.

        Args:
            units (sequence of Unit): which ones.
            source (PolicyFactory): the policy.
            max_steps, name, dtype, progress: as of
                :func:`~torchrl_rad.experiment.collect_episodes`; the bar counts episodes.

        Raises:
            CheckpointError: a worker cannot start anew, or a unit killed its workers 21 times.
            Exception: what a worker raised.
        """
        ray = require_ray()
        settings = (source, max_steps, dtype, torch.get_num_threads())
        pool = ray.util.ActorPool(self.collector.remote_collectors)
        answers = pool.map_unordered(
            lambda worker, unit: worker.drive.remote(unit, *settings), units
        )
        total = sum(unit.rows for unit in units)
        found: dict[int, TensorDictBase] = {}
        bar = tqdm(total=total, desc=f"evaluating {name}", unit="episode", disable=not progress)
        try:
            with bar:
                for number, steps in answers:
                    found[number] = steps
                    bar.update(len(steps))
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except ray.exceptions.RayActorError as error:
            raise _refusal(error) from error
        return join_units([found[unit.number] for unit in units])

    def close(self) -> None:
        """Ends the workers, and Ray if it was started here."""
        self.collector.shutdown()
        self._stop(require_ray())

    def _stop(self, ray: ModuleType) -> None:
        if self._started:
            ray.shutdown()


def _require_cpus(ray: ModuleType, workers: int) -> None:
    """Refuses what would wait for ever."""
    there = int(ray.cluster_resources().get("CPU", 0))
    if there < workers:
        raise ValueError(
            f"collector.workers is {workers}, but Ray has {there} CPUs; a worker takes one of them."
        )


def _refusal(error: Exception) -> CheckpointError:
    """The error of a worker that could not start: of its traceback the last line."""
    last = str(error).strip().splitlines()[-1]
    return CheckpointError(f"a worker of the Ray collector is lost for good: {last}")
