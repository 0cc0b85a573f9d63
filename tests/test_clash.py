"""A user's module that has the name of a package of Tandem is one line, with the exit status of a mistake."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from compose.errors import USER_ERROR
from tandem import clash

ROOT = Path(__file__).parents[1]


def ended(folder: Path, *words: str, path: Path | None = None) -> tuple[int, list[str]]:
    """Return the exit status and the standard error of Python with `path` in front, run in `folder`."""
    found = os.pathsep.join([str(one) for one in (path, ROOT) if one is not None])
    ran = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": found},
        capture_output=True,
        text=True,
        check=False,
    )
    return ran.returncode, ran.stderr.splitlines()


def module(folder: Path, name: str) -> Path:
    """Return the file of a new package `name` in `folder`."""
    file = folder / name / "__init__.py"
    file.parent.mkdir()
    file.write_text("")
    return file


@pytest.mark.parametrize("name", clash.PACKAGES)
def test_the_command_names_the_module_that_clashes_and_where_it_is(name: str, tmp_path: Path) -> None:
    file = module(tmp_path, name)
    status, lines = ended(tmp_path, "-P", "-m", "tandem", "run", "paper-1", path=tmp_path)
    assert status == USER_ERROR
    assert len(lines) == 1
    assert lines[0].startswith(f"tandem: the module '{name}' is {file}, but Tandem")
    assert f"remove {tmp_path} from PYTHONPATH" in lines[0]


def test_a_script_beside_such_a_module_gets_an_error_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "world.py"
    file.write_text("")
    (tmp_path / "script.py").write_text("import tandem\ntandem.run('paper-1')\n")
    status, lines = ended(tmp_path, "script.py")
    assert status == 1
    assert lines[-1].startswith(f"tandem.clash.ModuleClash: the module 'world' is {file}, ")
    assert lines[-1].count(str(tmp_path)) == 2


def test_a_module_that_a_script_has_imported_already_clashes(tmp_path: Path) -> None:
    code = "import sys, types; sys.modules['agent'] = types.ModuleType('agent'); import tandem; tandem.Run"
    status, lines = ended(tmp_path, "-P", "-c", code)
    assert status == 1
    assert "the module 'agent' is a module 'agent' without a file" in lines[-1]


def test_a_folder_without_modules_does_not_clash(tmp_path: Path) -> None:
    """Python prefers a package to a folder without `__init__.py`."""
    (tmp_path / "world").mkdir()
    assert ended(tmp_path, "-P", "-m", "tandem", "scenarios", path=tmp_path) == (0, [])


def test_processes_of_a_run_import_what_their_launcher_imports(tmp_path: Path) -> None:
    """The launcher finds Tandem first, by a path of its own; PYTHONPATH alone gives the user's module."""
    module(tmp_path, "world").write_text("raise SystemExit('the wrong world')")
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); import tandem; "
        "assert tandem.run('paper-1', processes=True).outcome == 'localised'"
    )
    assert ended(tmp_path, "-P", "-c", code, path=tmp_path) == (0, [])
