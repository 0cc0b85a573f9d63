"""The command `tandem`: its arguments. Each command stands in a module of its own, under `commands`."""

from __future__ import annotations

import argparse
import os
import re
import sys
import traceback
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import NoReturn, TextIO

from compose.cli.arguments import (
    address,
    cell_and_trial,
    count,
    days,
    folder,
    kill,
    name,
    names,
    natural,
    origin,
    port,
    positive,
    trials,
)
from compose.errors import BROKEN_PIPE, BUG, FAILED, USER_ERROR, UserError
from compose.figures import FORMATS, PICTURES
from protocol import limits
from protocol.files import said
from protocol.output import one_line, say
from protocol.spelling import did_you_mean


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if wrong is not None:
            message += did_you_mean(wrong[1], re.findall(r"[\w.-]+", wrong[2]))
        self.exit(USER_ERROR, one_line(f"{self.prog}: {message}") + "\n")

    def refuse(self, unknown: Sequence[str]) -> NoReturn:
        """Words of the command line that mean nothing: the first option among them may be mistyped."""
        first = next((word for word in unknown if word.startswith("-")), "").partition("=")[0]
        known = [flag for flag in self._option_string_actions if flag.startswith("--")]
        self.error(f"unrecognized arguments: {' '.join(unknown)}{did_you_mean(first, known)}")


class _Version(argparse.Action):
    """Tells it, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from compose import extras  # noqa: PLC0415  # it takes time
        from protocol.wire import VERSION  # noqa: PLC0415

        say(f"tandem {extras.version() or 'that is not installed'}, protocol version {VERSION}")
        parser.exit()


def main(arguments: list[str] | None = None) -> NoReturn:
    """Parse, and do as told; ends the process."""
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115  # closed by whoever started this
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    options, unknown = parser().parse_known_args(arguments)
    if unknown:
        options.parser.refuse(unknown)
    try:
        limits.need_memory(limits.START_BYTES, "Tandem")
        status = import_module(f"compose.cli.{options.command.replace('-', '_')}").main(options)
        sys.stdout.flush()
    except UserError as error:
        say(f"tandem {options.command}: {error}", error=True)
        status = USER_ERROR
    except BrokenPipeError:
        _leave_stream(sys.stdout)
        status = BROKEN_PIPE
    except OSError as error:
        _leave_stream(sys.stdout)
        say(f"tandem {options.command}: cannot go on: {said(error)}", error=True)
        status = FAILED
    except BaseException as error:  # whatever it is, it must not look like a mission's outcome
        short = limits.shortage(error)
        if short is None and not isinstance(error, Exception):
            raise
        if short is None:
            say(*traceback.format_exc().splitlines(), error=True)
        else:
            say(f"tandem {options.command}: cannot go on: {short}", error=True)
        status = BUG if short is None else FAILED
    forked = sys.modules.get("compose.launch.forked")
    if forked is not None:
        forked.close()
    session = sys.modules.get("protocol.network.session")
    if session is not None:
        session.leave(status)
    sys.exit(status)


def _leave_stream(stream: TextIO) -> None:
    """Nobody takes what is left in `stream`: let the interpreter not try at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@cache  # a process forked from one that has made it need not
def parser() -> argparse.ArgumentParser:
    """Of the whole command line."""
    tandem = _Parser(prog="tandem", description="Two robots find out together where they are.")
    tandem.add_argument("--version", action=_Version, nargs=0, help="tell which version this is, and end")
    commands = tandem.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    def command(name: str, what: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=what, description=what)
        added.set_defaults(parser=added)
        return added

    run = command("run", "Play a mission on this machine.")
    _add_scenario(run)
    _add_playing(run)
    run.add_argument("--in-process", action="store_true", help="without processes or network")
    run.add_argument("--secure", action="store_true", help="encrypted, with keys made for this run alone")
    run.add_argument(
        "--export",
        action=argparse.BooleanOptionalAction,
        help="leave run.mcap and tables in --out DIR, too (default: where the extra lab is installed)",
    )
    run.add_argument("--foxglove", type=port, metavar="PORT", help="serve Foxglove's viewers there, live")
    run.add_argument(
        "--foxglove-origin",
        type=origin,
        action="append",
        default=[],
        metavar="ORIGIN",
        help="web pages of this origin may look there, beside Foxglove's app; may be repeated",
    )
    run.add_argument("--watch", action="store_true", help="serve a page that shows it, live and afterwards")
    run.add_argument(
        "--kill",
        type=kill,
        action="append",
        default=[],
        metavar="WHO@TICK",
        help="kill that robot's process, or the world, in that tick, and start it again; "
        "WHO@TICK[:observation|report|journal|command][+5s|+never]",
    )

    world = command("world", "Play the world's part; robots join from wherever they reach it.")
    _add_scenario(world)
    _add_playing(world)
    world.add_argument("--run", type=name, metavar="NAME", help="what to call the run")

    agent = command("agent", "Play one robot's part.")
    agent.add_argument("id", type=name, metavar="ID", help="which robot of the scenario")
    _add_playing(agent)
    agent.add_argument("--run", type=name, metavar="NAME", help="which run, if several are alive")
    agent.add_argument(
        "--connect-timeout",
        type=positive,
        default=60.0,
        metavar="S",
        help="how long to look for a world (60)",
    )
    for sub in (world, agent):
        _add_reaching(sub)
        _add_listening(
            sub, "be a router that listens there, such as tcp/127.0.0.1:7447; as often as you like"
        )
        sub.add_argument("--launched", action="store_true", help=argparse.SUPPRESS)  # by `tandem run`
        sub.add_argument("--kill", type=kill, action="append", default=[], help=argparse.SUPPRESS)
        sub.add_argument("--fsync", action="store_true", help="the journal survives a power cut")

    _add_robot(command("robot", "Play one robot's part without a world: its own driver, and its agent."))
    _add_conform(command("check-driver", "Try a driver against the contract of docs/driver.md."))

    _add_sweep(command("sweep", "Play a sweep: many trials of a scenario, over axes of its fields."))

    _add_figures(
        command("figures", "Draw a record, into DIR/figures: the paper's figures, and each robot's mission.")
    )

    watch = command("watch", "Serve a page on which a run is watched: a record, or what runs on a network.")
    _add_watch(watch)
    for sub in (run, watch):
        sub.add_argument("--port", type=port, metavar="N", help="of the page (one that is free)")

    audit = command("audit", "Judge a record: what its journals say, held against the world and the planner.")
    audit.add_argument("recording", type=folder, metavar="DIR", help="where `tandem run --out DIR` left it")

    replay = command("replay", "Play a record once more, and hold every decision against it, to the bit.")
    replay.add_argument("recording", type=folder, metavar="DIR", help="where `tandem run --out DIR` left it")

    export = command("export", "Leave a record in other formats: run.mcap, frames.csv, ticks.parquet.")
    export.add_argument("recording", type=folder, metavar="DIR", help="where `tandem run --out DIR` left it")
    export.add_argument("--out", type=folder, metavar="DIR", help="where the files go (where the record is)")

    _add_keys(command("keys", "Make certificates and access rules, for networks that are not trusted."))

    _add_looking(
        command("doctor", "Check what a mission needs of this machine, its keys and its network."),
        command("ps", "List the missions on a network, and who takes part in them."),
    )

    command("scenarios", "List the scenarios and the sweeps that ship.")

    bench = command("bench", "Measure speed, against the bare thing in the same run.")
    bench.add_argument("--rounds", type=count, default=5, metavar="N", help="repetitions (5)")
    return tandem


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", metavar="SCENARIO", help="a name that ships, or a TOML file")
    parser.add_argument("--seed", type=natural, metavar="N", help="instead of the scenario's")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help="of the radio, such as 'a->b: loss=0.3, delay=0..3'",
    )
    parser.add_argument(
        "--rate", type=positive, metavar="X", help="in real time, X times as fast; else in lockstep"
    )


def _add_playing(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=folder, metavar="DIR", help="where the record goes")
    parser.add_argument("--timeout", type=positive, default=30.0, metavar="S", help="longest silence (30)")
    parser.add_argument("-q", "--quiet", action="store_true", help="print only the outcome")


def _add_reaching(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--connect", action="append", default=[], metavar="ENDPOINT",
        help="a router, such as tcp/127.0.0.1:7447; as often as you like",
    )  # fmt: skip
    secured = parser.add_mutually_exclusive_group()
    secured.add_argument(
        "--keys",
        type=folder,
        metavar="DIR",
        help="encrypt, by the certificates that `tandem keys` left in DIR",
    )
    secured.add_argument("--config", type=folder, metavar="FILE", help="a Zenoh configuration of your own")


def _add_watch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording",
        type=folder,
        nargs="?",
        metavar="DIR",
        help="a record, a sweep, or a folder of records",
    )
    _add_reaching(parser)
    parser.add_argument(
        "--address", type=address, default="127.0.0.1", metavar="IP",
        help="of the page (127.0.0.1); 0.0.0.0 in a container, whose port is published on loopback",
    )  # fmt: skip
    parser.add_argument("--launched", action="store_true", help=argparse.SUPPRESS)  # by `tandem run --watch`


def _add_looking(doctor: argparse.ArgumentParser, ps: argparse.ArgumentParser) -> None:
    for sub in (doctor, ps):
        _add_reaching(sub)
        sub.add_argument(
            "--timeout", type=positive, default=2.0, metavar="S", help="how long to listen to missions (2)"
        )
    _add_listening(doctor, "where a world, an agent or a router is to listen; as often as you like")
    ps.add_argument("--json", action="store_true", help="as JSON")


def _add_listening(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help=what)


def _add_figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=folder, metavar="DIR", help="where `tandem run --out DIR` left it")
    parser.add_argument(
        "--only", action="append", choices=PICTURES, metavar="NAME",
        help=f"draw only these; again for more: {', '.join(PICTURES)}",
    )  # fmt: skip
    parser.add_argument(
        "--format", action="append", choices=FORMATS, help="write only these; again for more (all three)"
    )


def _add_keys(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=folder, metavar="DIR", help="where they go; what is there is kept")
    parser.add_argument("--robots", type=names, required=True, metavar="A,B", help="who takes part")
    parser.add_argument(
        "--host", action="append", default=[], metavar="NAME",
        help="a name or address of the world or a router; as often as you like (localhost, 127.0.0.1, ::1)",
    )  # fmt: skip
    parser.add_argument("--days", type=days, default=365, metavar="N", help="how long they last (365)")


def _add_robot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("id", type=name, metavar="ID", help="which robot of the mission")
    parser.add_argument("--driver", required=True, metavar="MODULE:CLASS", help="of its wheels and sensors")
    parser.add_argument("--mission", required=True, metavar="FILE", help="a scenario; starts are not needed")
    _add_driver(parser)
    _add_playing(parser)
    _add_reaching(parser)
    _add_listening(parser, "where the peer reaches it, such as tcp/127.0.0.1:7447; as often as you like")
    parser.add_argument("--run", type=name, metavar="NAME", help="what the mission is called (its name)")
    parser.add_argument("--fsync", action="store_true", help="the journals survive a power cut")
    parser.add_argument(
        "--connect-timeout",
        type=positive,
        default=60.0,
        metavar="S",
        help="how long to look for the peer (60)",
    )


def _add_driver(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="for the driver; again for more"
    )
    parser.add_argument(
        "--rate", type=positive, metavar="X", help="X times as fast, for a driver that can (1)"
    )


def _add_conform(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("driver", metavar="MODULE:CLASS", help="of one robot's wheels and sensors")
    parser.add_argument("--mission", default="paper-1", metavar="FILE", help="a scenario (paper-1)")
    parser.add_argument("--robot", type=name, default="a", metavar="ID", help="which of its robots (a)")
    _add_driver(parser)


def _add_sweep(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("spec", metavar="SPEC", help="a name that ships, or a TOML file")
    parser.add_argument(
        "--out", type=folder, metavar="DIR", help="where the results go, and go on (sweep-NAME)"
    )
    parser.add_argument("--trials", type=trials, metavar="N", help="per cell, instead of the spec's")
    parser.add_argument("--seed", type=natural, metavar="S", help="instead of the spec's")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=count, metavar="N", help="on this machine (as many as it has cores)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask scheduler that runs already")
    parser.add_argument("--processes", action="store_true", help="trials as processes, over Zenoh")
    parser.add_argument(
        "--audit",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="judge every trial's journals, as `tandem audit` does (it takes most of the time)",
    )
    parser.add_argument("--retry", action="store_true", help="play again what was lost before")
    parser.add_argument(
        "--print-trial", type=cell_and_trial, metavar="[CELL:]N", help="only print that trial's scenario file"
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="print only the counts")
