"""The arguments that several commands share, and the types that turn one word into a value."""

from __future__ import annotations

import argparse
import ipaddress
import re
from argparse import ArgumentParser, ArgumentTypeError
from pathlib import Path

from compose.errors import BadKill, UserError
from compose.scenario.kills import Kill, parse
from protocol.units import NAME

ENDPOINT_EXAMPLE = "tcp/127.0.0.1:7447"
SCENARIO_HELP = "name of a scenario that ships with Tandem, or path of a TOML file"
SEED_HELP = "seed of all random draws, 0 to 2^63 - 1"

# --- shared arguments -------------------------------------------------------------------------------


def add_closing(parser: ArgumentParser, example: str, page: str) -> None:
    """End the help of a command with an example and the path of its documentation page in the repository."""
    parser.epilog = f"example:\n  {example}\n\ndocumentation:\n  {page}"


def add_scenario(parser: ArgumentParser) -> None:
    """Add one scenario and its seed, and the flags that change it."""
    parser.add_argument("scenario", type=source, metavar="SCENARIO", help=SCENARIO_HELP)
    parser.add_argument("--seed", type=natural, metavar="N", help=f"{SEED_HELP} [default: the scenario's]")
    add_scenario_flags(parser)


def add_scenario_flags(parser: ArgumentParser) -> None:
    """Add the flags that change a scenario."""
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help="fault of the radio, such as 'a->b: loss=0.3, delay=0..3' (delay in ticks); may be repeated",
    )
    parser.add_argument(
        "--planner",
        metavar="NAME",
        help="planner to use instead of the scenario's: assured, paper, an installed one, or MODULE:CLASS",
    )
    parser.add_argument(
        "--planner-option",
        type=planner_option,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option of a planner of your own; may be repeated",
    )
    parser.add_argument(
        "--rate",
        type=positive,
        metavar="X",
        help="run in real time, X times as fast as simulated time [default: lockstep, as fast as possible]",
    )


def add_recording(parser: ArgumentParser) -> None:
    """Add the folder of a finished recording."""
    parser.add_argument(
        "recording", type=folder, metavar="DIR", help="folder of a recording, written with --out DIR"
    )
    add_models(parser)


def add_models(parser: ArgumentParser) -> None:
    """Add `--model` of commands that read recordings."""
    parser.add_argument(
        "--model",
        type=model,
        action="append",
        default=[],
        metavar="MODULE:CLASS",
        help="range or radio model of your own that the recording uses, whose code this command may run; "
        "may be repeated",
    )


def add_running(parser: ArgumentParser) -> None:
    """Add the flags of every command that takes part in a mission."""
    parser.add_argument(
        "--out",
        type=folder,
        metavar="DIR",
        help="folder to which the recording is written [default: no recording is kept]",
    )
    parser.add_argument(
        "--timeout",
        type=positive,
        default=30.0,
        metavar="S",
        help="seconds without an answer before the run fails [default: %(default)g]",
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="print only the outcome")


def add_connection(parser: ArgumentParser) -> None:
    """Add the flags that name a router and the credentials for it."""
    parser.add_argument(
        "--connect",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help=f"router to connect to, such as {ENDPOINT_EXAMPLE}; may be repeated",
    )
    secured = parser.add_mutually_exclusive_group()
    secured.add_argument(
        "--keys",
        type=folder,
        metavar="DIR",
        help="encrypt with the certificates in DIR, one of the folders written by `tandem keys`",
    )
    secured.add_argument(
        "--config", type=folder, metavar="FILE", help="Zenoh configuration file to use instead"
    )


def add_trusted_planner(parser: ArgumentParser) -> None:
    """Add `--planner` of commands whose planner is named by a world, a recording or a sweep's folder."""
    parser.add_argument(
        "--planner",
        action="append",
        default=[],
        metavar="NAME",
        help="planner of your own whose code this command may run, MODULE:CLASS or an installed one; "
        "may be repeated [default: only shipped planners]",
    )


def add_listen(parser: ArgumentParser, purpose: str) -> None:
    """Add `--listen`; `purpose` begins its help."""
    parser.add_argument(
        "--listen",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help=f"{purpose}, such as {ENDPOINT_EXAMPLE}; may be repeated",
    )


def add_connect_timeout(parser: ArgumentParser, target: str) -> None:
    """Add `--connect-timeout`, the wait for `target`."""
    parser.add_argument(
        "--connect-timeout",
        type=positive,
        default=60.0,
        metavar="S",
        help=f"seconds to wait for {target} before giving up [default: %(default)g]",
    )


def add_fsync(parser: ArgumentParser) -> None:
    """Add `--fsync`."""
    parser.add_argument(
        "--fsync",
        action="store_true",
        help="flush every journal write to disk, so that it survives a power cut",
    )


def add_launched(parser: ArgumentParser) -> None:
    """Add the hidden flag of processes that another command launches."""
    parser.add_argument("--launched", action="store_true", help=argparse.SUPPRESS)


def add_driver_options(parser: ArgumentParser) -> None:
    """Add the flags that are passed to a driver."""
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option that is passed to the driver; may be repeated",
    )
    parser.add_argument(
        "--rate",
        type=positive,
        metavar="X",
        help="run X times as fast as real time, with a driver that supports it [default: 1]",
    )


def add_listening_time(parser: ArgumentParser) -> None:
    """Add `--timeout` of the commands that observe missions for a while."""
    parser.add_argument(
        "--timeout",
        type=positive,
        default=2.0,
        metavar="S",
        help="seconds to listen to running missions [default: %(default)g]",
    )


def add_port(parser: ArgumentParser) -> None:
    """Add the port of the web page."""
    parser.add_argument(
        "--port", type=port, metavar="N", help="TCP port of the web page, 0 to 65535 [default: any free port]"
    )


# --- types ------------------------------------------------------------------------------------------


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


def positive(text: str) -> float:
    """Return a number above 0 and below 1e9. Raises ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
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
    cell, _, trial = text.rpartition(":")
    return natural(cell) if cell else 0, natural(trial)


def up_to(most: int, text: str) -> int:
    """Return an integer from 1 to `most`. Raises ArgumentTypeError."""
    value = natural(text)
    if not 0 < value <= most:
        raise ArgumentTypeError(f"{value} is not from 1 to {most}")
    return value


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


def count(text: str) -> int:
    """Return an integer from 1 to 1000. Raises ArgumentTypeError."""
    return up_to(1000, text)


def trials(text: str) -> int:
    """Return the trials per cell, an integer from 1 to 10^7. Raises ArgumentTypeError."""
    return up_to(10**7, text)


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


def add_part_of_recording(parser: ArgumentParser) -> None:
    """Add the options for the anchors and the seconds of a range recording."""
    parser.add_argument(
        "--anchors",
        type=folder,
        metavar="FILE",
        help="CSV file of anchors to add to the recording, or to move [default: none]",
    )
    parser.add_argument(
        "--window",
        type=window,
        metavar="S..S",
        help="use only these seconds, such as 10..40, from the first odometry on [default: all]",
    )


def window(text: str) -> tuple[float, float]:
    """Return the first and the last second of a text such as 10..40. Raises ArgumentTypeError."""
    first, dots, last = text.partition("..")
    try:
        begin, end = float(first), float(last)
    except ValueError:
        begin, end = 0.0, 0.0
    if not dots or not 0.0 <= begin < end < 1e13:
        raise ArgumentTypeError(f"'{text}' is not a window in seconds such as 10..40")
    return begin, end


def confidence(text: str) -> float:
    """Return a probability from 0.5 to below 1. Raises ArgumentTypeError."""
    value = positive(text)
    if not 0.5 <= value < 1.0:
        raise ArgumentTypeError(f"'{text}' is not a probability from 0.5 to below 1")
    return value


def days(text: str) -> int:
    """Return a number of days, 1 to 36500. Raises ArgumentTypeError."""
    return up_to(36_500, text)


def kill(text: str) -> Kill:
    """Return the kill that `text` describes, such as a@17:report+5s. Raises ArgumentTypeError."""
    try:
        return parse(text)
    except BadKill as error:
        raise ArgumentTypeError(str(error)) from None
