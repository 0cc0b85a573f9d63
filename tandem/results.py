"""A run of a mission with its data: what a recording holds, whether or not it has been written to files."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from compose.errors import UserError, writing
from compose.extras import need
from compose.figures import PICTURES
from compose.launch import model_loader
from compose.launch.class_loader import name_of, trust
from compose.recording import rows
from compose.recording import run as recorded
from compose.recording.frames import in_time
from compose.recording.group_localisation import MeetingResult, meeting_results
from compose.recording.reasons import reason_for
from compose.recording.recording_files import make_folder, user_errors
from compose.recording.summary_json import SUMMARY_JSON, Mode, leave, summary
from protocol import documents, files
from protocol.journal.journal_file import CorruptJournal, packed
from protocol.messages import Outcome
from protocol.spelling import did_you_mean
from tandem.columns import Table, table_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from compose.audit.findings import Findings
    from compose.figures.agent_replay import AgentReplay
    from compose.figures.pair import PairRecord
    from tandem.planning import Planner

_NUMBERS = ("position_error_m", "heading_error_rad", "reports_sent", "reports_heard")
"""The columns of `claims` that a notebook shows, after robot, localised and tick."""


class Run(msgspec.Struct, frozen=True, dict=True, eq=False):
    """The run of a mission: its outcome, and its data as tables of numpy arrays.

    `tandem.run` and `tandem.open` return one. A run in one process, a run as processes and a recording have
    the same data. In hardware mode there is no ground truth, so `truth` is empty and errors are NaN.

    >>> import tandem
    >>> run = tandem.run("paper-1")
    >>> run
    <Run paper-1, seed 1, paper: localised after 48 ticks>
    >>> run.robots
    ('a', 'b')
    >>> bool(run.claims["position_error_m"].max() < 1e-6)
    True
    """

    model: recorded.Run
    """The model of the run on which the command line works, with all messages as values; it may change with
    any version."""
    mode: Mode | None = None
    """`in-process` or `processes`; None if unknown."""
    wall_s: float | None = None
    """The wall time of the run in s; None if unknown."""

    def __post_init__(self) -> None:
        if not isinstance(self.model, recorded.Run):
            raise UserError(f"{self.model!r} is no run; open a recording with tandem.open")

    # --- the outcome ---

    @property
    def name(self) -> str:
        """The name of the scenario; in hardware mode, that of the run."""
        return self.model.setup.name if self.model.setup is not None else str(self.model.source)

    @property
    def seed(self) -> int | None:
        """The seed; None in hardware mode."""
        return self.model.setup.seed if self.model.setup is not None else None

    @property
    def robots(self) -> tuple[str, ...]:
        """The names of the robots."""
        return self.model.robots

    @property
    def outcome(self) -> Outcome:
        """The outcome: `localised`, `undecided`, `inconsistent`, `wrong` or `failed`."""
        return self.model.end.outcome if self.model.end is not None else "failed"

    @property
    def reason(self) -> str | None:
        """The reason for another outcome than `localised`."""
        return reason_for(self.model.end) if self.model.end is not None else "the recording breaks off"

    @property
    def ticks(self) -> int:
        """The number of elapsed ticks, which is the last tick: ticks are counted from 0."""
        return max(0, self.model.length - 1)

    @property
    def period_s(self) -> float:
        """The duration T_s of a tick in s of simulated time; NaN if no journal has it."""
        return self.model.setup.mission.period if self.model.setup is not None else float("nan")

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of `summary.json`. Raises UserError in hardware mode, where there is none."""
        with user_errors(Path(str(self.model.source))):
            return summary(self.model, self.mode, self.wall_s)

    # --- the data ---

    @cached_property
    def truth(self) -> Table:
        """The true poses, one row per tick and robot: the columns of `TruthRow`."""
        return table_of(rows.TruthRow, rows.truth_rows(self.model, self.period_s))

    @cached_property
    def observations(self) -> Table:
        """The measurements, one row per tick and robot: the columns of `ObservationRow`."""
        return table_of(rows.ObservationRow, rows.observation_rows(self.model, self.period_s))

    @cached_property
    def commands(self) -> Table:
        """The Commands, one row per tick and robot: the columns of `CommandRow`."""
        return table_of(rows.CommandRow, rows.command_rows(self.model, self.period_s))

    @cached_property
    def estimates(self) -> Table:
        """The estimates, one row per tick, robot and hypothesis: the columns of `EstimateRow`."""
        return table_of(rows.EstimateRow, rows.estimate_rows(self.model, self.period_s))

    @cached_property
    def messages(self) -> Table:
        """All journaled frames, by tick, with their content as JSON: the columns of `MessageRow`."""
        return table_of(rows.MessageRow, rows.message_rows(in_time(self.model)))

    @cached_property
    def claims(self) -> Table:
        """The result of each robot, one row per robot: the columns of `ClaimRow`."""
        return table_of(rows.ClaimRow, rows.claim_rows(self.model))

    @cached_property
    def meetings(self) -> Table:
        """The meetings of a group, by their bounds: the columns of `MeetingResult`; empty for pairs."""
        return table_of(MeetingResult, meeting_results(self.model))

    # --- what can be done with it ---

    def audit(self) -> Findings:
        """Return the findings of the audit, whose `violations` is empty if all is well.

        Raises UserError if the journal of a robot cannot be read.
        """
        from compose.audit.rules import audit_run  # noqa: PLC0415  # it imports the planners

        with user_errors(Path(str(self.model.source))):
            return audit_run(self.model)

    def figures(self, *kinds: str, paper: bool = False) -> dict[str, Figure]:
        """Return the figures of `tandem figures`, by name; of all kinds that apply if none is given.

        `paper` is for a paper: one or two columns wide, without titles. A figure for which the recording
        lacks a journal is omitted. Raises UserError without the extra `lab` and if there is no such kind.
        """
        need("matplotlib")
        for kind in kinds:
            if kind not in PICTURES:
                near = did_you_mean(kind, PICTURES)
                raise UserError(f"there is no figure '{kind}'; there are {', '.join(PICTURES)}{near}")
        from compose.figures import catalogue, style  # noqa: PLC0415  # optional
        from compose.figures.sheet import Absent  # noqa: PLC0415

        medium = style.PAPER if paper else style.SCREEN
        found: dict[str, Figure] = {}
        team = self.model.setup is not None and self.model.setup.team
        of_pairs = [partial(catalogue.pictures, pair) for pair in ([] if team else self._pairs)]
        for draw in [partial(catalogue.of_team, self.model)] if team else of_pairs:
            for kind in kinds or PICTURES:
                with style.look(medium):
                    drawn = draw(kind, medium)
                    found |= {name: figure for name, figure in drawn if not isinstance(figure, Absent)}
        return found

    def plot(self, kind: str = "trajectory") -> Figure:
        """Return the first figure of a kind, by default the paths from above.

        Raises UserError like `figures`, and if the run has none of this kind.
        """
        for figure in self.figures(kind).values():
            return figure
        raise UserError(f"{self._title}: there is no figure '{kind}' of it")

    def save(self, folder: str | Path) -> Path:
        """Write the recording to `folder`, as `tandem run --out` does, and return its path.

        Raises UserError if it contains a recording already, or cannot be written.
        """
        out = Path(folder)
        if any(out.glob("*.journal")):
            raise UserError(f"{out} already contains a recording; choose another folder")
        with user_errors(Path(str(self.model.source))):
            self.model.readable(*self.model.journals)
        make_folder(out)
        with writing(out):
            for name, journal in self.model.journals.items():
                files.write(out / name, packed(journal.frames))
            if self.model.world is not None:
                leave(self.model, self.summary, out)
        return out

    # --- display ---

    def __repr__(self) -> str:
        return f"<Run {self._title}>"

    @property
    def _title(self) -> str:
        known = [robot for robot in self.robots if robot in self.model.agents]
        return self.model.title(known) if self.model.world is not None or known else str(self.model.source)

    @cached_property
    def _pairs(self) -> list[PairRecord]:
        """The pairs with data, with the planner states of each robot whose journal can be read."""
        from compose.figures.pair import pairs_of  # noqa: PLC0415

        return list(pairs_of(self.model, self._replays(self.robots)))

    def _replays(self, robots: Iterable[str]) -> dict[str, AgentReplay]:
        from compose.figures.agent_replay import agent_replay  # noqa: PLC0415

        found = {}
        for robot in robots:
            try:
                found[robot] = agent_replay(self.model, robot)
            except (OSError, CorruptJournal):
                continue
        return found

    def _repr_html_(self) -> str:
        """Return the outcome and, if matplotlib is installed, the picture, as a notebook shows them."""
        shown = {name: self.claims[name] for name in ("robot", "localised", "tick", *_NUMBERS)}
        title = f"<p><b>{html.escape(self._title)}</b></p>"
        return f"{title}{Table(shown)._repr_html_()}{self._picture()}"

    def _picture(self) -> str:
        """Return the trajectories as HTML; empty without matplotlib."""
        try:
            figures: Sequence[Figure] = list(self.figures("trajectory").values())
        except UserError:
            return ""
        from compose.figures import style  # noqa: PLC0415  # optional

        images = []
        for figure in figures:
            image = io.BytesIO()
            with style.look(style.SCREEN):
                figure.savefig(image, format="svg")
            data = base64.b64encode(image.getvalue()).decode()
            images.append(f'<img src="data:image/svg+xml;base64,{data}">')
        return "".join(images)


def open_recording(
    folder: str | Path,
    *,
    planner: str | type[Planner[Any, Any]] | None = None,
    models: Iterable[str | type] = (),
) -> Run:
    """Return the run recorded in `folder`, written by `Run.save` or by the command `tandem`.

    A recording never loads code: `planner` names the planner of your own that `audit` and `figures` may run,
    and `models` the range and radio models that the world had.

    Raises UserError if there is no recording or it cannot be read.

    >>> import tandem, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     saved = tandem.run("paper-1").save(folder)
    ...     again = tandem.open(saved)
    >>> again
    <Run paper-1, seed 1, paper: localised after 48 ticks>
    >>> again.audit().violations
    ()
    """
    if planner is not None:
        trust(planner if isinstance(planner, str) else name_of(planner))
    for one in models:
        model_loader.trust(one if isinstance(one, str) else name_of(one))
    path = Path(folder)
    with user_errors(path):
        model = recorded.read(path)
    try:
        known = documents.json_file(path / SUMMARY_JSON, _Launch)
    except (OSError, ValueError):  # a recording may be without it
        known = _Launch()
    return Run(model, known.mode, known.wall_s)


class _Launch(msgspec.Struct, frozen=True):
    """The fields of `summary.json` that are not in the journals."""

    mode: Mode | None = None
    wall_s: float | None = None
