"""Pictures of a run: losses, and a maze with paths, targets and plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential

from torchrl_rad.data.database import ExpertDatabase
from torchrl_rad.envs.maze import GOAL_RADIUS, FixedGoalMaze, MazeTask
from torchrl_rad.evaluation import episode_results, interval
from torchrl_rad.provenance import provenance_table

__all__ = ["plot_curves", "plot_followed", "plot_growth", "plot_targets"]

WALL, PATH, TARGET, PLAN, GOAL = "#d9d9de", "#4c72b0", "#dd8452", "#55a868", "#c44e52"
PATHS = 16  # episodes drawn


def _pyplot():
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError(
            'plots need matplotlib: pip install "torchrl_rad[recipes]"; a run goes on with resume='
            "<run folder>, and does nothing twice."
        ) from error
    matplotlib.use("Agg", force=False)
    from matplotlib import pyplot

    return pyplot


def plot_curves(rows: Sequence[Mapping[str, float]], path: str | Path) -> None:
    """Draws what was logged in training against the step, one panel an objective.

    Args:
        rows (sequence of mapping): of :meth:`~torchrl_rad.runs.MetricsLog.rows`.
        path (path): a png.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: nothing was logged.
    """
    pyplot = _pyplot()
    names = sorted({key.split("/")[0] for row in rows[:1] for key in row if "/" in key})
    if not names:
        raise ValueError("nothing was logged, so there are no curves to draw.")
    steps = [row["step"] for row in rows]
    figure, axes = pyplot.subplots(1, len(names), figsize=(3.2 * len(names), 2.8), squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        for key in sorted(key for key in rows[0] if key.startswith(f"{name}/")):
            label = key.split("/")[1].replace("_", " ")
            axis.plot(steps, [row[key] for row in rows], lw=1.2, label=label)
        axis.set(title=name, xlabel="gradient step", yscale="log")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def plot_growth(runs: Mapping[int, Sequence[Mapping[str, Any]]], path: str | Path) -> None:
    """Draws the scores of databases that begin with so many demonstrations.

    Against the episodes seen where they grow; against their own number where none of them does.

    Args:
        runs (mapping): demonstrations to begin with -> rounds, each ``seen``, episodes before it;
            ``demonstrations``; ``pruned``, whether these are only some of those before; and
            ``scores`` of its episodes, of which mean and 95 % interval are drawn.
        path (path): a png.

    Raises:
        ImportError: matplotlib is not installed.
    """
    pyplot = _pyplot()
    figure, axis = pyplot.subplots(figsize=(5.0, 3.2))
    if all(len(rounds) == 1 for rounds in runs.values()):
        together = [rounds[0] for rounds in runs.values()]
        centre, half = np.array([interval(entry["scores"]) for entry in together]).T
        held = [entry["demonstrations"] for entry in together]
        axis.errorbar(held, centre, np.nan_to_num(half), fmt=".-", color=PATH, capsize=3)
        axis.set(xlabel="demonstrations in the database", xscale="log")
    else:
        for number, (start, rounds) in enumerate(runs.items()):
            _draw_growth(axis, start, rounds, f"C{number}")
        axis.set(xlabel="episodes seen")
        axis.legend(frameon=False, fontsize=8, loc="lower center")
    axis.set(ylabel="score")
    axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def _draw_growth(axis: Any, start: int, rounds: Sequence[Mapping[str, Any]], colour: str) -> None:
    grown = [entry for entry in rounds if not entry["pruned"]]
    seen = [entry["seen"] for entry in grown]
    centre, half = np.array([interval(entry["scores"]) for entry in grown]).T
    low, high = centre - half, centre + half
    axis.fill_between(seen, low, high, color=colour, alpha=0.2, lw=0)
    axis.plot(seen, centre, ".-", color=colour, label=f"from {start} demonstrations")
    for entry in rounds:
        if entry["pruned"]:
            centre, half = interval(entry["scores"])
            label = f"pruned from {grown[-1]['demonstrations']} to {entry['demonstrations']}"
            axis.errorbar(
                entry["seen"], centre, half, fmt="x", color="black", capsize=3, label=label
            )


def plot_targets(
    task: MazeTask,
    episodes: Mapping[str, TensorDictBase],
    policies: Mapping[str, TensorDictSequential],
    titles: Mapping[str, str],
    path: str | Path,
    goal_cell: tuple[int, int] | None = None,
) -> None:
    """Draws the maze once for each policy: paths driven, targets retrieved and a few plans.

    Args:
        task (MazeTask): the maze.
        episodes (mapping): name -> steps [n, T] of :func:`~torchrl_rad.evaluation.evaluate`.
        policies (mapping): name -> policy, asked again for plans along the longest way to the goal.
        titles (mapping): name -> title of its panel.
        path (path): a png.
        goal_cell (tuple of int, optional): another goal than the task's.

    Raises:
        ImportError: matplotlib is not installed.
    """
    pyplot = _pyplot()
    env = FixedGoalMaze(task, goal_cell)
    rows, columns = len(env.maze.maze_map), len(env.maze.maze_map[0])
    size = (4.2 * len(episodes), 4.2 * rows / columns + 0.9)
    figure, axes = pyplot.subplots(1, len(episodes), figsize=size, squeeze=False)
    for axis, (name, steps) in zip(axes[0], episodes.items(), strict=True):
        _draw_maze(axis, env)
        drawn = _draw_paths(axis, steps)
        _draw_plans(axis, policies[name], steps[_longest(steps, drawn)])
        axis.set_title(titles[name], fontsize=10)
    handles, labels = axes[0][-1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        unique.values(), unique.keys(), loc="lower center", ncol=6, fontsize=9, frameon=False
    )
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
    env.close()


def plot_followed(
    task: MazeTask,
    steps: TensorDictBase,
    database: ExpertDatabase,
    row: int,
    path: str | Path,
    goal_cell: tuple[int, int] | None = None,
    after: int = 60,
) -> None:
    """Draws one episode's path over the demonstrations that it followed.

    Args:
        task (MazeTask): the maze.
        steps (TensorDictBase): [n, T], with ``target_source``.
        database (ExpertDatabase): the demonstrations.
        row (int): which of the n episodes.
        path (path): a png.
        goal_cell (tuple of int, optional): another goal than the task's.
        after (int, optional): steps drawn after the first reward. Defaults to ``60``.

    Raises:
        ImportError: matplotlib is not installed.
        KeyError: the policy wrote no sources.
    """
    pyplot = _pyplot()
    env = FixedGoalMaze(task, goal_cell)
    arrival = episode_results(steps[row : row + 1])["arrival"][0]
    last = steps.shape[1] if np.isnan(arrival) else int(arrival) + after
    columns = provenance_table(steps[row : row + 1, :last])
    used = np.unique(columns["episode"][columns["found"]])
    rows, width = len(env.maze.maze_map), len(env.maze.maze_map[0])
    figure, axis = pyplot.subplots(figsize=(5.0, 5.0 * rows / width + 0.7))
    _draw_maze(axis, env)
    recorded = database[:]
    for episode in used:
        own = recorded["observation"][recorded["episode"] == int(episode), :2].cpu().numpy()
        axis.plot(*own.T, color=PLAN, lw=0.5, alpha=0.35, label="demonstrations")
        at = columns["episode_step"][columns["episode"] == episode]
        axis.plot(*own[at].T, ".", color=TARGET, ms=4, label="where they were followed")
    x, y = steps["observation"][row, : len(columns["step"]), :2].cpu().numpy().T
    axis.plot(x, y, color=PATH, lw=1.6, label="path driven")
    axis.plot(x[0], y[0], ".", color="black", ms=7, label="start")
    handles, labels = axis.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(
        unique.values(), unique.keys(), loc="lower center", ncol=3, fontsize=9, frameon=False
    )
    axis.set_title(f"{len(used)} demonstrations followed in {len(x)} steps", fontsize=10)
    figure.tight_layout(rect=(0, 0.09, 1, 1))
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
    env.close()


def _draw_maze(axis: Any, env: FixedGoalMaze) -> None:
    from matplotlib.patches import Circle, Rectangle

    for row, line in enumerate(env.maze.maze_map):
        for column, cell in enumerate(line):
            if cell == 1:
                x, y = env.maze.cell_rowcol_to_xy(np.array([row, column]))
                axis.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, color=WALL, lw=0))
    axis.add_patch(Circle(env.goal, GOAL_RADIUS, color=GOAL, alpha=0.25, lw=0, label="goal"))
    width, height = len(env.maze.maze_map[0]) / 2, len(env.maze.maze_map) / 2
    axis.set(xlim=(-width, width), ylim=(-height, height), aspect="equal", xticks=[], yticks=[])


def _draw_paths(axis: Any, steps: TensorDictBase) -> range:
    drawn = range(min(PATHS, len(steps)))
    for row in drawn:
        x, y = steps["observation"][row, :, :2].cpu().numpy().T
        axis.plot(x, y, color=PATH, lw=0.8, alpha=0.6, label="path driven")
        axis.plot(x[0], y[0], ".", color="black", ms=4, label="start")
    if "target" in steps.keys():
        found = steps["found"][: len(drawn), ::4].squeeze(-1)
        targets = steps["target"][: len(drawn), ::4][found][:, :2].cpu().numpy()
        axis.plot(*targets.T, ".", color=TARGET, ms=2.5, alpha=0.5, label="retrieved target")
    return drawn


def _longest(steps: TensorDictBase, rows: range) -> int:
    """The episode that began farthest from where it first was paid."""
    paid = steps["next", "reward"][list(rows)].squeeze(-1) > 0
    first = torch.where(paid.any(-1), paid.int().argmax(-1), -1)
    return rows[int(first.argmax())]


def _draw_plans(axis: Any, policy: TensorDictSequential, steps: TensorDictBase) -> None:
    """Plans at four places of an episode, as far as they are refined by finer levels."""
    paid = steps["next", "reward"].squeeze(-1) > 0
    way = int(paid.int().argmax()) if paid.any() else len(paid) - 1
    at = torch.linspace(0, max(way, 1), 5).long()[:-1]
    states = steps["observation"][at].to(next(policy.parameters()).device)
    with torch.no_grad():
        plans = policy(TensorDict({"observation": states}, [len(states)]))["plan"]
    planner = policy[-1]
    refined = planner.levels[0].jump if len(planner.levels) > 1 else planner.horizon
    near = planner.plan_times <= refined
    for plan in plans[:, near].cpu().numpy():
        axis.plot(*plan[:, :2].T, "-o", color=PLAN, lw=1.4, ms=2.5, label="plan")
