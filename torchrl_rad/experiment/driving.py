"""Who drives the episodes of an evaluation: this process, or workers of TorchRL's Ray collector."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential

from torchrl_rad.envs.task import Task
from torchrl_rad.experiment.episodes import HeldRows, Unit, load_starts, split_units
from torchrl_rad.experiment.factory import PolicyFactory, TaskRows
from torchrl_rad.experiment.ray_episodes import RayEpisodes, require_ray
from torchrl_rad.modules.replanning import with_replanning
from torchrl_rad.precision import planning_dtype
from torchrl_rad.runs import RunFolder

__all__ = ["UNIT_ROWS", "Driver", "check_evaluation", "collector_settings"]

UNIT_ROWS = 10  # of a unit on Ray: fewer plan slowly, more leave workers waiting at the end


def collector_settings(settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """``backend``, ``workers`` and ``rows`` of a config's ``collector``, with what is left out.

    Args:
        settings (mapping, optional): ``backend``, ``"direct"`` or ``"ray"``; ``workers``; ``rows``,
            episodes of a unit (None: all of them, on Ray 10). Defaults to this process alone.

    Raises:
        ImportError: the backend is not installed.
        ValueError: it is another word, a number is below 1, or this process should be several.

    Examples:
        >>> collector_settings(None)
        {'backend': 'direct', 'workers': 1, 'rows': None}
    """
    chosen = {"backend": "direct", "workers": 1, "rows": None, **(settings or {})}
    if chosen["backend"] not in ("direct", "ray"):
        raise ValueError(f"collector.backend is {chosen['backend']!r}; expected 'direct' or 'ray'.")
    if chosen["backend"] == "ray":
        require_ray()
        chosen["rows"] = UNIT_ROWS if chosen["rows"] is None else chosen["rows"]
    elif chosen["workers"] != 1:
        raise ValueError(
            f"collector.workers is {chosen['workers']}, but backend=direct is one process; "
            "use collector.backend=ray."
        )
    for name in ("workers", "rows"):
        if chosen[name] is not None and chosen[name] < 1:
            raise ValueError(f"collector.{name} is {chosen[name]}; expected at least 1.")
    return chosen


def check_evaluation(
    settings: Mapping[str, Any], task: Task, policies: Iterable[TensorDictSequential]
) -> None:
    """Refuses a config's ``evaluation`` that these policies or this task could not do.

    A recipe asks before it trains.

    Raises:
        FileNotFoundError: the data set of the start states is not here.
        ValueError: there is no episode, no such start, or a plan does not reach to the next one.
    """
    split_units(settings["episodes"], None, settings["seed"])
    replan = settings.get("replan", 1)
    if replan != 1:
        for policy in policies:
            with_replanning(policy, replan)
    if settings["starts"] is not None:
        starts = load_starts(settings["starts"])
        for number in range(task.variants(starts)):
            task.make_row(number, starts).close()


class Driver:
    """Drives the episodes that a config asks for, with one policy after another.

    With the same ``collector.rows`` the episodes are the same on every backend, whatever the number
    of workers. Environments and workers are made when they are first needed, and kept.

    Args:
        run (RunFolder): where the policies are saved; Ray's workers load them from there.
        cfg (mapping): the config.
        task (Task): what is driven in.
    """

    def __init__(self, run: RunFolder, cfg: Mapping[str, Any], task: Task):
        self.run, self.cfg, self.task = run, cfg, task
        self.collector = collector_settings(cfg.get("collector"))
        self._held: HeldRows | None = None
        self._workers: RayEpisodes | None = None

    def __call__(self, name: str, policy: TensorDictSequential) -> TensorDictBase:
        """The episodes [n, T] of a policy of the run."""
        settings = self.cfg["evaluation"]
        seed = settings["seed"] + self.cfg["seed"]
        units = split_units(settings["episodes"], self.collector["rows"], seed)
        replan = settings.get("replan", 1)
        options = {"name": name, "progress": self.cfg["logger"]["progress"]}
        if self.collector["backend"] == "ray":
            return self._on_ray(units, name, replan, options)
        if self._held is None:
            self._held = HeldRows(self.task, load_starts(settings["starts"]))
        acting: TensorDictModuleBase = policy if replan == 1 else with_replanning(policy, replan)
        dtype = planning_dtype(self.cfg["optim"]["precision"], self.cfg["device"])
        return self._held.drive(units, acting, self.task.max_steps, dtype=dtype, **options)

    def _on_ray(
        self, units: Sequence[Unit], name: str, replan: int, options: dict[str, Any]
    ) -> TensorDictBase:
        source = PolicyFactory(str(self.run.path / "policies" / name), replan=replan)
        if self._workers is None:
            rows = TaskRows(self.cfg["env"], self.cfg["evaluation"]["starts"])
            self._workers = RayEpisodes(rows, source, self.collector["workers"], units[0].rows)
        dtype = planning_dtype(self.cfg["optim"]["precision"])  # workers act on CPUs
        return self._workers.drive(units, source, self.task.max_steps, dtype=dtype, **options)

    def close(self) -> None:
        """Ends environments and workers."""
        if self._held is not None:
            self._held.close()
        if self._workers is not None:
            self._workers.close()
