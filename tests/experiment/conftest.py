from __future__ import annotations

import os
from unittest import mock

import pytest

from ..saved_policy import save_small_policy


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A small saved policy."""
    path = tmp_path_factory.mktemp("run") / "policies" / "followed"
    save_small_policy(path)
    return path


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
