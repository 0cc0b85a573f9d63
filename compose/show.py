"""What a run shows on a terminal: each robot's phase, state and tick while it runs; a table at its end."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.live import Live
from rich.table import Table

from compose.record import WORLD_JOURNAL
from compose.summary import outcome_line
from protocol.journal import Tail
from protocol.messages import Drive, End, Farewell, Missed
from protocol.terminal import one_line, say
from protocol.wire import MAX_FRAME_BYTES, decode
from world.scenario import Scenario

SIGMA = "sigma m"
"""a column only where sensors are not exact"""
LATE = "late"
"""a column only where a drive came too late, in real time"""
LEGEND = "m and rad; ranges to the anchor + to the peer; reports sent / heard"
LATE_LEGEND = "late: ticks in which it stood still, as its drive had not come in time; "
SIGMA_LEGEND = "sigma: of the position, as claimed; "
UNLIMITED = 1000
"""columns, of what is not a terminal"""


def console(**options: Any) -> Console:
    """A console that takes text as it is: `[red]` and `:smile:` are what somebody said, and no markup."""
    return Console(markup=False, emoji=False, highlight=False, **options)


@contextmanager
def live(scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the run whose record grows in `folder`, ten times a second."""
    journal = Tail(folder / WORLD_JOURNAL)
    drives: dict[str, Drive] = {}

    def update() -> None:
        with suppress(OSError, ValueError):
            for frame in journal.news():
                message = decode(frame, Scenario | Drive | Missed | End | Farewell, MAX_FRAME_BYTES)
                if isinstance(message, Drive):
                    drives[message.robot] = message

    def table() -> Table:
        update()
        ids = [robot.id for robot in scenario.robots]
        latest = max((drive.tick for drive in drives.values()), default=0)
        rows = Table(title=f"{scenario.name}, tick {latest} of {scenario.max_ticks} at most")
        for heading in ("robot", "phase", "state", "v m/s", "omega rad/s"):
            rows.add_column(heading)
        for robot in ids:
            drive = drives.get(robot)
            if drive is None:
                rows.add_row(robot, "", "awaited", "", "")
            else:
                rows.add_row(
                    robot, str(drive.phase), one_line(drive.state), f"{drive.v:.3f}", f"{drive.omega:.3f}"
                )
        return rows

    with Live(
        get_renderable=table, console=console(), auto_refresh=True, transient=True, refresh_per_second=10
    ):
        yield


def result(summary: Mapping[str, Any]) -> None:
    """The table at the end of a run: a line each robot, or a few where the terminal is narrow."""
    exact = all(robot["covariance"] is None for robot in summary["robots"].values())
    late = any(robot["deadlines_missed"] for robot in summary["robots"].values())
    robots = {name: _cells(robot, exact, late) for name, robot in summary["robots"].items()}
    rows = Table("robot", box=SIMPLE_HEAD, pad_edge=False)
    for heading in next(iter(robots.values())):
        rows.add_column(heading, justify="right")
    for name, cells in robots.items():
        rows.add_row(name, *cells.values())
    page = console(width=UNLIMITED, file=io.StringIO())
    with page.capture() as capture:
        page.print(rows)
    lines = [line.rstrip() for line in capture.get().splitlines() if line.strip()]
    if sys.stdout.isatty() and max(map(cell_len, lines)) > Console().width:
        lines = [
            line
            for name, cells in robots.items()
            for line in (name, *(f"  {heading}: {cell}" for heading, cell in cells.items()))
        ]
    title = f"{summary['scenario']}: {outcome_line(summary)}"
    legend = ("" if exact else SIGMA_LEGEND) + (LATE_LEGEND if late else "") + LEGEND
    say(title, "", *lines, "", legend)


def _cells(robot: Mapping[str, Any], exact: bool, late: bool) -> dict[str, str]:
    """What stands in its line, by column."""
    sigma = {} if exact else {SIGMA: _number(robot["position_sigma_m"], ".1e")}
    return {
        "is at x, y, heading": _pose(robot["truth"]),
        "thinks it is at": _pose(robot["estimate"]),
        "error m": _number(robot["position_error_m"], ".1e"),
        **sigma,
        "ranges": f"{_number(robot['anchor_ranges'])} + {_number(robot['mutual_ranges'])}",
        "reports": f"{_number(robot['reports_sent'])} / {_number(robot['reports_heard'])}",
        **({LATE: _number(robot["deadlines_missed"])} if late else {}),
    }


def _pose(pose: list[float] | None) -> str:
    return f"{pose[0]:.2f} {pose[1]:.2f} {pose[2]:+.2f}" if pose else "-"


def _number(value: float | None, form: str = "") -> str:
    return "-" if value is None else format(value, form)
