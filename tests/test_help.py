"""The command line explains itself, by help, completion and JSON Schemas, and `tandem init` files work."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compose.cli import init
from compose.cli.commands import COMMANDS, CommandEntry
from compose.cli.main import command_parser
from compose.figures import PICTURES
from compose.scenario.json_schema import json_schema
from compose.scenario.scenario_tables import ScenarioFile
from compose.scenario.shipped_files import shipped
from compose.sweep.spec import SpecFile
from compose.terminal.invocation import program
from tests.commands import tandem
from tests.test_documentation import ROOT, blocks
from tests.test_house import HOUSE


def test_without_a_command_one_line_says_where_the_commands_are_listed() -> None:
    ended = tandem()
    assert (ended.status, ended.out) == (2, "")
    assert re.fullmatch(r"tandem: COMMAND is missing; `.*tandem --help` lists the commands\n", ended.err)


def test_help_lists_every_command_once_under_its_group() -> None:
    ended = tandem("--help")
    assert (ended.status, ended.err) == (0, "")
    listed: dict[str, list[str]] = {}
    for line in ended.out.splitlines():
        if line.endswith(":"):
            group = listed.setdefault(line[:-1], [])
        elif line.startswith("  ") and "-" not in line[:4]:
            group.append(line.split()[0])
    assert {name: listed[name] for name in ("Run", "Deploy", "Analyse", "Check")} == {
        "Run": ["run", "replay", "scenarios", "init", "sweep", "arena", "hunt"],
        "Deploy": ["world", "agent", "robot", "keys", "containers"],
        "Analyse": ["audit", "figures", "export", "estimate", "calibrate", "watch"],
        "Check": ["doctor", "ps", "check-driver", "check-planner", "completion"],
    }


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_the_help_of_a_command_ends_with_an_example_and_a_page(command: CommandEntry) -> None:
    parser = command_parser(command)
    *_, heading, page = lines = parser.format_help().splitlines()
    assert heading == "documentation:"
    assert (HOUSE / page.strip()).is_file()
    examples = lines[lines.index("example:") + 1 : -3]
    assert examples
    for example in examples:
        program, name, *words = example.split()
        assert (program, name) == ("tandem", command.name)
        assert parser.parse_all(words).command == command.name


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_flag_is_explained_with_its_default(command: CommandEntry) -> None:
    for action in command_parser(command)._actions:
        assert action.help, action
        if isinstance(action.default, int | float | str) and action.default not in (False, argparse.SUPPRESS):
            assert "[default: " in action.help, action


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
@pytest.mark.long
def test_the_parser_of_a_command_imports_no_module_of_commands(command: CommandEntry) -> None:
    code = (
        "import sys\nfrom compose.cli import commands, main\n"
        f"main.command_parser(next(one for one in commands.COMMANDS if one.name == {command.name!r}))\n"
        "print(*[one.module for one in commands.COMMANDS if one.module in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


def test_a_missing_argument_is_named_without_hidden_ones() -> None:
    assert tandem("run") == (2, "", "tandem run: the following arguments are required: SCENARIO\n")


@pytest.fixture(scope="module")
def script() -> str:
    ended = tandem("completion", "bash")
    assert (ended.status, ended.err) == (0, "")
    return ended.out


def completed(script: str, folder: Path, *words: str) -> list[str]:
    """Return what bash offers for the last of `words`."""
    line = " ".join(f"'{word}'" for word in ("tandem", *words))
    asked = f"COMP_WORDS=({line}); COMP_CWORD={len(words)}; _tandem; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    ran = subprocess.run(
        [shutil.which("bash") or pytest.skip("there is no bash"), "-uc", f"{script}\n{asked}"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stderr == ""
    return ran.stdout.split("\n")[:-1]


def test_the_first_word_is_a_command(script: str, tmp_path: Path) -> None:
    (tmp_path / "run.toml").write_text("")
    assert completed(script, tmp_path, "") == [*(one.name for one in COMMANDS), "--help", "--version"]
    assert completed(script, tmp_path, "ru") == ["run"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("run", "--fa"), ["--fault"]),
        (("run", "paper"), [name for name in shipped() if name.startswith("paper")]),
        (("sweep", "nois"), ["noise"]),
        (("figures", "recording", "--only", ""), [*PICTURES, "my file.toml"]),
        (("figures", "recording", "--only", "enc"), ["encounter"]),
        (("run", "my"), ["my file.toml"]),
        (("run", "--out", "my"), ["my file.toml"]),
        (("run", "--launch"), [""]),
        (("figures", "--only", "--form"), [""]),
    ],
)
def test_other_words_are_flags_names_and_files(
    script: str, words: tuple[str, ...], expected: list[str], tmp_path: Path
) -> None:
    (tmp_path / "my file.toml").write_text("")
    assert completed(script, tmp_path, *words) == expected


def test_zsh_runs_the_same_script(script: str) -> None:
    zsh = tandem("completion", "zsh").out
    assert zsh == f"autoload -U +X bashcompinit && bashcompinit\n{script}"


# --- JSON Schemas ---------------------------------------------------------------------------------------

KINDS: dict[str, type[msgspec.Struct]] = {"scenario": ScenarioFile, "sweep": SpecFile}
FILES = [(kind, path) for kind in KINDS for path in shipped(kind).values()]


def problems(kind: str, table: dict[str, Any]) -> list[str]:
    """Return the texts of all violations of the schema."""
    validator = pytest.importorskip("jsonschema").Draft202012Validator(json_schema(KINDS[kind]))
    return [error.message for error in validator.iter_errors(table)]


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda one: getattr(one, "stem", one))
def test_a_shipped_file_fits_its_schema(kind: str, path: Path) -> None:
    assert problems(kind, tomllib.loads(path.read_text())) == []


def test_a_mistake_does_not_fit() -> None:
    table = tomllib.loads(shipped()["paper-1"].read_text())
    assert problems("scenario", {**table, "sede": 1}) != []
    assert problems("scenario", {**table, "seed": -1}) != []
    assert problems("scenario", {**table, "name": "two words"}) != []
    assert problems("scenario", {**table, "planner": {"name": "papers"}}) != []


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_prints_a_valid_schema_that_explains_every_field(kind: str) -> None:
    ended = tandem("scenarios", "--schema", kind)
    schema = json.loads(ended.out)
    pytest.importorskip("jsonschema").Draft202012Validator.check_schema(schema)
    assert schema == json_schema(KINDS[kind])
    for name, definition in schema["$defs"].items():
        for field, found in definition["properties"].items():
            assert found.get("description"), f"{name}.{field}"
    assert "null" not in ended.out
    assert "\\\\A" not in ended.out, "not a pattern of ECMAScript"


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
