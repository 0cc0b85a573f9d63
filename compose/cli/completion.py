"""`tandem completion`: print the script with which a shell completes the commands and flags of `tandem`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping

from compose.cli.commands import COMMANDS
from compose.cli.main import command_parser
from compose.errors import ENDED
from compose.scenario.shipped_files import shipped
from protocol.output import say

ZSH = "autoload -U +X bashcompinit && bashcompinit"
"""The line with which zsh runs completions of bash."""
SHIPPED_ARGUMENTS = {"SCENARIO": "scenario", "SPEC": "sweep"}
"""The package with the names that an argument may have, by its metavar."""


def main(options: argparse.Namespace) -> int:
    """Print the script. It has the names of this version, so that nothing is started to complete a word."""
    say(*([ZSH] if options.shell == "zsh" else []), *script())
    return ENDED


def script() -> Iterator[str]:
    """Yield the lines of the script."""
    names = [command.name for command in COMMANDS]
    values: dict[str, list[str]] = {}
    words: dict[str, list[str]] = {}
    for name in names:
        parsed = _completions(command_parser(next(one for one in COMMANDS if one.name == name)))
        words[name] = parsed.pop("")
        values |= {f"{name} {flag}": found for flag, found in parsed.items()}
    yield "_tandem() {"
    yield r"    local IFS=$'\n' words='' word=${COMP_WORDS[COMP_CWORD]}"
    yield '    if [ "$COMP_CWORD" -eq 1 ]; then'
    yield f'        COMPREPLY=($(compgen -W {_quoted([*names, "--help", "--version"])} -- "$word"))'
    yield "        return"
    yield "    fi"
    yield '    case "${COMP_WORDS[1]} ${COMP_WORDS[COMP_CWORD-1]}" in'
    yield from _cases(values)
    yield '    *) case "${COMP_WORDS[1]}" in'
    yield from _cases(words)
    yield "    esac ;;"
    yield "    esac"
    yield '    COMPREPLY=($(compgen -W "$words" -- "$word"; compgen -f -- "$word"))'
    yield "}"
    yield "complete -o filenames -F _tandem tandem"


def _cases(words: Mapping[str, list[str]]) -> Iterator[str]:
    for case, found in words.items():
        yield f"    '{case}') words={_quoted(found)} ;;"


def _quoted(words: list[str]) -> str:
    """Return the words, one a line, in the quotes of a shell; none of them contains a quote."""
    return "$'" + r"\n".join(words) + "'"


def _completions(parser: argparse.ArgumentParser) -> dict[str, list[str]]:
    """Return the words after each flag that takes a value; under "", the flags and the other arguments."""
    found: dict[str, list[str]] = {"": []}
    for action in parser._actions:
        values = [str(one) for one in action.choices or ()]
        if isinstance(action.metavar, str) and action.metavar in SHIPPED_ARGUMENTS:
            values += shipped(SHIPPED_ARGUMENTS[action.metavar])
        if action.help == argparse.SUPPRESS:
            continue
        found[""] += [flag for flag in action.option_strings if flag.startswith("--")]
        if not action.option_strings:
            found[""] += values
        elif action.nargs != 0:
            found |= dict.fromkeys(action.option_strings, values)
    return found
