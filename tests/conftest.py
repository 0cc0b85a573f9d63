from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from tests.commands import tandem

if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    # Thousands of short processes must not compile the same modules again, each for itself.
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(
        Path(__file__).parents[1] / ".pytest_cache/pyc"
    )
    sys.dont_write_bytecode = False

settings.register_profile("tandem", derandomize=True, deadline=None, database=None)
settings.load_profile("tandem")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:  # noqa: ARG001  # the hook's own name
    """One more than there are cores: a test that starts processes waits for a good part of its time."""
    return (os.cpu_count() or 1) + 1


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Those of a mission of a and b; nobody changes anything in it."""
    folder = tmp_path_factory.mktemp("keys") / "keys"
    assert tandem("keys", folder, "--robots", "a,b").status == 0
    return folder


@pytest.fixture
def mine(keys: Path, tmp_path: Path) -> Path:
    """Those of a, to be spoilt."""
    shutil.copytree(keys / "agent-a", tmp_path / "mine")
    return tmp_path / "mine"
