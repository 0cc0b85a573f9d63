"""Missions with other values than a recording, run so that the page can play them."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Container
from itertools import count
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import UserError
from compose.extras import need
from compose.scenario.scenario_change import ChangedScenario, ScenarioChange, changed, values_of
from compose.view.web.requested_work import RequestedWork
from compose.view.web.sources import Recorded, WatchedRun
from protocol import documents
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

MOST_CHANGED = 8
"""The number of changed missions that a server stores. Of more, the oldest is deleted."""
MOST_MISSION_TICKS = 20_000
"""The last tick of a changed mission."""
MISSION_S = 8.0
"""The wall time in s after which a mission that has not ended is stopped."""
LATE = f"the scenario has not been computed after {MISSION_S:g} s"
_ARRAY = re.compile(r"\[\n((?: +[-+.\de]+,\n)+) *\]")
"""An array of numbers with one number a line."""


class ChangedMissions:
    """The changed missions of one server, recorded in a temporary folder."""

    def __init__(self, work: RequestedWork) -> None:
        self.shows: list[Recorded] = []
        """The recordings of the missions, the oldest first."""
        self._work = work
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._added = 0

    def values(self, show: WatchedRun) -> Any:
        """Return the values of `show` that can be changed. Raises UserError if it is not run again."""
        return self._work.result(values_in, _framed(show), within=MISSION_S, late=LATE)

    def text(self, show: WatchedRun, change: ScenarioChange) -> str:
        """Return the scenario file of the mission of `show` with the values of `change`. Raises UserError."""
        need("tomli_w")
        found: str = self._work.result(
            changed_text, _framed(show), msgspec.json.encode(change), within=MISSION_S, late=LATE
        )
        return found

    def run(self, show: WatchedRun, change: ScenarioChange) -> Recorded:
        """Run the mission of `show` with the values of `change`.

        Raises UserError if a value is refused, or if the mission takes too long.
        """
        frame = _framed(show)
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="tandem-")
        out = tempfile.mkdtemp(dir=self._folder.name)
        try:
            late = f"the mission has not ended after {MISSION_S:g} s: save it, and run it with `tandem run`"
            self._work.result(
                run_changed, frame, msgspec.json.encode(change), out, within=MISSION_S, late=late
            )
            found = Recorded("", Path(out))
            found.load(lambda: self._work.over)
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


def _framed(show: WatchedRun) -> bytes:
    """Return the scenario of a complete recording as a frame. Raises UserError if `show` has none."""
    if show.live:
        raise UserError("the mission is still running")
    scenario = show.scenario if isinstance(show, Recorded) else None
    if scenario is None:
        raise UserError("there is no scenario: the recording has no journal of a simulator")
    return encode(scenario)


# --- in a process of its own ----------------------------------------------------------------------------


def values_in(frame: bytes) -> dict[str, Any]:
    """Return the values of a scenario that can be changed. Raises UserError if it is not run again."""
    found: dict[str, Any] = msgspec.to_builtins(values_of(_scenario(frame)))
    return found


def changed_text(frame: bytes, change: bytes) -> str:
    """Return the scenario file of a scenario with the values of `change`, which is JSON. Raises UserError."""
    import tomli_w  # noqa: PLC0415  # the library is optional

    scenario = _scenario(frame)
    text = tomli_w.dumps(_changed(scenario, change).table)
    text = _ARRAY.sub(lambda found: f"[{', '.join(found[1].replace(',', ' ').split())}]", text)
    return f"# {scenario.name}, changed on the page of `tandem watch`.\n{text}"


def run_changed(frame: bytes, change: bytes, out: str) -> None:
    """Run a scenario with the values of `change`, and write its journals to the folder `out`.

    Raises UserError if a value is refused.
    """
    from compose.launch.in_process import run_mission  # noqa: PLC0415  # imports numpy

    run_mission(_changed(_scenario(frame), change).scenario, Path(out))


def _changed(scenario: Scenario, change: bytes) -> ChangedScenario:
    return changed(scenario, documents.json_value(change, ScenarioChange), MOST_MISSION_TICKS)


def _scenario(frame: bytes) -> Scenario:
    found: Scenario = decode(frame, Scenario, MAX_FRAME_BYTES)
    return found
