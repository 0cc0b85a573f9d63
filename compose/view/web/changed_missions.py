"""Missions with other values than a recording, run in this process so that the page can play them."""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections.abc import Callable, Container
from contextlib import ExitStack
from itertools import count
from pathlib import Path

from compose.errors import UserError
from compose.extras import need
from compose.scenario.scenario_change import ScenarioChange, changed, values_of
from compose.view.web.sources import Recorded, WatchedRun
from protocol.journal.journal_file import Journal, Sink
from world.scenario import Scenario

MOST_CHANGED = 8
"""The number of changed missions that a server stores. Of more, the oldest is deleted."""
MOST_TICKS = 20_000
"""The last tick of a changed mission."""
LONGEST_S = 8.0
"""The wall time in s after which a mission that has not ended is stopped."""
_ARRAY = re.compile(r"\[\n((?: +[-+.\de]+,\n)+) *\]")
"""An array of numbers with one number a line."""


class ChangedMissions:
    """The changed missions of one server, recorded in a temporary folder."""

    def __init__(self) -> None:
        self.shows: list[Recorded] = []
        """The recordings of the missions, the oldest first."""
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._added = 0

    def values(self, show: WatchedRun) -> ScenarioChange:
        """Return the values of `show` that can be changed. Raises UserError if it is not run again."""
        import compose.launch.in_process  # noqa: F401, PLC0415  # imports numpy; soon needed by `run`

        return values_of(scenario_of(show))

    def run(self, show: WatchedRun, change: ScenarioChange, stopped: Callable[[], bool]) -> Recorded:
        """Run the mission of `show` with the values of `change`, unless `stopped` returns true meanwhile.

        Raises UserError if a value is refused, or if the mission takes too long.
        """
        from compose.launch.in_process import journals, played  # noqa: PLC0415  # imports numpy

        scenario = changed(scenario_of(show), change, MOST_TICKS).scenario
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="tandem-")
        out = Path(tempfile.mkdtemp(dir=self._folder.name))
        deadline = time.monotonic() + LONGEST_S

        def check() -> None:
            if time.monotonic() > deadline:
                raise UserError(
                    f"the mission has not ended after {LONGEST_S:g} s: save it, and run it with `tandem run`"
                )
            if stopped():
                raise UserError("the server has been stopped")

        try:
            with ExitStack() as stack:
                played(
                    scenario,
                    {
                        name: _CheckedSink(stack.enter_context(Journal(out / name)), check)
                        for name in journals(scenario)
                    },
                )
            found = Recorded("", out)
            found.poll()
        except BaseException as error:
            shutil.rmtree(out, ignore_errors=True)
            if isinstance(error, OSError):
                raise UserError(f"the mission cannot be recorded: {error}") from None
            raise
        return found

    def add(self, show: Recorded, taken: Container[str]) -> None:
        """Add a mission that has been run, with a name that is not in `taken`, and delete the oldest."""
        names = (f"changed {i}" for i in count(self._added + 1))
        show.name = next(name for name in names if name not in taken)
        self._added += 1
        self.shows.append(show)
        while len(self.shows) > MOST_CHANGED:
            shutil.rmtree(self.shows.pop(0).folder, ignore_errors=True)

    def close(self) -> None:
        """Delete the recordings."""
        if self._folder is not None:
            self._folder.cleanup()


class _CheckedSink:
    """A journal whose writes call `check` first, which may raise an exception to end the mission."""

    def __init__(self, sink: Sink, check: Callable[[], None]) -> None:
        self._sink = sink
        self._check = check

    def write(self, *frames: bytes) -> None:
        """Append all of `frames` in one operation."""
        self._check()
        self._sink.write(*frames)


def scenario_of(show: WatchedRun) -> Scenario:
    """Return the scenario of a complete recording. Raises UserError if `show` is none, or has no scenario."""
    if show.live:
        raise UserError("the mission is still running")
    scenario = show.scenario if isinstance(show, Recorded) else None
    if scenario is None:
        raise UserError("there is no scenario: the recording has no journal of a simulator")
    return scenario


def changed_text(show: WatchedRun, change: ScenarioChange) -> str:
    """Return the scenario file of the mission of `show` with the values of `change`. Raises UserError."""
    need("tomli_w")
    import tomli_w  # noqa: PLC0415  # the library is optional

    scenario = scenario_of(show)
    text = tomli_w.dumps(changed(scenario, change, MOST_TICKS).table)
    text = _ARRAY.sub(lambda found: f"[{', '.join(found[1].replace(',', ' ').split())}]", text)
    return f"# {scenario.name}, changed on the page of `tandem watch`.\n{text}"
