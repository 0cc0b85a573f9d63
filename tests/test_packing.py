"""A distribution has the sources, and no key or recording beside them; its wheel works without a clone."""

from __future__ import annotations

import os
import shutil
import subprocess
import tarfile
import zipfile
from functools import partial
from pathlib import Path, PurePath

import pytest

ROOT = Path(__file__).parents[1]
SECRET = "not to be packed"
FOREIGN = (
    "keys/ca-key.pem",
    "keys/world/key.pem",
    "compose/keys/ca-key.pem",
    "compose/hardware/deploy/key.txt",
    "record/world.journal",
    "docs/record/summary.json",
    "tests/agent-a.journal",
    "notes.md",
)
PROJECT_FILES = {
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "LICENSE",
    "README.md",
    "mkdocs.yml",
    "pyproject.toml",
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files of the repository, and files that a user has written into it."""
    folder = tmp_path_factory.mktemp("tree")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("the tests do not run in a repository")
    for name in filter(None, listed.stdout.split("\0")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
    (folder / ".gitignore").unlink()  # the list of packed files must suffice without it
    for name in FOREIGN:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(SECRET)
    return folder


def built(tree: Path, kind: str, out: Path) -> Path:
    """Return the file that `uv build` writes."""
    uv = shutil.which("uv")
    if uv is None:
        pytest.skip("uv is not installed")
    made = subprocess.run(
        [uv, "build", "-q", f"--{kind}", "--out-dir", out, tree],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode and "hatchling" in made.stderr:
        pytest.skip("the build back end is not to be had: there is no package index")
    assert made.returncode == 0, made.stderr
    (file,) = (path for path in out.iterdir() if path.name != ".gitignore")
    return file


def tracked(tree: Path, *folders: str) -> set[str]:
    """Return the files of the project in these folders."""
    files = [path for folder in folders for path in (tree / folder).rglob("*") if path.is_file()]
    names = {str(PurePath(path).relative_to(tree)) for path in files}
    return {name for name in names if name not in FOREIGN}


@pytest.mark.long
def test_an_sdist_has_the_sources_and_nothing_else(tree: Path, tmp_path: Path) -> None:
    with tarfile.open(built(tree, "sdist", tmp_path)) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    assert not names & set(FOREIGN)
    wanted = tracked(tree, "tandem", "agent", "world", "protocol", "compose", "docs", "tests")
    assert names == wanted | PROJECT_FILES | {"PKG-INFO"}


@pytest.mark.long
def test_a_wheel_has_the_packages_with_their_data_and_types_and_nothing_else(
    tree: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(built(tree, "wheel", tmp_path)) as packed:
        names = {name for name in packed.namelist() if ".dist-info/" not in name}
    compiled = {"agent/estimation/libsmoother.so"}  # not in the tree, which may be read-only
    assert names == tracked(tree, "tandem", "agent", "world", "protocol", "compose") | compiled
    assert not compiled & tracked(tree, "agent")
    assert {f"{package}/py.typed" for package in ("tandem", "agent", "world", "protocol", "compose")} <= names


@pytest.mark.long("slow")
@pytest.mark.timeout(600)
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_a_wheel_works_without_a_clone(version: str, tree: Path, tmp_path: Path) -> None:
    """The environment is empty, and has the Python of this version that is on this machine."""
    wheel, environment = built(tree, "wheel", tmp_path / "wheel"), tmp_path / "environment"
    apart = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    run = partial(subprocess.run, cwd=tmp_path, env=apart, capture_output=True, text=True, check=False)
    uv = ("uv", "--no-config", "--no-python-downloads")
    if run([*uv, "venv", "-q", "--python", version, environment]).returncode:
        pytest.skip(f"there is no Python {version}")
    made = run([*uv, "pip", "install", "-q", "--python", environment, wheel])
    if made.returncode:
        pytest.skip(f"there is no package index: {made.stderr}")
    for words in (
        "run paper-1 --out recording",
        "export recording --html",
        "replay recording",
        "run noisy",
    ):
        ended = run([environment / "bin" / "tandem", *words.split()])
        assert ended.returncode == 0, ended.stderr


OUTSIDE = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")} | {
    "UV_PYTHON_DOWNLOADS": "never"
}
"""The environment of a process that finds nothing of the clone."""


def uv(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["uv", *arguments], cwd=folder, env=OUTSIDE, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(ROOT, "wheel", tmp_path_factory.mktemp("dist"))


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
