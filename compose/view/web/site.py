"""The content of one server: recordings, a sweep, an estimate, or missions on a network."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from compose.errors import UserError
from compose.recording.comparison import comparison
from compose.recording.recording_files import journals_in
from compose.recording.run import read
from compose.view.played_estimate import read_player
from compose.view.web import results_page
from compose.view.web.costs import costs
from compose.view.web.live import Listener
from compose.view.web.requested_work import RequestedWork
from compose.view.web.reruns import ChangedMissions, Trials
from compose.view.web.sources import Recorded, WatchedEstimate, WatchedRun, end_of
from protocol import files
from protocol.journal.journal_file import CorruptJournal

MOST_FIGURE_BYTES = 64 << 20
"""The largest size of a figure that is shown."""
COMPARISON_S = 60.0
"""The wall time in s that a comparison of two recordings may take."""


class Site:
    """The runs, the sweep or the estimate that one server shows."""

    def __init__(
        self,
        shows: list[Recorded] | None = None,
        listeners: list[Listener] | None = None,
        folder: Path | None = None,
        estimate: Path | None = None,
        compared: bool = False,
    ) -> None:
        """Create the content of a server.

        `folder` is the folder of a sweep, and `estimate` that of an estimate; None if there is none. If
        `compared`, the two `shows` are shown side by side.
        """
        self.compared = compared
        self.folder = folder
        self.estimate = estimate
        player = read_player(estimate) if estimate is not None else None
        self.players = [WatchedEstimate(player)] if player is not None else []
        self.work = RequestedWork()
        self.trials = Trials(folder, self.work) if folder is not None else None
        self.changed = ChangedMissions(self.work)
        self.recorded = shows or []
        self.listeners = listeners or []
        self.more = False
        """True if the last poll has left data to be read by the next one."""
        self.answering = 0
        """The number of requests that are being answered, those of news excepted."""

    @property
    def shows(self) -> dict[str, WatchedRun]:
        """The runs whose static data is known, by name."""
        trials = self.trials.shows if self.trials is not None else []
        found: dict[str, WatchedRun] = {
            show.name: show for show in [*self.recorded, *self.players, *trials, *self.changed.shows]
        }
        for i, listener in enumerate(self.listeners):
            for run, show in listener.shows.items():
                found[run if run not in found else f"{run}.{i}"] = show
        return {name: show for name, show in found.items() if show.setup is not None}

    @property
    def waiting(self) -> bool:
        """True if new data may arrive."""
        return bool(self.listeners) or any(show.live for show in self.recorded)

    @property
    def notes(self) -> list[str]:
        """One line for each part of a recording that cannot be read."""
        return [note for show in self.recorded for note in show.notes]

    def figure(self, name: str) -> bytes | None:
        """Return the figure called `name`; None if there is none, or if it cannot be read."""
        with suppress(OSError):
            if self.folder is not None and name in results_page.figures_of_sweep(self.folder):
                return files.read_inside(self.folder, results_page.FIGURES, name, most=MOST_FIGURE_BYTES)
            if self.estimate is not None and name in results_page.figures_of_estimate(self.estimate):
                return files.read_inside(self.estimate, name, most=MOST_FIGURE_BYTES)
        return None

    def results(self, kind: str) -> dict[str, Any]:
        """Return the data of the folder of kind `sweep` or `estimate`. Raises UserError without one.

        Of kind `ticks` are the numbers of trials of the sweep that are localised by which ticks.
        """
        if kind == "sweep" and self.folder is not None:
            return results_page.of_sweep(self.folder)
        if kind == "ticks" and self.trials is not None:
            found: dict[str, Any] = self.trials.over_time()
            return found
        if kind == "estimate" and self.estimate is not None:
            return results_page.of_estimate(self.estimate)
        raise UserError(f"this server shows no {kind}")

    def require_compared(self) -> None:
        """Raise UserError unless two recordings are shown side by side."""
        if not self.compared:
            raise UserError("this server does not show two recordings side by side")

    def comparison(self) -> dict[str, Any]:
        """Return how the two recordings compare, as its value in JSON. Raises UserError."""
        self.require_compared()
        folders = [str(show.folder) for show in self.recorded]
        late = f"the recordings are not compared after {COMPARISON_S:g} s: use `tandem.open`"
        return {**self.work.result(compared, *folders, within=COMPARISON_S, late=late), "names": folders}

    def costs_of(self, show: WatchedRun) -> list[str]:
        """Return what the faults of a complete recording with a scenario have cost, as sentences."""
        scenario = show.scenario if isinstance(show, Recorded) and not show.live else None
        return costs(scenario, show.known, self.work) if scenario is not None else []

    def start(self) -> None:
        """Start listening on the network."""
        for listener in self.listeners:
            listener.start()

    @property
    def over(self) -> bool:
        """True once the server is stopping."""
        return self.work.over

    def stop(self) -> None:
        """Stop listening on the network, and delete the recordings of trials and of changed missions."""
        self.work.stop()
        for listener in self.listeners:
            listener.stop()
        if self.trials is not None:
            self.trials.close()
        self.changed.close()

    def poll(self) -> None:
        """Read new data, of each run a portion whose size is bounded."""
        for show in self.recorded:
            with suppress(OSError):
                show.poll()
        for listener in self.listeners:
            listener.poll()
        self.more = any(show.more for show in self.recorded) or any(one.more for one in self.listeners)

    def concluded(self) -> None:
        """Mark the recordings as complete, because their writers have ended."""
        for show in self.recorded:
            show.concluded()

    def listed(self) -> dict[str, Any]:
        """Return the list of runs for the page."""
        return {
            "sweep": self.folder is not None,
            "estimate": self.estimate is not None,
            "network": [{"endpoint": one.endpoint, "reached": one.reached} for one in self.listeners],
            "waiting": self.waiting,
            "shows": [
                {
                    "name": name,
                    "title": show.setup.name if show.setup is not None else name,
                    "robots": len(show.setup.robots) if show.setup is not None else 0,
                    "last": show.head,
                    "live": show.live,
                    "end": end_of(show.known.end),
                }
                for name, show in self.shows.items()
            ],
        }


def compared(one: str, other: str) -> dict[str, Any]:
    """Return how the recordings in two folders compare, as its value in JSON. Raises UserError."""
    try:
        return msgspec.structs.asdict(comparison(read(Path(one)), read(Path(other))))
    except (OSError, CorruptJournal) as error:
        raise UserError(f"the recordings cannot be compared: {error}") from None


def of_two(folders: Sequence[Path]) -> Site:
    """Return the content for two recordings side by side. Raises UserError if one of them is no recording."""
    shows: list[Recorded] = []
    for side, folder in zip(("left", "right"), folders, strict=True):
        found = of_folder(folder).recorded
        if not any(journals_in(folder)):
            raise UserError(f"{folder} is not one recording: side by side, each folder must be a recording")
        found[0].name = side
        shows += found
    return Site(shows, compared=True)


def of_folder(folder: Path) -> Site:
    """Return the content for a recording, a sweep, an estimate, or recordings in the subfolders of `folder`.

    Raises UserError if there is none of these.
    """
    try:
        if not folder.is_dir():
            raise UserError(f"{folder} is not a folder")
        if results_page.is_sweep(folder):
            results_page.of_sweep(folder)
            return Site(folder=folder)
        folders = [folder]
        if not any(journals_in(folder)):
            if results_page.is_estimate(folder):
                results_page.of_estimate(folder)
                return Site(estimate=folder)
            folders = sorted(one for one in folder.iterdir() if one.is_dir() and any(journals_in(one)))
        shows = [Recorded(one.resolve().name, one) for one in folders]
    except OSError as error:
        raise UserError(f"{folder} cannot be read: {error.strerror or error}") from None
    for show in shows:
        try:
            show.load()
        except OSError as error:
            show.live = False
            show.notes.append(f"{error.filename or show.folder} cannot be read: {error.strerror or error}")
    if not shows:
        raise UserError(
            f"{folder} contains no recording, no sweep, no estimate, and no folders with recordings"
        )
    if not any(show.live or show.setup is not None for show in shows):
        why = "; ".join(note for show in shows for note in show.notes) or "its journals are empty"
        raise UserError(f"the recordings in {folder} cannot be shown: {why}")
    return Site(shows)
