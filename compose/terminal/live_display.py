"""The line on the terminal that shows how far a run is: its tick, and the number of robots by outcome."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.live import Live
from rich.text import Text

from compose.recording.frames import verdict_name
from compose.recording.recording_files import KINDS, WORLD_JOURNAL
from compose.terminal import tables
from protocol.journal.journal_file import Tail
from protocol.messages import Command
from protocol.output import one_line
from protocol.wire import MAX_FRAME_BYTES, decode
from world.scenario import Scenario

REFRESHED = 10
"""The number of displays each second."""
UNDECIDED = "no verdict yet"


@contextmanager
def live(scenario: Scenario, folder: Path) -> Iterator[None]:
    """Show the progress of the run recorded in `folder`, REFRESHED times a second."""
    with Live(
        get_renderable=ProgressLine(scenario, folder).display,
        console=tables.console(),
        auto_refresh=True,
        transient=True,
        refresh_per_second=REFRESHED,
    ):
        yield


class ProgressLine:
    """The progress of a run, read from the growing journal of its world."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self._scenario = scenario
        self._journal = Tail(folder / WORLD_JOURNAL)
        self._commands: dict[str, Command] = {}

    def display(self) -> Text:
        """Return the line, with the new frames of the journal."""
        with suppress(OSError, ValueError):
            for frame in self._journal.news():
                message = decode(frame, KINDS, MAX_FRAME_BYTES)
                if isinstance(message, Command):
                    self._commands[message.robot] = message
        outcomes = Counter(verdict_name(command) or UNDECIDED for command in self._commands.values())
        waiting = len(self._scenario.robots) - len(self._commands)
        parts = [f"{count} {name}" for name, count in outcomes.most_common()]
        parts += [f"waiting for {waiting}"] * (waiting > 0)
        tick = max((command.tick for command in self._commands.values()), default=0)
        return Text(
            f"{one_line(self._scenario.name)}, tick {tick} of {self._scenario.max_ticks} at most: "
            f"{', '.join(parts)}",
            no_wrap=True,
            overflow="ellipsis",
        )
