"""Which tests share a process where pytest-xdist hands them out: ``-n 2 --dist loadgroup``."""

from __future__ import annotations

import pytest

RAY = {"test_shards_in_ray_actors"}  # starts a Ray of its own


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Those of a file share its fixtures; those of Ray must not start two of them at once."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    for item in items:
        on_ray = "ray" in getattr(item, "fixturenames", ()) or item.name in RAY
        item.add_marker(pytest.mark.xdist_group("ray" if on_ray else str(item.path)))
