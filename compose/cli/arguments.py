"""The types of arguments: functions that turn one word of a command line into a value."""

from __future__ import annotations

import ipaddress
import math
import re
from argparse import ArgumentTypeError
from pathlib import Path

from compose.errors import BadKill, UserError
from compose.scenario.kills import Kill, parse
from protocol.units import NAME

ENDPOINT_EXAMPLE = "tcp/127.0.0.1:7447"


def source(text: str) -> str:
    """Return the name of a scenario or the path of a file. Raises ArgumentTypeError."""
    if not text:
        raise ArgumentTypeError("'' is neither a name nor a path")
    return text


def folder(text: str) -> Path:
    """Return the path of a file or folder, which need not exist. Raises ArgumentTypeError."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ArgumentTypeError(f"{text!a} is not a path: it is not UTF-8") from None
    if not text:
        raise ArgumentTypeError("'' is not a path")
    return Path(text).expanduser()


def planner_option(text: str) -> tuple[str, bool | int | float | str]:
    """Return the name and the value of an option, a number, true, false or text. Raises ArgumentTypeError."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise ArgumentTypeError(f"'{text}' is not an option; expected NAME=VALUE")
    if value in ("true", "false"):
        return name, value == "true"
    for number in (int, float):
        try:
            return name, number(value)
        except ValueError:
            continue
    return name, value


def model(text: str) -> str:
    """Return the name of a model of the user, once it is loaded. Raises ArgumentTypeError."""
    from compose.launch import model_loader  # noqa: PLC0415  # rarely needed

    try:
        model_loader.trust(text)
    except UserError as error:
        raise ArgumentTypeError(str(error)) from None
    return text


def _number(text: str) -> float:
    """Return the number that `text` is; NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def positive(text: str) -> float:
    """Return a number above 0 and below 1e9. Raises ArgumentTypeError."""
    value = _number(text)
    if not 0.0 < value < 1e9:
        raise ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def natural(text: str) -> int:
    """Return an integer from 0 to 2^63 - 1. Raises ArgumentTypeError."""
    if not re.fullmatch(r"[0-9]{1,19}", text) or int(text) >= 2**63:
        raise ArgumentTypeError(f"'{text}' is not a whole number from 0 to 2^63 - 1")
    return int(text)


def cell_and_trial(text: str) -> tuple[int, int]:
    """Return the cell and the trial of a text such as 3:17; the cell is 0 if the text is only the trial.

    Raises ArgumentTypeError.
    """
    found = re.fullmatch("(?:([0-9]{1,18}):)?([0-9]{1,18})", text)
    if found is None:
        raise ArgumentTypeError(f"'{text}' is not a trial such as 17, or 3:17 in cell 3")
    return int(found[1] or 0), int(found[2])


def up_to(most: int, text: str) -> int:
    """Return an integer from 1 to `most`. Raises ArgumentTypeError."""
    if not re.fullmatch(r"[0-9]{1,19}", text) or not 0 < int(text) <= most:
        raise ArgumentTypeError(f"'{text}' is not a whole number from 1 to {most}")
    return int(text)


def port(text: str) -> int:
    """Return a TCP port; 0 stands for any free port. Raises ArgumentTypeError."""
    value = natural(text)
    if value >= 1 << 16:
        raise ArgumentTypeError(f"{value} is not a port, which is 0 (any free port) to 65535")
    return value


def address(text: str) -> str:
    """Return an IP address in its canonical form. Raises ArgumentTypeError."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise ArgumentTypeError(f"'{text}' is not an IP address such as 127.0.0.1 or 0.0.0.0") from None


def name(text: str) -> str:
    """Return the name of a robot or a run. Raises ArgumentTypeError."""
    if not re.search(NAME, text):
        raise ArgumentTypeError(f"'{text}' is not a name, which consists of letters, digits, - and _")
    return text


def names(text: str) -> tuple[str, ...]:
    """Return the names of robots from a text in which commas separate them. Raises ArgumentTypeError."""
    found = tuple(name(one) for one in text.split(","))
    if len(set(found)) < len(found):
        raise ArgumentTypeError(f"'{text}' names a robot twice")
    if any(len(one) > 32 for one in found):
        raise ArgumentTypeError(f"'{text}' has a name of more than 32 characters")
    return found


def window(text: str) -> tuple[float, float]:
    """Return the first and the last second of a text such as 10..40. Raises ArgumentTypeError."""
    first, dots, last = text.partition("..")
    begin, end = _number(first), _number(last)
    if not dots or not 0.0 <= begin < end < 1e13:
        raise ArgumentTypeError(f"'{text}' is not a window in seconds such as 10..40")
    return begin, end


def confidence(text: str) -> float:
    """Return a probability from 0.5 to below 1. Raises ArgumentTypeError."""
    value = _number(text)
    if not 0.5 <= value < 1.0:
        raise ArgumentTypeError(f"'{text}' is not a probability from 0.5 to below 1")
    return value


def kill(text: str) -> Kill:
    """Return the kill that `text` describes, such as a@17:report+5s. Raises ArgumentTypeError."""
    try:
        return parse(text)
    except BadKill as error:
        raise ArgumentTypeError(str(error)) from None
