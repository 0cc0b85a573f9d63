from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from playwright.sync_api import Browser

from compose.launch import in_process
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RangeRecording
from compose.scenario.scenario_file import load
from tests.browser import Open, launched, pages, watching
from tests.commands import ENDLESS, in_one_process, tandem
from tests.range_tables import SAMPLE

settings.register_profile("tandem", derandomize=True, deadline=None, database=None, max_examples=60)
settings.load_profile("tandem")


LONG_TIMEOUT_S = 600.0
"""The time in s after which a long test is taken to hang.

Some compute for half a minute on a core of their own, and the workers share the cores, also with other work.
"""


# Tests may be started by `uv run` or not; the commands that Tandem prints depend on it.
os.environ.pop("UV_RUN_RECURSION_DEPTH", None)
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"


def pytest_configure(config: pytest.Config) -> None:
    """Let the processes of tests receive the signals that nohup, or `&` in a script, makes them ignore."""
    if hasattr(config, "workerinput"):
        for number, handler in ((signal.SIGHUP, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
            if signal.getsignal(number) is signal.SIG_IGN:
                signal.signal(number, handler)


@pytest.hookimpl(trylast=True)  # after those that -m and -k select
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give long tests a time limit of their own, and let each worker begin with some of the slow ones.

    A worker gets an equal part of the tests, in this order, and takes some from the end of another's part.
    """
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.timeout(LONG_TIMEOUT_S))
    slow = [item for item in items if any(one.args == ("slow",) for one in item.iter_markers("long"))]
    others = [item for item in items if item not in slow]
    workers = getattr(config, "workerinput", {}).get("workercount", 1)
    items.clear()
    for left in range(workers, 0, -1):
        begun = (len(slow) + len(others)) // left - len(slow) // left
        items += [slow.pop(0) for _ in range(len(slow) // left)] + others[:begun]
        del others[:begun]


def pytest_collection_finish() -> None:
    """Exempt what has been imported and collected from the search for garbage, of which it would be most."""
    gc.freeze()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:  # noqa: ARG001  # the hook requires the name
    """Return two workers per core: tests that start processes spend much of their time waiting."""
    return 2 * (os.cpu_count() or 1)


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the keys of a mission of a and b, which tests must not change."""
    folder = tmp_path_factory.mktemp("keys") / "keys"
    assert tandem("keys", folder, "--robots", "a,b").status == 0
    return folder


@pytest.fixture
def mine(keys: Path, tmp_path: Path) -> Path:
    """Return a copy of the keys of a, which the test may change."""
    shutil.copytree(keys / "agent-a", tmp_path / "mine")
    return tmp_path / "mine"


@pytest.fixture(scope="module")  # a longer scope would leave playwright's event loop running in other modules
def browser() -> Iterator[Browser]:
    """Yield a browser; skip the test if none is installed."""
    with launched() as found:
        yield found


@pytest.fixture
def opened(browser: Browser) -> Iterator[Open]:
    """Yield a function that opens pages; the test fails on page errors and requests to other hosts."""
    with pages(browser) as opens:
        yield opens


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    """Return the file of a scenario that does not end during a test."""
    path = tmp_path / "endless.toml"
    path.write_text(ENDLESS)
    return path


@pytest.fixture(scope="session")
def paper_1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of paper-1, which tests must not change."""
    return recorded("paper-1", tmp_path_factory.mktemp("recorded"))


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of paper-1 by the command in one process, with contact from tick 46 to 48."""
    return in_one_process("paper-1", tmp_path_factory.mktemp("undisturbed") / "out")


@pytest.fixture(scope="session")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of noisy, which tests must not change."""
    return recorded("noisy", tmp_path_factory.mktemp("recorded"))


@pytest.fixture(scope="session")
def sample() -> RangeRecording:
    """Return the two robots of the recorded sample."""
    return read_ranges(SAMPLE)


def recorded(name: str, folder: Path) -> Path:
    """Return the recording of the shipped scenario `name`, in a new folder in `folder`."""
    out = folder / name
    out.mkdir()
    in_process.run_mission(load(name), out)
    return out


@pytest.fixture(scope="module")
def address(paper_1: Path) -> Iterator[str]:
    """Yield the address of the page on the recording of paper-1."""
    with watching(paper_1) as (_, found):
        yield found
