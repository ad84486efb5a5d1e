"""Which demonstrations a policy followed, step by step, and with what outcome."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDictBase

from torchrl_rad._files import write_atomic
from torchrl_rad.evaluation import episode_results, steps_inside

__all__ = ["demonstration_usage", "provenance_table", "write_provenance"]


def provenance_table(steps: TensorDictBase) -> dict[str, np.ndarray]:
    """What was followed at each step, as columns.

    Args:
        steps (TensorDictBase): [n, T] of :func:`~torchrl_rad.evaluation.evaluate`, of a policy that
            retrieves and writes ``target_source``, as those of
            :func:`~torchrl_rad.policy.build_policy` do.

    Returns:
        Arrays with one entry for each step until an episode's end: ``row`` of the environment and
        ``step`` in it; ``found`` (False: it fell back, and planned without a target); ``episode``
        and ``episode_step`` of the demonstration it was near; ``target_step``, the step there that
        it went for; ``similarity``; ``return``, from the target on; ``estimated_steps`` to it.
        -1 where nothing was found.

    Raises:
        KeyError: the policy wrote no sources.
    """
    if "target_source" not in steps.keys():
        raise KeyError(
            "the steps hold no 'target_source': ask RetrievalTargetModule for it by a seventh "
            "out_key."
        )
    inside = steps_inside(steps)
    row, step = inside.nonzero()

    def column(name: str) -> np.ndarray:
        return steps[name].cpu().numpy()[inside]

    found, source = column("found")[:, 0], column("target_source")
    return {
        "row": row,
        "step": step,
        "found": found,
        "episode": source[:, 0],
        "episode_step": source[:, 1],
        "target_step": np.where(found, source[:, 1] + column("target_offset")[:, 0], -1),
        "similarity": column("similarity")[:, 0],
        "return": column("target_return")[:, 0],
        "estimated_steps": np.where(found, column("target_step")[:, 0], -1),
    }


def write_provenance(path: str | Path, steps: TensorDictBase) -> None:
    """Writes :func:`provenance_table` as a csv file, whole or not at all."""
    columns = provenance_table(steps)
    columns["found"] = columns["found"].astype(int)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    write_atomic(path, text.getvalue())


def demonstration_usage(steps: TensorDictBase) -> list[dict[str, Any]]:
    """How often each demonstration was followed, and what the episodes came to that did.

    Returns:
        For each demonstration followed, the most used first: ``episode``, its id; ``steps`` for
        which it was followed; ``episodes`` that followed it; and of these the mean ``return`` and
        the share that had ``success``.
    """
    columns, results = provenance_table(steps), episode_results(steps)
    found = columns["found"]
    ids, place = np.unique(columns["episode"][found], return_inverse=True)
    used = np.zeros((len(ids), len(steps)), dtype=np.int64)
    np.add.at(used, (place, columns["row"][found]), 1)
    rows = []
    for number in np.argsort(-used.sum(1), kind="stable"):
        who = used[number] > 0
        rows.append(
            {
                "episode": int(ids[number]),
                "steps": int(used[number].sum()),
                "episodes": int(who.sum()),
                "return": float(results["return"][who].mean()),
                "success": float(results["success"][who].mean()),
            }
        )
    return rows
