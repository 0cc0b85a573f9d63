"""`tandem --help` lists every command by group, and each command explains its arguments."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys

import pytest

from compose.cli.commands import COMMANDS, CommandEntry
from compose.cli.main import command_parser
from tests.commands import tandem
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
