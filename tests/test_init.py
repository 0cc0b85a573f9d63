"""`tandem init` writes files that work as they are."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from compose.cli import init
from tests.commands import tandem
from tests.test_documentation import ROOT, blocks


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ended = tandem("init", "my files", cwd=tmp_path)
    assert (ended.status, ended.err) == (0, "")
    return tmp_path


@pytest.mark.long
def test_every_printed_command_succeeds(folder: Path) -> None:
    shown = tandem("init", "others", cwd=folder).out.partition("to go on:")[2]
    for line in shown.strip().splitlines():
        words = shlex.split(line)
        cwd = folder
        if words[0] == "cd":
            cwd, words = folder / words[1], words[3:]
        if words[0] == "python":
            ran = subprocess.run(
                [sys.executable, *words[1:]], cwd=cwd, capture_output=True, text=True, check=True
            )
            assert ran.stdout.startswith("localised after")
        else:
            assert tandem(*words[1:], cwd=cwd).status == 0, line


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
