"""The command `tandem`. Every command imports only what it uses, when it is used."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from protocol.inbox import Inbox, Interrupted

if TYPE_CHECKING:
    from compose.record import Mode, Record
    from world.scenario import Scenario

OK, NOT_LOCALISED, USER_ERROR, FAILED = 0, 1, 2, 3
"""exit statuses: localised; the mission ended otherwise; a mistake of the user's; the run itself failed"""


class UserError(Exception):
    """A mistake of the user's, told in one line."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USER_ERROR, f"{self.prog}: {message}\n")


def main(arguments: list[str] | None = None) -> NoReturn:
    """The entry point."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    options = _parser().parse_args(arguments)
    try:
        status = options.command(options)
    except UserError as error:
        print(f"tandem {options.name}: {error}", file=sys.stderr)
        status = USER_ERROR
    except BrokenPipeError:
        status = NOT_LOCALISED
    if "protocol.session" in sys.modules:
        from protocol.session import leave

        leave(status)
    sys.exit(status)


# --- run --------------------------------------------------------------------------------------------


def run(options: argparse.Namespace) -> int:
    """Play a mission on this machine."""
    scenario = _scenario(options)
    if options.out is not None and any(options.out.glob("*.journal")):
        raise UserError(f"--out: {options.out} holds a record already; choose another folder")
    if options.in_process:
        return _run_in_process(options, scenario)
    return _run_as_processes(options, scenario)


def _run_in_process(options: argparse.Namespace, scenario: Scenario) -> int:
    from compose import inline

    if options.rate is not None:
        raise UserError("--rate: --in-process knows no real time")
    if options.out is None:
        began = time.perf_counter()
        return _conclude(options, inline.play(scenario), None, "in-process", began)
    with _record_folder(options.out) as folder:
        began = time.perf_counter()
        return _conclude(options, inline.play(scenario, folder), folder, "in-process", began)


def _run_as_processes(options: argparse.Namespace, scenario: Scenario) -> int:
    from compose import local, record, stop

    arguments = [options.scenario]
    for option, value in (("--seed", options.seed), ("--rate", options.rate)):
        if value is not None:
            arguments += [option, str(value)]
    inbox = Inbox("tandem run")
    with stop.stops_into(inbox), _record_folder(options.out) as folder:
        began = time.perf_counter()
        try:
            with _progress(options, scenario, folder):
                local.play(
                    scenario,
                    arguments,
                    folder,
                    inbox,
                    run=_run_name(options, scenario),
                    patience=options.patience,
                )
        except local.ChildFailed as failure:
            inbox.say(f"failed: {failure}")
            return FAILED
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            return stop.STATUS
        return _conclude(options, record.read(folder), folder, "processes", began)


@contextmanager
def _progress(options: argparse.Namespace, scenario: Scenario, folder: Path) -> Iterator[None]:
    """What is shown while it runs, where somebody can see it."""
    if options.quiet or not sys.stdout.isatty():
        yield
        return
    from rich.console import Console

    from compose import show

    with show.live(scenario, folder, Console()):
        yield


def _conclude(
    options: argparse.Namespace, played: Record, folder: Path | None, mode: Mode, began: float
) -> int:
    """Leave the views of the record, and say how it went."""
    from compose import record

    summary = record.summary(played, mode, round(time.perf_counter() - began, 6))
    if folder is not None and options.out is not None:
        record.leave(played, summary, folder)
    if options.quiet:
        print(record.outcome_line(summary))
    else:
        from rich.console import Console

        from compose import show

        show.result(summary, Console())
    return OK if summary["outcome"] == "localised" else NOT_LOCALISED


# --- world and agent --------------------------------------------------------------------------------


def world(options: argparse.Namespace) -> int:
    """Play the world's part: robots join from wherever they reach it."""
    from compose import record, stop
    from protocol import session
    from protocol.journal import Journal, RecordExists
    from world.process import WorldProcess

    scenario = _scenario(options)
    name = _run_name(options, scenario)
    inbox = Inbox("tandem world")
    with stop.stops_into(inbox), _record_folder(options.out) as folder:
        began = time.perf_counter()
        try:
            with (
                session.open_router(options.listen) as link,
                Journal(folder / record.WORLD_JOURNAL, fsync=options.fsync) as journal,
            ):
                process = WorldProcess(
                    scenario, link, name, journal, inbox, rate=options.rate, patience=options.patience
                )
                if not options.quiet:
                    robots = ", ".join(robot.id for robot in scenario.robots)
                    print(f"run {name} at {options.listen}: waiting for {robots}", flush=True)
                with _progress(options, scenario, folder):
                    end = process.play()
        except (session.BadEndpoint, session.CannotListen) as error:
            raise UserError(f"--listen: {error}") from None
        except RecordExists as error:
            raise UserError(f"--out: {error}") from None
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            return stop.STATUS
        if options.quiet:
            print(record.ended(end.outcome, end.tick, end.reason))
            return OK if end.outcome == "localised" else NOT_LOCALISED
        return _conclude(options, record.read(folder), folder, "processes", began)


def agent(options: argparse.Namespace) -> int:
    """Play one robot's part."""
    from agent.process import AgentProcess, NoWorld, Search, Unwelcome, join
    from compose import record, stop
    from protocol import session
    from protocol.journal import RecordExists

    inbox = Inbox(f"tandem agent {options.id}")
    with stop.stops_into(inbox):
        search = Search(f"world at {options.connect}", options.wait, inbox)
        try:
            with session.open_client(options.connect, search.go_on) as link:
                name, briefing = join(link, options.run, options.id, search)
                process = AgentProcess(
                    briefing,
                    link,
                    name,
                    inbox,
                    out=options.out,
                    fsync=options.fsync,
                    patience=options.patience,
                )
                if not options.quiet:
                    print(f"{options.id}: in run {name}, with {briefing.peer}", flush=True)
                end = process.play()
        except session.BadEndpoint as error:
            raise UserError(f"--connect: {error}") from None
        except RecordExists as error:
            raise UserError(f"--out: {error}") from None
        except Unwelcome as error:
            raise UserError(str(error)) from None
        except NoWorld as error:
            inbox.say(str(error))
            return FAILED
        except Interrupted as signal_name:
            inbox.say(f"stopped by {signal_name}")
            return stop.STATUS
        except OSError as error:
            raise UserError(_cannot_write(options.out, error)) from None
    print(f"{options.id}: {record.ended(end.outcome, end.tick, end.reason)}")
    return OK if end.outcome == "localised" else NOT_LOCALISED


# --- scenarios and bench ----------------------------------------------------------------------------


def scenarios(_options: argparse.Namespace) -> int:
    """List the scenarios that ship."""
    from compose.scenario import shipped

    for name, path in shipped().items():
        first = path.read_text(encoding="utf-8").splitlines()[0]
        print(f"{name:10} {first.removeprefix('# ')}")
    return OK


def bench(options: argparse.Namespace) -> int:
    """Measure speed, against the bare thing in the same run."""
    from compose import bench as benchmark

    return benchmark.main(options.rounds)


# --- what the commands share ------------------------------------------------------------------------


def _scenario(options: argparse.Namespace) -> Scenario:
    from compose.scenario import BadScenario, load

    try:
        return load(options.scenario, seed=options.seed)
    except BadScenario as error:
        raise UserError(str(error)) from None


def _run_name(options: argparse.Namespace, scenario: Scenario) -> str:
    import secrets

    return getattr(options, "run", None) or f"{scenario.name}-{secrets.token_hex(3)}"


@contextmanager
def _record_folder(out: Path | None) -> Iterator[Path]:
    """Where the record goes: `out`, or a folder that is gone afterwards."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
        yield out
    except OSError as error:
        raise UserError(_cannot_write(out, error)) from None


def _cannot_write(out: Path | None, error: OSError) -> str:
    return f"--out: {out} cannot be written: {error.strerror or error}"


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def _natural(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to 2^63 - 1")
    return int(text)


def _name(text: str) -> str:
    import re

    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", text):
        raise argparse.ArgumentTypeError(f"'{text}' is no name: letters, digits, - and _, 64 at most")
    return text


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="tandem", description="Two robots find out together where they are.")
    commands = parser.add_subparsers(dest="name", required=True, metavar="COMMAND", parser_class=_Parser)

    def command(function: Any) -> argparse.ArgumentParser:
        sub = commands.add_parser(function.__name__, help=function.__doc__, description=function.__doc__)
        sub.set_defaults(command=function)
        return sub

    def shared(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--out", type=Path, metavar="DIR", help="where the record goes")
        sub.add_argument("--patience", type=_positive, default=30.0, metavar="S", help="longest silence (30)")
        sub.add_argument("-q", "--quiet", action="store_true", help="print only the outcome")

    def of_scenario(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("scenario", metavar="SCENARIO", help="a name that ships, or a TOML file")
        sub.add_argument("--seed", type=_natural, metavar="N", help="instead of the scenario's")
        sub.add_argument(
            "--rate", type=_positive, metavar="X", help="real time, X times as fast; else lockstep"
        )

    sub = command(run)
    of_scenario(sub)
    shared(sub)
    sub.add_argument("--in-process", action="store_true", help="without processes or network")

    sub = command(world)
    of_scenario(sub)
    shared(sub)
    sub.add_argument("--listen", required=True, metavar="ENDPOINT", help="such as tcp/127.0.0.1:7447")
    sub.add_argument("--run", type=_name, metavar="NAME", help="what to call the run")
    sub.add_argument("--fsync", action="store_true", help="journals survive a power cut")

    sub = command(agent)
    sub.add_argument("id", type=_name, metavar="ID", help="which robot of the scenario")
    shared(sub)
    sub.add_argument("--connect", required=True, metavar="ENDPOINT", help="such as tcp/127.0.0.1:7447")
    sub.add_argument("--run", type=_name, metavar="NAME", help="which run, if several are alive")
    sub.add_argument(
        "--wait", type=_positive, default=60.0, metavar="S", help="how long to look for a world (60)"
    )
    sub.add_argument("--fsync", action="store_true", help="journals survive a power cut")

    command(scenarios)

    sub = command(bench)
    sub.add_argument("--rounds", type=_natural, default=5, metavar="N", help="repetitions (5)")
    return parser
