"""The wheel works without a clone."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OUTSIDE = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")} | {
    "UV_PYTHON_DOWNLOADS": "never"
}
"""The environment of a process that finds nothing of the clone."""

pytestmark = pytest.mark.skipif(shutil.which("uv") is None, reason="there is no uv")


def uv(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["uv", *arguments], cwd=folder, env=OUTSIDE, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the built wheel."""
    folder = tmp_path_factory.mktemp("dist")
    built = uv(ROOT, "build", "--wheel", "--out-dir", str(folder))
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.long
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_the_wheel_runs_a_mission_in_an_empty_environment(version: str, wheel: Path, tmp_path: Path) -> None:
    python = uv(tmp_path, "python", "find", "--no-project", version)
    if python.returncode:
        pytest.skip(f"there is no Python {version}")
    run = ("tool", "run", "--isolated", "--python", python.stdout.strip(), "--from", str(wheel), "tandem")
    for scenario, says in (("paper-1", "localised after 48 ticks\n"), ("noisy", "localised after ")):
        ended = uv(tmp_path, *run, "run", scenario, "-q")
        assert ended.returncode == 0, ended.stderr
        assert ended.stdout.startswith(says)
