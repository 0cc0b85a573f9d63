"""The worst trial of each cell of a sweep, run again so that the page can play it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import msgspec

from compose.errors import UserError
from compose.view.web.sources import Recorded
from protocol import files

MANIFEST, TRIALS = "sweep.json", "trials.parquet"


class WorstTrial(NamedTuple):
    """The trial of a cell to look at first, and its recording."""

    show: Recorded
    outcome: str
    trial: int
    seed: int


class Trials:
    """The trials of a sweep's folder. They are run in this process, and recorded in a temporary folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._recordings = tempfile.TemporaryDirectory(prefix="tandem-")
        self._worst: dict[int, WorstTrial] = {}

    def worst(self, cell: int) -> WorstTrial:
        """Return the worst trial of `cell`; the first call runs it. Raises UserError if that fails."""
        if cell not in self._worst:
            try:
                self._worst[cell] = self._run(cell)
            except OSError as error:
                raise UserError(f"{self._folder} cannot be read: {error.strerror or error}") from None
            except (msgspec.MsgspecError, ValueError) as error:
                raise UserError(f"cell {cell} cannot be run: {error}") from None
        return self._worst[cell]

    def _run(self, cell: int) -> WorstTrial:
        import pyarrow.parquet as pq  # noqa: PLC0415  # optional, and slow to import

        from compose.launch.in_process import run_mission  # noqa: PLC0415
        from compose.scenario.scenario_file import validate  # noqa: PLC0415
        from compose.sweep.cells import cells, trial_table  # noqa: PLC0415
        from compose.sweep.results_folder import Manifest  # noqa: PLC0415
        from compose.sweep.statistics import noted  # noqa: PLC0415

        sweep = msgspec.json.decode(files.read_bytes(self._folder / MANIFEST), type=Manifest).sweep
        found = next((one for one in cells(sweep) if one.index == cell), None)
        note = noted(pq.read_table(self._folder / TRIALS, filters=[("cell", "=", cell)]))
        if found is None or note is None:
            raise UserError(f"cell {cell} has no trials")
        source = f"{sweep.source}: trial {note.trial} of cell {cell}"
        scenario = validate(trial_table(sweep, found, note.trial), source).seeded(note.seed)
        out = Path(self._recordings.name) / f"cell-{cell}-trial-{note.trial}"
        out.mkdir(exist_ok=True)
        run_mission(scenario, out)
        show = Recorded(out.name, out)
        show.poll()
        return WorstTrial(show, note.outcome, note.trial, note.seed)

    @property
    def shows(self) -> list[Recorded]:
        """The recordings of the trials that have been run."""
        return [one.show for one in self._worst.values()]

    def close(self) -> None:
        """Delete the recordings."""
        self._recordings.cleanup()
