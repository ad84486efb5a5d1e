from __future__ import annotations

import os
import subprocess
import sys
from unittest import mock

import pytest

from torchrl_rad.data.pointmaze import pointmaze_dataset
from torchrl_rad.runs import RunFolder

from .running import RECIPES, SMALL


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """The data, collected once."""
    folder = tmp_path_factory.mktemp("cache")
    with mock.patch.dict(os.environ, TORCHRL_RAD_CACHE=str(folder)):
        pointmaze_dataset("umaze", 3000, progress=False)
        yield folder


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A run in a process of its own that nothing interrupts: its folder and what it printed."""
    base = tmp_path_factory.mktemp("whole")
    command = [sys.executable, str(RECIPES / "dl_rad.py"), *SMALL, f"folder={base / 'run'}"]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=base)
    assert ran.returncode == 0, ran.stderr
    return RunFolder.open(base / "run"), ran.stdout
