"""What one word on the command line may be: from its text to a value, or a line that says why not."""

from __future__ import annotations

import ipaddress
import re
from argparse import ArgumentTypeError
from pathlib import Path

from compose.scenario.kills import BadKill, Kill, parse
from protocol.units import NAME


def folder(text: str) -> Path:
    """A folder, there or not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ArgumentTypeError(f"{text!a} is no folder: it is not UTF-8") from None
    if not text:
        raise ArgumentTypeError("'' is no folder")
    return Path(text).expanduser()


def positive(text: str) -> float:
    """A number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < 1e9:
        raise ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def natural(text: str) -> int:
    """A whole number that fits 63 bits."""
    if not re.fullmatch(r"[0-9]{1,19}", text) or int(text) >= 2**63:
        raise ArgumentTypeError(f"'{text}' is not a whole number from 0 to 2^63 - 1")
    return int(text)


def cell_and_trial(text: str) -> tuple[int, int]:
    """A cell, 0 where it is left out, and one of its trials, such as 3:17."""
    cell, _, trial = text.rpartition(":")
    return natural(cell) if cell else 0, natural(trial)


def up_to(most: int, text: str) -> int:
    """A whole number from 1 to `most`."""
    value = natural(text)
    if not 0 < value <= most:
        raise ArgumentTypeError(f"{value} is not from 1 to {most}")
    return value


def port(text: str) -> int:
    """Of TCP; 0 is any that is free."""
    value = natural(text)
    if value >= 1 << 16:
        raise ArgumentTypeError(f"{value} is not a port, from 0 (one that is free) to 65535")
    return value


def origin(text: str) -> str:
    """The origin of a web page, as a browser sends it."""
    if text != "null" and not re.fullmatch(r"[a-z][a-z0-9+.-]*://[A-Za-z0-9.\[\]:-]*", text):
        raise ArgumentTypeError(f"'{text}' is no origin; one looks like https://viewer.example:8080")
    return text


def address(text: str) -> str:
    """Of IP."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise ArgumentTypeError(f"'{text}' is no address, such as 127.0.0.1 or 0.0.0.0") from None


def count(text: str) -> int:
    """Of what there can be a thousand of."""
    return up_to(1000, text)


def trials(text: str) -> int:
    """Of a cell."""
    return up_to(10**7, text)


def name(text: str) -> str:
    """Of a robot or a run."""
    if not re.search(NAME, text):
        raise ArgumentTypeError(f"'{text}' is no name: letters, digits, - and _ only")
    return text


def names(text: str) -> tuple[str, ...]:
    """Of robots, with commas between."""
    found = tuple(name(one) for one in text.split(","))
    if len(set(found)) < len(found):
        raise ArgumentTypeError(f"'{text}' names a robot twice")
    if any(len(one) > 32 for one in found):
        raise ArgumentTypeError(f"'{text}' has a name of more than 32 letters")
    return found


def days(text: str) -> int:
    """Up to a hundred years."""
    return up_to(36_500, text)


def kill(text: str) -> Kill:
    """Who is killed, and when."""
    try:
        return parse(text)
    except BadKill as error:
        raise ArgumentTypeError(str(error)) from None
