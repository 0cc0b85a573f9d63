"""The command line `tandem`: its parsers, and the start and end of each command.

Each command is a row of `COMMANDS`, and a module of `compose.cli` that defines `main(options) -> int`.
Only the module of the requested command is imported, because importing takes most of the start-up time.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import traceback
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import NoReturn

from compose.cli.commands import COMMANDS, CommandEntry
from compose.cli.removed import refuse_removed
from compose.errors import BROKEN_PIPE, BUG, FAILED, STOPPED_STATUS, USER_ERROR, UserError
from compose.launch.signals import INTERRUPTION
from compose.terminal import text_width
from compose.terminal.invocation import program
from protocol import limits
from protocol.files import error_text
from protocol.output import discard, leave, one_line, say
from protocol.spelling import did_you_mean

DESCRIPTION = "Cooperative range-only localisation of mobile robots."
CLOSING = """\
`tandem COMMAND --help` describes a command.
Documentation: README.md and docs/ in the repository."""


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one line, with a suggestion for a mistyped word."""

    def error(self, message: str) -> NoReturn:
        """Print `message` in one line, and end the process with USER_ERROR."""
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if wrong is not None:
            message += did_you_mean(wrong[1], re.findall(r"[\w.-]+", wrong[2]))
        self.exit(USER_ERROR, one_line(f"{self.prog}: {message}") + "\n")

    def refuse(self, unknown: Sequence[str]) -> NoReturn:
        """End the process because of `unknown` words; suggest a flag for the first that is one."""
        first = next((word for word in unknown if word.startswith("-")), "").partition("=")[0]
        known = [flag for flag in self._option_string_actions if flag.startswith("--")]
        self.error(f"unrecognized arguments: {' '.join(unknown)}{did_you_mean(first, known)}")

    def parse_all(self, words: Sequence[str]) -> argparse.Namespace:
        """Return the options in `words`; end the process if a word has no meaning."""
        for word in words:
            if word.startswith("--") and word.endswith("=--"):  # argparse takes it for no value
                self.error(f"argument {word.removesuffix('=--')}: '--' is not a value")
        options, unknown = self.parse_known_args(words)
        if unknown:
            self.refuse(unknown)
        return options


class _Version(argparse.Action):
    """The action of `--version`: print the version and end the process."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from compose import extras  # noqa: PLC0415  # it takes time
        from protocol.wire import VERSION  # noqa: PLC0415

        say(f"tandem {extras.version() or 'that is not installed'}, protocol version {VERSION}")
        parser.exit()


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command in `arguments`, or in sys.argv, and end the process with its exit status."""
    sys.stdin = sys.stdin or open(os.devnull)  # noqa: SIM115
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115  # the launching process has closed it
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    name = "tandem"
    try:
        command, words = _split(sys.argv[1:] if arguments is None else arguments)
        name = f"tandem {command.name}"
        INTERRUPTION.begin(name)
        limits.need_memory(limits.START_BYTES, "Tandem")
        options = command_parser(command).parse_all(words)
        status: int = import_module(command.module).main(options)
        sys.stdout.flush()
    except BaseException as error:  # noqa: BLE001  # a bug must have another exit status than a mission
        status = _status_of(error, name)
    INTERRUPTION.end()
    forked = sys.modules.get("compose.launch.forked")
    if forked is not None:
        forked.close()
    if status == STOPPED_STATUS or "protocol.network.session" in sys.modules:
        leave(status)
    sys.exit(status)


def _status_of(error: BaseException, command: str) -> int:
    """Return the exit status of a `command` that ended with `error`, and print why. Raises SystemExit."""
    INTERRUPTION.end()
    if INTERRUPTION.signal_name is not None or isinstance(error, KeyboardInterrupt):
        discard(sys.stdout)  # a part of a line may be in its buffer
        say(f"{command}: stopped by {INTERRUPTION.signal_name or 'SIGINT'}", error=True)
        return STOPPED_STATUS
    match error:
        case UserError():
            say(f"{command}: {error}", error=True)
            return error.exit_status
        case BrokenPipeError():
            discard(sys.stdout)
            return BROKEN_PIPE
        case OSError():
            discard(sys.stdout)
            say(f"{command}: cannot continue: {error_text(error)}", error=True)
            return FAILED
    shortage = limits.shortage(error)
    if shortage is not None:
        say(f"{command}: cannot continue: {shortage}", error=True)
        return FAILED
    if not isinstance(error, Exception):
        raise error
    say(*"".join(traceback.format_exception(error)).splitlines(), error=True)
    return BUG


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line, its `command` included; end the process if it is invalid."""
    command, words = _split(arguments)
    return command_parser(command).parse_all(words)


@cache  # a process forked from one that has built the parser does not build it again
def command_parser(command: CommandEntry) -> CommandParser:
    """Return the parser of `command`."""
    parser = CommandParser(
        prog=f"tandem {command.name}",
        description=command.summary,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(command=command.name)
    command.add_arguments(parser)
    return parser


def _split(arguments: Sequence[str]) -> tuple[CommandEntry, Sequence[str]]:
    """Return the command that `arguments` name, and the words after it.

    End the process after `--help` or `--version`, or if there is no such command. Raises UserError if they
    name something that was removed.
    """
    place = next(
        (i for i, word in enumerate(arguments) if word == "-" or not word.startswith("-")), len(arguments)
    )
    refuse_removed(arguments[place:])
    parser = _top_parser()
    if not arguments:
        parser.error(f"COMMAND is missing; `{program('tandem')} --help` lists the commands")
    named = parser.parse_all(arguments[: place + 1]).command
    command = next(one for one in COMMANDS if one.name == named)
    return command, arguments[place + 1 :]


def _top_parser() -> CommandParser:
    tandem = CommandParser(
        prog="tandem",
        usage="tandem [--help] [--version] COMMAND ...",
        description=f"{DESCRIPTION}\n\n{_command_list()}",
        epilog=CLOSING,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    tandem.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    names = [command.name for command in COMMANDS]
    tandem.add_argument("command", choices=names, metavar="COMMAND", help=argparse.SUPPRESS)
    return tandem


def _command_list() -> str:
    """Return the lines of `tandem --help` that list all commands, by group."""
    width = max(len(command.name) for command in COMMANDS)
    lines: list[str] = []
    for group in dict.fromkeys(command.group for command in COMMANDS):
        members = [command for command in COMMANDS if command.group == group]
        lines.append(f"{group}:")
        for one in members:
            lines += text_width.wrapped(f"  {one.name:{width}}  {one.summary}", width + 4)
        lines.append("")
    return "\n".join(lines).rstrip()
