"""What a run shows on a terminal: each robot's phase, state and tick while it runs; a table at its end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.live import Live
from rich.table import Table

from compose.recording.run import WORLD_JOURNAL
from compose.recording.summary_json import outcome_line
from compose.terminal import tables, text_width
from protocol.journal.journal_file import Tail
from protocol.messages import Command, DeadlineMissed, FinalReport, MissionEnd
from protocol.output import one_line, say
from protocol.wire import MAX_FRAME_BYTES, decode
from world.scenario import Scenario

IS_AT, THINKS, ERROR, SIGMA = "is at x, y, heading", "thinks it is at", "error m", "sigma m"
RANGES, REPORTS, LATE = "ranges", "reports", "late"
NOTES = (
    (SIGMA, "sigma: of the position, as claimed"),
    (LATE, "late: ticks in which it stood still, as its drive had not come in time"),
    (ERROR, "m and rad"),
    (RANGES, "ranges to the anchor + to the peer"),
    (REPORTS, "reports sent / heard"),
)
"""each with the column that it is a footnote to"""
CHOICES = (
    (IS_AT, THINKS, ERROR, SIGMA, RANGES, REPORTS, LATE),
    (THINKS, ERROR, SIGMA, RANGES, REPORTS, LATE),
    (ERROR, SIGMA, RANGES, REPORTS, LATE),
    (ERROR, SIGMA, LATE),
)
"""of the columns: the first that fits; sigma and late only where there is something to show"""
LISTED = 4
"""robots that are listed with all their figures where a table of all columns does not fit"""
NAMED = 10
"""robots that a sentence names at the most"""


@contextmanager
def live(scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the run whose record grows in `folder`, ten times a second."""
    journal = Tail(folder / WORLD_JOURNAL)
    commands: dict[str, Command] = {}

    def update() -> None:
        with suppress(OSError, ValueError):
            for frame in journal.news():
                message = decode(
                    frame, Scenario | Command | DeadlineMissed | MissionEnd | FinalReport, MAX_FRAME_BYTES
                )
                if isinstance(message, Command):
                    commands[message.robot] = message

    def table() -> Table:
        update()
        ids = [robot.id for robot in scenario.robots]
        latest = max((command.tick for command in commands.values()), default=0)
        rows = Table(title=f"{scenario.name}, tick {latest} of {scenario.max_ticks} at most")
        for heading in ("robot", "phase", "state", "v m/s", "omega rad/s"):
            rows.add_column(heading, no_wrap=True)
        for robot in ids:
            command = commands.get(robot)
            if command is None:
                rows.add_row(robot, "", "awaited", "", "")
            else:
                rows.add_row(
                    robot,
                    str(command.phase),
                    one_line(command.state),
                    f"{command.v:.3f}",
                    f"{command.omega:.3f}",
                )
        return rows

    with Live(
        get_renderable=table,
        console=tables.console(),
        auto_refresh=True,
        transient=True,
        refresh_per_second=10,
    ):
        yield


def result(summary: Mapping[str, Any], rate: float | None = None) -> None:
    """The table at the end of a run that went at `rate`, and what became of deadlines and FinalReports."""
    robots: Mapping[str, Any] = summary["robots"]
    exact = all(robot["covariance"] is None for robot in robots.values())
    late = {name: missed for name, robot in robots.items() if (missed := robot["deadlines_missed"])}
    left_out = {*([SIGMA] if exact else []), *([] if late else [LATE])}
    for choice in CHOICES:
        columns = [column for column in choice if column not in left_out]
        cells = {name: _cells(robot, columns) for name, robot in robots.items()}
        rows = [(name, *of_robot.values()) for name, of_robot in cells.items()]
        made = tables.table(["robot"], columns, rows)
        lines = tables.lines(made)
        if tables.fits(lines):
            break
        if len(robots) <= LISTED:
            lines = [
                line
                for name, of_robot in cells.items()
                for line in (name, *(f"  {heading}: {cell}" for heading, cell in of_robot.items()))
            ]
            break
    else:
        lines = tables.lines(made, text_width.room())
    say(f"{summary['scenario']}: {outcome_line(summary)}", "", *lines, "", *text_width.notes(NOTES, columns))
    if late:
        say(*text_width.wrapped(_missed(late, summary["ticks"], rate)))


def _missed(late: Mapping[str, int], ticks: int, rate: float | None) -> str:
    """That deadlines were missed, by whom, and what to do about it."""
    worst = sorted(late.items(), key=lambda one: -one[1])
    names = ", ".join([f"{name} {missed}" for name, missed in worst[:NAMED]])
    more = f" and {len(worst) - NAMED} more robots" if len(worst) > NAMED else ""
    slower = f", such as --rate {rate / 2:g}," if rate is not None else ""
    return f"deadlines missed, of {ticks}: {names}{more}; a lower --rate{slower} leaves more time for each"


def _cells(robot: Mapping[str, Any], columns: Sequence[str]) -> dict[str, str]:
    """What stands in its line, by column."""
    all_of_it = {
        IS_AT: _pose(robot["truth"]),
        THINKS: _pose(robot["estimate"]),
        ERROR: _number(robot["position_error_m"], ".1e"),
        SIGMA: _number(robot["position_sigma_m"], ".1e"),
        RANGES: f"{_number(robot['anchor_ranges'])} + {_number(robot['mutual_ranges'])}",
        REPORTS: f"{_number(robot['reports_sent'])} / {_number(robot['reports_heard'])}",
        LATE: _number(robot["deadlines_missed"]),
    }
    return {column: all_of_it[column] for column in columns}


def _pose(pose: list[float] | None) -> str:
    return f"{pose[0]:.2f} {pose[1]:.2f} {pose[2]:+.2f}" if pose else "-"


def _number(value: float | None, form: str = "") -> str:
    return "-" if value is None else format(value, form)
