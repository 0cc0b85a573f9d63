"""The types of arguments: functions that turn one word of a command line into a value."""

from __future__ import annotations

import ipaddress
import re
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from compose.errors import BadKill, UserError
from compose.launch.class_loader import trust

if TYPE_CHECKING:
    from compose.scenario.kills import Kill
    from protocol.network.clock import Clock

ENDPOINT_EXAMPLE = "tcp/127.0.0.1:7447"
Value = TypeVar("Value")


def checked(
    what: str, read: Callable[[str], Value], holds: Callable[[Value], object] = lambda _: True
) -> Callable[[str], Value]:
    """Return the type of an argument that is `what`: `read` can read it, and `holds` is true of the value."""

    def argument(text: str) -> Value:
        try:
            value = read(text)
            if holds(value):
                return value
        except ValueError:
            pass
        raise ArgumentTypeError(f"'{text}' is not {what}")

    return argument


def _whole(text: str) -> int:
    return int(_parts("([0-9]{1,19})", text)[0])


def _parts(pattern: str, text: str) -> tuple[str, ...]:
    """Return the groups of `pattern` in `text`, empty where there is none. Raises ValueError."""
    found = re.fullmatch(pattern, text)
    if found is None:
        raise ValueError
    return found.groups("")


def up_to(most: int) -> Callable[[str], int]:
    """Return the type of an integer from 1 to `most`."""
    return checked(f"a whole number from 1 to {most}", _whole, lambda value: 0 < value <= most)


def _cell_and_trial(text: str) -> tuple[int, int]:
    cell, trial = _parts("(?:([0-9]{1,18}):)?([0-9]{1,18})", text)
    return int(cell or 0), int(trial)


def _window(text: str) -> tuple[float, float]:
    first, last = _parts(r"(.*?)\.\.(.*)", text)
    return float(first), float(last)


source = checked("a name or a path", str, bool)
positive = checked("a positive number", float, lambda value: 0.0 < value < 1e9)
natural = checked("a whole number from 0 to 2^63 - 1", _whole, lambda value: value < 2**63)
confidence = checked("a probability from 0.5 to below 1", float, lambda value: 0.5 <= value < 1.0)
port = checked("a port, which is 0 (any free port) to 65535", _whole, lambda value: value < 1 << 16)
address = checked("an IP address such as 127.0.0.1 or 0.0.0.0", lambda text: str(ipaddress.ip_address(text)))


def _is_name(text: str) -> bool:
    from protocol.units import NAME  # noqa: PLC0415

    return re.search(NAME, text) is not None


name = checked("a name, which consists of letters, digits, - and _", str, _is_name)
option = checked(
    "an option; expected NAME=VALUE",
    lambda text: _parts("(?s)([^=]*)=(.*)", text),
    lambda parts: parts[0].isidentifier(),
)
cell_and_trial = checked("a trial such as 17, or 3:17 in cell 3", _cell_and_trial)
window = checked("a window in seconds such as 10..40", _window, lambda ends: 0.0 <= ends[0] < ends[1] < 1e13)
"""The types of most arguments."""


def planner_option(text: str) -> tuple[str, bool | int | float | str]:
    """Return the name and the value of an option, a number, true, false or text. Raises ArgumentTypeError."""
    key, value = option(text)
    if value in ("true", "false"):
        return key, value == "true"
    for number in (int, float):
        try:
            return key, number(value)
        except ValueError:
            continue
    return key, value


def folder(text: str) -> Path:
    """Return the path of a file or folder, which need not exist. Raises ArgumentTypeError."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ArgumentTypeError(f"{text!a} is not a path: it is not UTF-8") from None
    if not text:
        raise ArgumentTypeError("'' is not a path")
    return Path(text).expanduser()


def planner(text: str) -> str:
    """Return the name of a planner, whose code this process may load from now on."""
    trust(text)
    return text


def model(text: str) -> str:
    """Return the name of a model of the user, once it is loaded. Raises ArgumentTypeError."""
    from compose.launch import model_loader  # noqa: PLC0415  # rarely needed

    try:
        model_loader.trust(text)
    except UserError as error:
        raise ArgumentTypeError(str(error)) from None
    return text


def names(text: str) -> tuple[str, ...]:
    """Return the names of robots from a text in which commas separate them. Raises ArgumentTypeError."""
    found = tuple(name(one) for one in text.split(","))
    if len(set(found)) < len(found):
        raise ArgumentTypeError(f"'{text}' names a robot twice")
    if any(len(one) > 32 for one in found):
        raise ArgumentTypeError(f"'{text}' has a name of more than 32 characters")
    return found


def kill(text: str) -> Kill:
    """Return the kill that `text` describes, such as a@17:report+5s. Raises ArgumentTypeError."""
    from compose.scenario import kills  # noqa: PLC0415  # msgspec, a third of the time of --help

    try:
        return kills.parse(text)
    except BadKill as error:
        raise ArgumentTypeError(str(error)) from None


def clock(text: str) -> Clock:
    """Return the clock that a launcher has told with `ClockError.arguments`. Raises ArgumentTypeError."""
    from protocol.network.clock import Clock  # noqa: PLC0415  # as above

    return checked("a clock", Clock.told)(text)
