from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from playwright.sync_api import Browser

from compose.launch import in_process
from compose.scenario.scenario_file import load
from tests.browser import Open, chromium, pages, watching
from tests.commands import tandem

if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    # Thousands of short processes must not compile the same modules again, each for itself.
    compiled = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(compiled)
    sys.dont_write_bytecode = False

settings.register_profile("tandem", derandomize=True, deadline=None, database=None)
settings.load_profile("tandem")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:  # noqa: ARG001  # the hook's own name
    """Two for each core: a test that starts processes waits for a good part of its time."""
    return 2 * (os.cpu_count() or 1)


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


@pytest.fixture(scope="module")  # no longer: playwright's event loop would be in the way of others
def browser() -> Iterator[Browser]:
    """The test skips where there is none."""
    with chromium() as found:
        yield found


@pytest.fixture
def opened(browser: Browser) -> Iterator[Open]:
    """Opens pages; in the end none must have complained, or asked anybody but the server."""
    with pages(browser) as opens:
        yield opens


@pytest.fixture(scope="module")
def paper_1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record of paper-1; nobody changes anything in it."""
    folder = tmp_path_factory.mktemp("recorded") / "paper-1"
    folder.mkdir()
    in_process.play(load("paper-1"), folder)
    return folder


@pytest.fixture(scope="module")
def address(paper_1: Path) -> Iterator[str]:
    """That of the page on the record of paper-1."""
    with watching(paper_1) as (_, found):
        yield found
