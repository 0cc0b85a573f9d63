"""The worst trial of each cell of a sweep, run again so that the page can play it."""

from __future__ import annotations

import tempfile
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import msgspec

from compose.errors import UserError
from compose.view.web.requested_work import RequestedWork
from compose.view.web.sources import Recorded
from protocol import documents, files

MANIFEST, TRIALS = "sweep.json", "trials.parquet"
MOST_TABLE_BYTES = 1 << 30
"""The largest size of the table of trials that is read."""
TRIAL_S = 60.0
"""The wall time in s after which a trial that has not ended is stopped."""


class WorstTrial(NamedTuple):
    """The trial of a cell to look at first, and its recording."""

    show: Recorded
    outcome: str
    trial: int
    seed: int


class Trials:
    """The trials of a sweep's folder, recorded in a temporary folder."""

    def __init__(self, folder: Path, work: RequestedWork) -> None:
        self._folder = folder
        self._work = work
        self._recordings = tempfile.TemporaryDirectory(prefix="tandem-")
        self._worst: dict[int, WorstTrial] = {}

    def worst(self, cell: int) -> WorstTrial:
        """Return the worst trial of `cell`; the first call runs it. Raises UserError if that fails."""
        if cell not in self._worst:
            out = tempfile.mkdtemp(dir=self._recordings.name)
            late = f"the trial has not ended after {TRIAL_S:g} s: print its scenario with `tandem sweep`"
            outcome, trial, seed = self._work.result(
                run_worst, str(self._folder), cell, out, within=TRIAL_S, late=f"{late}, and run it"
            )
            show = Recorded(f"cell-{cell}-trial-{trial}", Path(out))
            show.load(lambda: self._work.over)
            self._worst[cell] = WorstTrial(show, outcome, trial, seed)
        return self._worst[cell]

    @property
    def shows(self) -> list[Recorded]:
        """The recordings of the trials that have been run."""
        return [one.show for one in self._worst.values()]

    def close(self) -> None:
        """Delete the recordings."""
        self._recordings.cleanup()


def run_worst(folder: str, cell: int, out: str) -> tuple[str, int, int]:
    """Run the worst trial of `cell` of the sweep in `folder`, and write its journals to the folder `out`.

    Return its outcome in the sweep, its index and its seed. Raises UserError.
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
    return note.outcome, note.trial, note.seed
