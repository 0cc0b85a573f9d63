"""`tandem init` writes files that work as they are."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from compose.cli import init
from compose.terminal.invocation import program
from tests.commands import tandem
from tests.test_documentation import ROOT, blocks


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ended = tandem("init", "my files", cwd=tmp_path)
    assert (ended.status, ended.err) == (0, "")
    return tmp_path


@pytest.mark.long
def test_every_printed_command_succeeds_in_a_shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands for uv if there is one, as in CI; else those on the PATH, which the pages have as well."""
    uv = shutil.which("uv")
    if uv is not None:
        (tmp_path / "bin").mkdir()
        (tmp_path / "bin" / "uv").symlink_to(uv)
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
        monkeypatch.setenv("UV_RUN_RECURSION_DEPTH", "1")
        monkeypatch.setenv("UV_NO_SYNC", "1")
    shown = tandem("init", "my files", cwd=tmp_path).out.partition("to go on:")[2]
    lines = shown.strip().splitlines()
    assert len(lines) == 5
    for line in lines:
        ran = subprocess.run(
            ["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300
        )
        assert ran.returncode == 0, (line, ran)


def test_a_command_that_uv_started_prints_commands_for_uv(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UV_RUN_RECURSION_DEPTH", "1")
    project = Path(sys.prefix).parent
    monkeypatch.chdir(tmp_path)
    assert program("tandem") == f"uv run --project {shlex.quote(str(project))} tandem"
    assert program("python", project / "mine") == "uv run python"
    monkeypatch.delenv("UV_RUN_RECURSION_DEPTH")
    assert program("tandem") == "tandem"
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    assert program("tandem") == f"{shlex.quote(sys.executable)} -m tandem"


def test_no_file_is_replaced(folder: Path) -> None:
    scenario = folder / "my files" / "scenario.toml"
    for path in scenario.parent.iterdir():
        if path != scenario:
            path.unlink()
    scenario.write_text("mine")
    ended = tandem("init", "my files", cwd=folder)
    assert ended.status == 2
    assert ended.err == "tandem init: my files/scenario.toml already exists; choose another folder\n"
    assert [path.name for path in scenario.parent.iterdir()] == ["scenario.toml"]
    assert scenario.read_text() == "mine"


def test_a_link_that_leads_nowhere_is_not_replaced(tmp_path: Path) -> None:
    link = tmp_path / "scenario.toml"
    link.symlink_to("nowhere.toml")
    ended = tandem("init", tmp_path)
    assert ended.status == 2
    assert ended.err == f"tandem init: {link} already exists; choose another folder\n"
    assert link.is_symlink()
    assert [path.name for path in tmp_path.iterdir()] == ["scenario.toml"]


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ended = tandem("init", "file", cwd=tmp_path)
    assert (ended.status, ended.err) == (2, "tandem init: file cannot be written: File exists\n")


def test_the_driver_is_that_of_the_tutorial() -> None:
    page = blocks(ROOT / "docs" / "tutorial-robot.md")
    assert init.starter()["myrobot.py"] == next(one.text for one in page if one.file == "myrobot.py")
