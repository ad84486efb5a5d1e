"""README's tables and pictures from the JSON file of one run of the benchmarks.

python benchmarks/report.py benchmarks.json [--pictures folder]
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

MEMORY = ("index_bytes", "rule_bytes", "payload_bytes")
HEADINGS = {"batch": "environments", "p50_ms": "ms", "p95_ms": "p95", "plain_ms": "plain"}
HEADINGS |= {name: name.replace("_bytes", " MB") for name in MEMORY}
HEADINGS |= {"plain_scan_ms": "plain scan", "windows": "batch"}
HEADINGS |= {"recorded_ms": "recorded", "added_ms": "added"}
SCALES = {"10000": "10k", "100000": "100k", "1000000": "1M"}
PARTS = ("TS", "SE", "PL", "ID", "total")
COLOURS = ("#4c72b0", "#dd8452", "#55a868", "#c44e52")  # as torchrl_rad's other pictures


class ReportError(Exception):
    """What a user can mend, in one line."""


class Entry(NamedTuple):
    """One benchmark: test_rad_<test>_speed; parameters, figures and the median ``ms`` by name."""

    test: str
    values: dict[str, Any]


Entries = Sequence[Entry]


def read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        how = f"python -m pytest benchmarks --benchmark-only --benchmark-json {path} writes it"
        raise ReportError(f"{path} does not exist; {how}.") from None
    except (OSError, ValueError) as error:
        raise ReportError(f"{path} cannot be read as JSON: {error}.") from None
    if not isinstance(content, dict) or not {"benchmarks", "machine_info"} <= content.keys():
        raise ReportError(f"{path} was not written by pytest-benchmark (--benchmark-json).")
    return content


def read_entries(content: dict[str, Any]) -> list[Entry]:
    """Those of torchrl_rad; a file may hold others."""
    entries = []
    for one in content["benchmarks"]:
        values = {**(one.get("params") or {}), **one.get("extra_info", {})}
        values["ms"] = 1e3 * one["stats"]["median"]
        if test := re.match(r"test_rad_(\w+)_speed", one["name"]):
            entries.append(Entry(test[1], values))
    return entries


def chosen(entries: Entries, *tests: str, **wanted: Any) -> list[Entry]:
    """Those of some tests whose values are the wanted ones."""
    found = [entry for entry in entries if entry.test in tests]
    return [e for e in found if all(e.values.get(key) == value for key, value in wanted.items())]


def distinct(entries: Entries, key: str) -> list[Any]:
    """The values of one key in order of appearance; numbers by size, float32 first."""
    values = list(dict.fromkeys(e.values[key] for e in entries if key in e.values))
    numbers = all(isinstance(value, int) for value in values)
    return sorted(values) if numbers else sorted(values, key=lambda value: value != "fp32")


# tables


def cell(value: Any) -> str:
    """Three digits of a number, or so."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2}f}"
    return SCALES.get(str(value), str(value)).replace("_", " ")


def markdown(title: str, columns: Sequence[str], lines: Sequence[Sequence[Any]]) -> str:
    head = [f"### {title}", "", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    return "\n".join([*head, *(f"| {' | '.join(map(cell, line))} |" for line in lines)])


def pivot(
    title: str, entries: Entries, keys: Sequence[str], across: str, figures: Sequence[str]
) -> str | None:
    """One line for each combination of ``keys``, with the figures of each value of ``across``."""
    if not entries:
        return None
    groups, lines = distinct(entries, across), {}
    for entry in entries:
        line = lines.setdefault(tuple(entry.values.get(key) for key in keys), {})
        for name in figures:
            value = entry.values.get(name)
            value = value / 1e6 if value is not None and name in MEMORY else value
            line[entry.values[across], name] = value
    if all(isinstance(value, int) for key in lines for value in key):
        lines = dict(sorted(lines.items()))
    columns = [(group, name) for group in groups for name in figures]
    columns = [c for c in columns if any(line.get(c) is not None for line in lines.values())]
    prefix = f"{across} " if isinstance(groups[0], int) else ""
    heads = [f"{prefix}{cell(group)}: {cell(HEADINGS.get(name, name))}" for group, name in columns]
    rows = [[*key, *(line.get(column) for column in columns)] for key, line in lines.items()]
    return markdown(title, [*(HEADINGS.get(key, key) for key in keys), *heads], rows)


def searches(entries: Entries) -> list[str | None]:
    figures = ("p50_ms", "p95_ms", "plain_scan_ms", "ratio")
    tables = []
    for test in ("search", "target"):
        for rule in distinct(chosen(entries, test), "rule") or [None]:
            what = f"Target rule {rule!r}" if rule else "Search alone"
            found = chosen(entries, test, rule=rule)
            for queries in distinct(found, "queries"):
                part, title = chosen(found, test, queries=queries), f"{what}, queries: {queries}"
                tables.append(pivot(title, part, ("rows", "dims"), "k", figures))
    replans = chosen(entries, "replan")
    title = "Target rule along recorded episodes of PointMaze, by position"
    tables.append(pivot(title, replans, ("rule", "queries", "rows"), "k", figures))
    figures = ("p50_ms", "p95_ms", "recorded_ms", "added_ms")
    title = "Goals that rows bring along, beside recorded returns"
    keys = ("queries", "goals")
    return [*tables, pivot(title, chosen(entries, "goal"), keys, "rule", figures)]


def plans(entries: Entries) -> list[str | None]:
    found = chosen(entries, "plan")
    scaling = chosen(entries, "plan_scaling")
    unets = chosen(entries, "diffuser_plan")
    keys, figures = ("size", "process", "batch", "candidates"), ("ms", "plain_ms", "ratio")
    return [
        pivot("Plans; the plain ones are in float32", found, keys, "precision", figures),
        pivot("More and more plans at a time", scaling, keys[:1] + keys[2:], "precision", figures),
        pivot("Plans of D-RAD", unets, ("sampler", "steps", "candidates"), "size", figures),
    ]


def actions(entries: Entries) -> list[str | None]:
    keys = ("size", "rule", "process", "precision", "batch", "candidates")
    lines = []
    for entry in chosen(entries, "policy"):
        times = entry.values["milliseconds"]
        spans = [f"{cell(times[part]['p50'])} / {cell(times[part]['p95'])}" for part in PARTS]
        share = f"{100 * entry.values['share_of_ts_and_se']:.1f} %"
        lines.append([*(entry.values.get(key) for key in keys), *spans, share])
    columns = [*(HEADINGS.get(key, key) for key in keys), *PARTS, "TS + SE of all"]
    return [markdown("One action, median / 95 % in ms", columns, lines)] if lines else []


def training(entries: Entries) -> list[str | None]:
    steps = chosen(entries, "update", "training_step")
    losses = chosen(entries, "denoising_loss")
    title, figures = "A training step; the plain one is in float32", ("ms", "plain_ms", "ratio")
    return [
        pivot(title, steps, ("objective", "size", "windows"), "precision", figures),
        pivot("The denoising loss alone", losses, ("calls", "windows"), "precision", ("ms",)),
    ]


def data(entries: Entries) -> list[str | None]:
    opened = chosen(entries, "database_extend", "index_build", "database_load", "first_answer")
    sampled = chosen(entries, "window_sampling")
    keys, title = ("steps", "length", "windows"), "Windows, beside those of SliceSampler"
    return [
        pivot("Databases", opened, ("rows", "dims"), "timed", ("ms", *MEMORY)),
        pivot(title, sampled, keys, "buffer", ("ms",)),
    ]


def heading(content: dict[str, Any], entries: Entries) -> str:
    """Machine, threads and versions."""
    machine, commit = content["machine_info"], content.get("commit_info") or {}
    cpu = machine.get("cpu") or {}
    threads = sorted({str(entry.values.get("threads", "?")) for entry in entries})
    devices = sorted({entry.values.get("device", "?") for entry in entries})
    versions = {"Python": machine.get("python_version", "?")}
    for entry in entries:
        versions.update(entry.values.get("versions", {}))
    short = re.sub(r"(?<=^[0-9a-f]{7})[0-9a-f]+$", "", commit.get("id", "?"))
    changed = " with changes" if commit.get("dirty") else ""
    return (
        f"{cpu.get('brand_raw', 'unknown processor')}, {cpu.get('count', '?')} cores, "
        f"{' and '.join(threads)} thread(s), {' and '.join(devices)}; "
        f"{', '.join(f'{name} {value}' for name, value in versions.items())}; "
        f"commit {short}{changed}, {content.get('datetime', '?')[:10]}. "
        "Times are medians in ms; a ratio is the time of the plain way over ours, from one test."
    )


# pictures

PLAIN = {"ls": "--", "alpha": 0.7}


class Panel(NamedTuple):
    """One set of axes: what is on the x axis, and entries with the figure to draw and its style."""

    x: str
    title: str
    lines: list[tuple[Entries, str, dict[str, Any]]]


def target_panels(entries: Entries) -> list[Panel]:
    """The target rule against rows: a panel for each k and number of queries."""
    test, panels = "target", []
    found = chosen(entries, test, rule=next(iter(distinct(chosen(entries, test), "rule")), None))
    for queries in distinct(found, "queries"):
        part = chosen(found, test, queries=queries)
        for k in distinct(part, "k"):
            lines = []
            for colour, dims in zip(COLOURS, distinct(found, "dims"), strict=False):
                one = chosen(part, test, k=k, dims=dims)
                lines.append((one, "p50_ms", {"color": colour, "label": f"{dims} dims"}))
                lines.append((one, "plain_scan_ms", {"color": colour, **PLAIN}))
            lines.append(([], "", {"color": "black", "label": "plain scan", **PLAIN}))
            asked = "1 query" if queries == 1 else f"{queries} queries"
            panels.append(Panel("rows", f"{asked}, {k} neighbours", lines))
    return panels


def plan_panels(entries: Entries) -> list[Panel]:
    """A plan against environments, and against candidates."""
    test, panels = "plan_scaling", []
    pairs = [("batch", "candidates", "1 candidate"), ("candidates", "batch", "1 environment")]
    for x, other, title in pairs:
        found, lines = chosen(entries, test, **{other: 1}), []
        for colour, precision in zip(COLOURS, distinct(found, "precision"), strict=False):
            one = chosen(found, test, precision=precision)
            lines.append((one, "ms", {"color": colour, "label": precision}))
        plain = chosen(found, test, precision="fp32")
        lines.append((plain, "plain_ms", {"color": "black", "label": "plain, fp32", **PLAIN}))
        if found:
            panels.append(Panel(x, title, lines))
    return panels


def draw_panel(axis: Any, panel: Panel) -> dict[str, Any]:
    """Lines on logarithmic axes; gives them by label."""
    ticks, lines = set(), {}
    for entries, y, style in panel.lines:
        points = sorted((e.values[panel.x], e.values[y]) for e in entries if y in e.values)
        xs, ys = zip(*points, strict=True) if points else ((), ())
        marker = "" if "ls" in style else "o"
        drawn = axis.plot(xs, ys, lw=1.4, marker=marker, ms=3, **style)
        lines[style.get("label")] = drawn[0]
        ticks.update(xs)
    axis.set(xscale="log", yscale="log", xlabel=HEADINGS.get(panel.x, panel.x))
    axis.set_title(panel.title, fontsize=10)
    axis.grid(alpha=0.3)
    axis.set_xticks(sorted(ticks), [cell(tick) for tick in sorted(ticks)])
    axis.minorticks_off()
    axis.yaxis.get_major_locator().set_params(subs=(1, 2, 5))
    axis.yaxis.set_major_formatter("{x:g}")
    lines.pop(None, None)
    return lines


def draw(panels: list[Panel], path: Path) -> None:
    """The panels side by side, one legend below them."""
    from matplotlib import pyplot

    size = (max(3.0 * len(panels) + 0.6, 6.2), 3.2)  # as wide as the legend
    figure, axes = pyplot.subplots(1, len(panels), figsize=size, sharey=True, squeeze=False)
    legend = {}
    for axis, panel in zip(axes[0], panels, strict=True):
        legend.update(draw_panel(axis, panel))
    axes[0][0].set_ylabel("milliseconds")
    figure.legend(
        legend.values(), legend.keys(), loc="lower center", ncol=8, fontsize=9, frameon=False
    )
    figure.tight_layout(rect=(0, 0.08, 1, 1))
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


PICTURES = {"target-rule.png": target_panels, "plans.png": plan_panels}


def draw_all(entries: Entries, folder: Path) -> list[str]:
    """Draws what the entries suffice for; gives the names."""
    try:
        import matplotlib
    except ImportError:
        raise ReportError("--pictures needs matplotlib: pip install matplotlib.") from None
    matplotlib.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {name: panels for name, make in PICTURES.items() if (panels := make(entries))}
    for name, panels in drawn.items():
        draw(panels, folder / name)
    return list(drawn)


def report(path: Path, pictures: Path | None) -> str:
    """The text; pictures are written beside."""
    content = read_json(path)
    entries = read_entries(content)
    if not entries:
        raise ReportError(f"{path} holds no benchmark of torchrl_rad.")
    makers = (searches, plans, actions, training, data)
    tables = [table for make in makers for table in make(entries) if table]
    names = [] if pictures is None else draw_all(entries, pictures)
    images = [f"![{name}]({pictures / name})" for name in names]
    return "\n\n".join([heading(content, entries), *tables, *images])


def main() -> None:
    """Reads the command line; errors that a user can mend end in one line."""
    parser = argparse.ArgumentParser(description="Tables and pictures of one benchmark run.")
    parser.add_argument("json", type=Path, help="written by pytest --benchmark-json")
    parser.add_argument("--pictures", type=Path, metavar="folder", help="draw them there")
    arguments = parser.parse_args()
    try:
        print(report(arguments.json, arguments.pictures))
    except (ReportError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
