"""Missions that the page has run again: the worst trials of a sweep, and those with other values."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable, Container
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from compose.errors import UserError
from compose.extras import need
from compose.scenario.scenario_change import ChangedScenario, ScenarioChange, changed, values_of
from compose.view.web.requested_work import RequestedWork
from compose.view.web.sources import Recorded, WatchedRun
from protocol import documents, files
from protocol.output import one_line
from protocol.wire import MAX_FRAME_BYTES, decode, encode
from world.scenario import Scenario

MANIFEST, TRIALS = "sweep.json", "trials.parquet"
MOST_TABLE_BYTES = 1 << 30
"""The largest size of the table of trials that is read."""
MOST_CHANGED = 8
"""The number of changed missions that a server stores. Of more, the oldest is deleted."""
MOST_MISSION_TICKS = 20_000
"""The last tick of a changed mission."""
MOST_STEPS = 200
"""The maximum number of ticks at which the trials of a sweep are counted."""
TRIAL_S, MISSION_S = 60.0, 8.0
"""The wall times in s after which a trial, and a changed mission, that has not ended is stopped."""
LATE = f"the scenario has not been computed after {MISSION_S:g} s"
_ARRAY = re.compile(r"\[\n((?: +[-+.\de]+,\n)+) *\]")
"""An array of numbers with one number a line."""


class Reruns:
    """The missions of one server, run in processes of their own and recorded in a temporary folder."""

    def __init__(self, work: RequestedWork) -> None:
        self._work = work
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def _recorded(
        self, function: Callable[..., Any], *arguments: Any, within: float, late: str
    ) -> tuple[Recorded, Any]:
        """Return the recording that `function` writes to the folder in its last argument, and its result.

        Raises UserError if it cannot, or takes too long.
        """
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="tandem-")
        out = tempfile.mkdtemp(dir=self._folder.name)
        try:
            result = self._work.result(function, *arguments, out, within=within, late=late)
            found = Recorded("", Path(out))
            found.load(lambda: self._work.over)
        except BaseException as error:
            shutil.rmtree(out, ignore_errors=True)
            if isinstance(error, OSError):
                raise UserError(f"the mission cannot be recorded: {error}") from None
            raise
        return found, result

    def close(self) -> None:
        """Delete the recordings."""
        if self._folder is not None:
            self._folder.cleanup()


class WorstTrial(NamedTuple):
    """The trial of a cell to look at first, and its recording."""

    show: Recorded
    outcome: str
    trial: int


class Trials(Reruns):
    """The trials of a sweep's folder."""

    def __init__(self, folder: Path, work: RequestedWork) -> None:
        super().__init__(work)
        self._sweep = folder
        self._worst: dict[int, WorstTrial] = {}
        self._over_time: Any = None

    def worst(self, cell: int) -> WorstTrial:
        """Return the worst trial of `cell`; the first call runs it. Raises UserError if that fails."""
        if cell not in self._worst:
            late = f"the trial has not ended after {TRIAL_S:g} s: print its scenario with `tandem sweep`"
            late += ", and run it"
            show, found = self._recorded(run_worst, str(self._sweep), cell, within=TRIAL_S, late=late)
            self._worst[cell] = WorstTrial(show, *found)
            show.name = f"cell-{cell}-trial-{self._worst[cell].trial}"
        return self._worst[cell]

    def over_time(self) -> Any:
        """Return how many trials of each cell are localised by which ticks. Raises UserError."""
        if self._over_time is None:
            late = f"the trials are not read after {TRIAL_S:g} s"
            self._over_time = self._work.result(over_time, str(self._sweep), within=TRIAL_S, late=late)
        return self._over_time

    @property
    def shows(self) -> list[Recorded]:
        """The recordings of the trials that have been run."""
        return [one.show for one in self._worst.values()]


class ChangedMissions(Reruns):
    """The changed missions of one server."""

    def __init__(self, work: RequestedWork) -> None:
        super().__init__(work)
        self.shows: list[Recorded] = []
        """The recordings of the missions, the oldest first."""
        self._added = 0

    def values(self, show: WatchedRun) -> Any:
        """Return the values of `show` that can be changed. Raises UserError if it is not run again."""
        return self._work.result(values_in, _framed(show), within=MISSION_S, late=LATE)

    def text(self, show: WatchedRun, change: ScenarioChange) -> Any:
        """Return the scenario file of the mission of `show` with the values of `change`. Raises UserError."""
        need("tomli_w")
        values = msgspec.json.encode(change)
        return self._work.result(changed_text, _framed(show), values, within=MISSION_S, late=LATE)

    def run(self, show: WatchedRun, change: ScenarioChange) -> Recorded:
        """Run the mission of `show` with the values of `change`.

        Raises UserError if a value is refused, or if the mission takes too long.
        """
        late = f"the mission has not ended after {MISSION_S:g} s: save it, and run it with `tandem run`"
        values = msgspec.json.encode(change)
        return self._recorded(run_changed, _framed(show), values, within=MISSION_S, late=late)[0]

    def add(self, show: Recorded, taken: Container[str]) -> None:
        """Add a mission that has been run, with a name that is not in `taken`, and delete the oldest."""
        names = (f"changed {i}" for i in count(self._added + 1))
        show.name = next(name for name in names if name not in taken)
        self._added += 1
        self.shows.append(show)
        while len(self.shows) > MOST_CHANGED:
            shutil.rmtree(self.shows.pop(0).folder, ignore_errors=True)


def _framed(show: WatchedRun) -> bytes:
    """Return the scenario of a complete recording as a frame. Raises UserError if `show` has none."""
    if show.live:
        raise UserError("the mission is still running")
    scenario = show.scenario if isinstance(show, Recorded) else None
    if scenario is None:
        raise UserError("there is no scenario: the recording has no journal of a simulator")
    return encode(scenario)


# --- in a process of its own ----------------------------------------------------------------------------


def values_in(frame: bytes) -> Any:
    """Return the values of a scenario that can be changed. Raises UserError if it is not run again."""
    return msgspec.to_builtins(values_of(decode(frame, Scenario, MAX_FRAME_BYTES)))


def changed_text(frame: bytes, change: bytes) -> str:
    """Return the scenario file of a scenario with the values of `change`, which is JSON. Raises UserError."""
    import tomli_w  # noqa: PLC0415  # the library is optional

    found = _changed(frame, change)
    text = _ARRAY.sub(
        lambda array: f"[{', '.join(array[1].replace(',', ' ').split())}]", tomli_w.dumps(found.table)
    )
    return f"# {found.scenario.name}, made on the page of `tandem watch`.\n{text}"


def run_changed(frame: bytes, change: bytes, out: str) -> None:
    """Run a scenario with the values of `change`, and write its journals to the folder `out`.

    Raises UserError if a value is refused.
    """
    from compose.launch.in_process import run_mission  # noqa: PLC0415  # imports numpy

    run_mission(_changed(frame, change).scenario, Path(out))


def _changed(frame: bytes, change: bytes) -> ChangedScenario:
    scenario = decode(frame, Scenario, MAX_FRAME_BYTES)
    return changed(scenario, documents.json_value(change, ScenarioChange), MOST_MISSION_TICKS)


def run_worst(folder: str, cell: int, out: str) -> tuple[str, int]:
    """Run the worst trial of `cell` of the sweep in `folder`, and write its journals to the folder `out`.

    Return its outcome in the sweep and its index. Raises UserError.
    """
    import pyarrow.parquet as pq  # noqa: PLC0415  # optional, and slow to import

    from compose.launch.in_process import run_mission  # noqa: PLC0415
    from compose.scenario.scenario_file import validate  # noqa: PLC0415
    from compose.sweep.cells import cell_at, trial_table  # noqa: PLC0415
    from compose.sweep.results_folder import Manifest  # noqa: PLC0415
    from compose.sweep.statistics import noted  # noqa: PLC0415

    try:
        manifest = files.read_inside(Path(folder), MANIFEST, most=documents.MOST_DOCUMENT_BYTES)
        sweep = documents.json_value(manifest, Manifest).sweep
        found = cell_at(sweep, cell)
        table = BytesIO(files.read_inside(Path(folder), TRIALS, most=MOST_TABLE_BYTES))
        note = noted(pq.read_table(table, filters=[("cell", "=", cell)]))
        if found is None or note is None:
            raise UserError(f"cell {cell} has no trials")
        source = f"{sweep.source}: trial {note.trial} of cell {cell}"
        scenario = validate(trial_table(sweep, found, note.trial), source).seeded(note.seed)
        run_mission(scenario, Path(out))
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    except (msgspec.MsgspecError, ValueError) as error:
        raise UserError(f"cell {cell} cannot be run: {error}") from None
    return note.outcome, note.trial


def over_time(folder: str) -> dict[str, Any]:
    """Return the numbers of trials that are localised by certain ticks, by the cell. Raises UserError."""
    import numpy as np  # noqa: PLC0415
    import pyarrow as pa  # noqa: PLC0415  # optional, and slow to import
    import pyarrow.parquet as pq  # noqa: PLC0415

    try:
        table = BytesIO(files.read_inside(Path(folder), TRIALS, most=MOST_TABLE_BYTES))
        found = pq.read_table(table, columns=["cell", "ticks"], filters=[("outcome", "=", "localised")])
        found = found.cast(pa.schema({"cell": pa.int32(), "ticks": pa.int32()})).drop_null()
    except (OSError, ValueError, NotImplementedError, TypeError) as error:
        raise UserError(one_line(f"{folder}: {TRIALS} cannot be read: {error}")) from None
    cells, ticks = (np.asarray(found[name]) for name in ("cell", "ticks"))
    last = int(ticks.max(initial=0))
    steps = np.unique(np.linspace(0, last, min(last + 1, MOST_STEPS)).astype(int))
    counts = {
        str(cell): np.searchsorted(np.sort(ticks[cells == cell]), steps, side="right").tolist()
        for cell in np.unique(cells).tolist()
    }
    return {"ticks": steps.tolist(), "localised": counts}
