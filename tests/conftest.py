"""Ray, and which tests share a process under pytest-xdist: ``-n 2 --dist loadgroup``."""

from __future__ import annotations

import os
from unittest import mock

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Those of a file, for its fixtures; and all files with Ray, of which one runs at a time."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    on_ray = {item.path for item in items if "ray" in getattr(item, "fixturenames", ())}
    for item in items:
        item.add_marker(pytest.mark.xdist_group("ray" if item.path in on_ray else str(item.path)))


@pytest.fixture(scope="module")
def ray():
    """Ray on this machine, whose workers do not give way to other processes."""
    module = pytest.importorskip("ray", reason='needs ray: pip install "torchrl_rad[ray]"')
    with mock.patch.dict(os.environ, RAY_worker_niceness="0"):
        module.init(
            num_cpus=3,  # in Ray's books
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            object_store_memory=200 * 2**20,
        )
        yield module
        module.shutdown()
