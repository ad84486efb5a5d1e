from __future__ import annotations

import pytest

from ..saved_policy import save_small_policy


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A small saved policy."""
    path = tmp_path_factory.mktemp("run") / "policies" / "followed"
    save_small_policy(path)
    return path
