"""The table of a run, and one table of several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_rad._files import CheckpointError, read_json, write_json
from torchrl_rad.evaluation import interval

__all__ = ["format_table", "merge_results", "merge_sweep", "write_results"]

ERROR = "error.txt"  # in a run folder: what it died of
MEANS = (
    "return", "length", "success", "arrival", "share", "found", "similarity", "step_error",
)  # fmt: skip
COLUMNS = {  # key: (heading, format)
    "return": ("return", "{:.1f}"),
    "score": ("score", "{:.1f}"),
    "interval": ("+- 95 %", "{:.1f}"),
    "length": ("steps", "{:.0f}"),
    "success": ("success", "{:.2f}"),
    "arrival": ("steps to goal", "{:.0f}"),
    "share": ("share at goal", "{:.3f}"),
    "found": ("found", "{:.3f}"),
    "similarity": ("similarity", "{:.3f}"),
    "step_error": ("step error", "{:.1f}"),
    "episodes": ("episodes", "{:.0f}"),
    "TS": ("TS ms", "{}"),
    "SE": ("SE ms", "{}"),
    "PL": ("PL ms", "{}"),
    "rollout_s": ("rollout s", "{:.0f}"),
    "seeds": ("score of each seed", "{}"),
}


def format_table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """A Markdown table, one line a policy; columns that no row has are left out.

    Args:
        rows (mapping): name -> figures, named as in ``COLUMNS``; NaN and None show as a dash.

    Examples:
        >>> print(format_table({"backbone": {"return": 12.0, "score": float("nan")}}))
        | policy | return | score |
        |---|---|---|
        | backbone | 12.0 | - |
    """
    keys = [key for key in COLUMNS if any(key in row for row in rows.values())]
    lines = [
        f"| policy | {' | '.join(COLUMNS[key][0] for key in keys)} |",
        "|---" * (len(keys) + 1) + "|",
    ]
    for name, row in rows.items():
        cells = [_cell(row.get(key), COLUMNS[key][1]) for key in keys]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "-"
    return form.format(value)


def merge_results(folders: Sequence[str | Path]) -> dict[str, dict[str, Any]]:
    """Rows of several runs of one task, seeds taken together.

    The score is the mean over seeds. Its interval treats episodes as independent given the seed,
    and adds the spread between seeds: the larger of both 95 % half widths is given.

    Args:
        folders (sequence of path): run folders with a ``results.json``.

    Returns:
        name -> figures, for :func:`format_table`.

    Raises:
        CheckpointError: no folders; or one has no results, or those of another task.
    """
    if len(folders) == 0:
        raise CheckpointError("no run folders to merge; pass one or more.")
    runs = [_read(Path(folder)) for folder in folders]
    tasks = {run["task"] for run in runs}
    if len(tasks) != 1:
        raise CheckpointError(f"these runs are of several tasks, {sorted(tasks)}; merge each.")
    return _merge_runs(runs)


def merge_sweep(folders: Sequence[str | Path]) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Rows of the runs of a sweep, task by task, and which runs have no results.

    Args:
        folders (sequence of path): run folders, of any tasks.

    Returns:
        Figures for :func:`format_table` by ``"<task> <policy>"``, or by the policy alone where all
        runs are of one task; and folder -> what its run died of.

    Raises:
        CheckpointError: no folders, or a ``results.json`` that is not of a run.
    """
    if len(folders) == 0:
        raise CheckpointError("no run folders to merge; pass one or more.")
    tasks: dict[str, list[dict[str, Any]]] = {}
    failed = {}
    for folder in map(Path, folders):
        if (folder / "results.json").exists():
            run = _read(folder)
            tasks.setdefault(run["task"], []).append(run)
        else:
            file = folder / ERROR
            why = file.read_text().strip() if file.exists() else "it is not over, or was killed"
            failed[str(folder)] = why
    rows = {}
    for task, of_task in tasks.items():
        for name, row in _merge_runs(of_task).items():
            rows[name if len(tasks) == 1 else f"{task} {name}"] = row
    return rows, failed


def write_results(folder: str | Path, results: Mapping[str, Any]) -> None:
    """Writes ``results.json`` into a run folder; NaN and Inf, which JSON does not know, are null.

    Args:
        folder (path): of the run.
        results (mapping): ``task``, ``rows`` (name -> figures) and what else is known of the run.

    Raises:
        OSError: the file cannot be written.
    """
    write_json(Path(folder) / "results.json", _finite(results))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _read(folder: Path) -> dict[str, Any]:
    if not (folder / "results.json").exists():
        raise CheckpointError(
            f"{folder} has no results.json; its run failed or is not over (resume={folder})."
        )
    results = read_json(folder / "results.json")
    if not isinstance(results, dict) or not {"task", "rows"} <= results.keys():
        raise CheckpointError(f"{folder / 'results.json'} is not of a run: no task or rows in it.")
    return results


def _merge_runs(runs: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Rows of the policies that all of these runs of one task have."""
    names = [name for name in runs[0]["rows"] if all(name in run["rows"] for run in runs)]
    return {name: _merge([run["rows"][name] for run in runs]) for name in names}


def _merge(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    scores = [row["score"] for row in rows]
    pooled = np.concatenate([row["episode_scores"] for row in rows])
    merged = {
        key: interval([row[key] for row in rows])[0]  # None is NaN there
        for key in MEANS
        if all(key in row for row in rows)
    }
    between = interval(scores)[1] if len(scores) > 1 else 0.0
    return {
        **merged,
        "score": float(np.mean(scores)),
        "interval": float(max(interval(pooled)[1], between)),
        "episodes": len(pooled),
        "seeds": ", ".join(f"{score:.1f}" for score in scores),
    }
