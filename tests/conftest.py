"""Which tests share a process where pytest-xdist hands them out: ``-n 2 --dist loadgroup``."""

from __future__ import annotations

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Those of a file, for its fixtures; and all files with Ray, of which one runs at a time."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    on_ray = {
        item.path
        for item in items
        if "ray" in getattr(item, "fixturenames", ()) or item.name == "test_shards_in_ray_actors"
    }
    for item in items:
        item.add_marker(pytest.mark.xdist_group("ray" if item.path in on_ray else str(item.path)))
