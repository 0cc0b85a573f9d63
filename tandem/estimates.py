"""The estimates of recorded robots, from their odometry and ranges."""

from __future__ import annotations

import html
from collections.abc import Sequence
from functools import cached_property
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec

from agent.estimation.following import ClaimRule
from compose.errors import UserError, no_such, writing
from compose.extras import need
from compose.launch.class_loader import GuardedSolver
from compose.recording.estimating.estimate_rows import EstimateSummary, PoseEstimateRow
from compose.recording.estimating.estimate_run import RecordingEstimate, estimated
from compose.recording.estimating.estimate_summary import write_estimate
from compose.recording.estimating.recorded_measurements import Measurements, measurements
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.run_ranges import ranges_of_run
from compose.recording.recording_files import make_folder, user_errors
from tandem.columns import Table, table_of
from tandem.results import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from agent.estimation.solver import Solver

DEFAULTS = ClaimRule()
"""The accuracy in m and the probability that a claim needs by default."""


class PoseEstimates(msgspec.Struct, frozen=True, dict=True, eq=False):
    """The estimated poses of recorded robots over time, as `tandem estimate` writes them.

    `tandem.estimate` returns one.
    """

    problem: Measurements
    """The measurements on which the estimate works; the type may change with any version."""
    result: RecordingEstimate
    """The estimate on which the command line works; likewise."""

    @property
    def summary(self) -> EstimateSummary:
        """The content of `estimate.json`: claims, last poses, hypotheses and learned errors."""
        return self.result.summary

    @property
    def robots(self) -> tuple[str, ...]:
        """The names of the robots."""
        return tuple(self.summary.robots)

    @cached_property
    def rows(self) -> Table:
        """The estimates, one row per time and robot: the columns of `estimate.csv`."""
        return table_of(PoseEstimateRow, self.result.rows)

    def figures(self) -> dict[str, Figure]:
        """Return the figures of `tandem estimate`, by name. Raises UserError without the extra `lab`."""
        need("matplotlib")
        from compose.figures.estimated import estimate_figures  # noqa: PLC0415  # optional
        from compose.figures.style import SCREEN, look  # noqa: PLC0415

        with look(SCREEN):
            return dict(estimate_figures(self.problem, self.result))

    def plot(self, kind: Literal["path", "over-time"] = "path") -> Figure:
        """Return one figure: the estimated and true paths from above, or errors and sigmas over time.

        Raises UserError like `figures`, and if there is none of this kind.
        """
        figures = {name.removeprefix("estimate-"): one for name, one in self.figures().items()}
        if kind not in figures:
            raise UserError(no_such(kind, figures, what="figure "))
        return figures[kind]

    def save(self, folder: str | Path) -> Path:
        """Write `estimate.csv` and `estimate.json` to `folder`, and return its path. Raises UserError."""
        out = Path(folder)
        make_folder(out)
        with writing(out):
            write_estimate(out, self.result.rows, self.summary)
        return out

    def __repr__(self) -> str:
        return f"<PoseEstimates {self._title}>"

    @property
    def _title(self) -> str:
        claims = [
            f"{name} makes no claim"
            if one.first_claim is None
            else f"{name} claims after {one.first_claim.t_s - self.summary.begin_s:.1f} s"
            + (" and withdraws it" if one.withdrawn_s is not None else "")
            for name, one in self.summary.robots.items()
        ]
        if self.summary.blocking_reason:
            claims.append(self.summary.blocking_reason)
        return f"{self.summary.source}: {', '.join(claims)}"

    def _repr_html_(self) -> str:
        """Return the claims and the first rows, as a notebook shows them."""
        return f"<p><b>{html.escape(self._title)}</b></p>{self.rows._repr_html_()}"


def estimate(
    recording: str | Path | Run,
    *,
    robots: Sequence[str] | None = None,
    noise: str | Path | None = None,
    window: tuple[float, float] | None = None,
    anchors: str | Path | None = None,
    relative: str | None = None,
    accuracy: float = DEFAULTS.accuracy,
    confidence: float = DEFAULTS.confidence,
    solver: Solver | None = None,
) -> PoseEstimates:
    """Return the poses of recorded robots over time, estimated from their odometry and ranges.

    `recording` is the path of a range recording (a .pyfg or .mcap file, a folder of CSV files, or a
    recording of Tandem), or a Run. `robots` are some of its robots, by default all; three or more are
    estimated in one fit. `noise` is the assumed noise: the name of a profile or the path of a TOML file, by
    default what the recording states. `window` is the part that is used, in s from the first odometry on.
    `anchors` is a CSV file of further anchors; all anchors are used. With `relative`, the name of a robot,
    poses are in the frame of its first pose, and no anchor has a position. A claim needs the standard
    deviation `accuracy` in m and the probability `confidence`. A `solver` of your own fits the poses, see
    `tandem.estimation`.

    Raises UserError for invalid arguments, and if the recording cannot be read.

    >>> import tandem
    >>> found = tandem.estimate(tandem.run("noisy"), accuracy=0.1)
    >>> found.robots
    ('a', 'b')
    >>> bool(found.rows["position_error_m"][-1] < 0.5)
    True
    """
    if not 0.0 < accuracy < inf:
        raise UserError(f"accuracy: {accuracy} is not a positive number")
    if not 0.5 <= confidence < 1.0:
        raise UserError(f"confidence: {confidence} is not a probability from 0.5 to below 1")
    if window is not None:
        try:
            begin, end = map(float, window)
        except (TypeError, ValueError):
            raise UserError(f"window: {window!r} is not the begin and the end of an interval in s") from None
        if not begin < end:
            raise UserError(f"window: {begin:g} s is not before {end:g} s")
        window = begin, end
    guarded = GuardedSolver(solver) if solver is not None else None
    if isinstance(recording, Run):
        if anchors is not None:
            raise UserError("anchors: a run has its own anchors")
        with user_errors(Path(str(recording.model.source))):
            ranges = ranges_of_run(recording.model)
    else:
        ranges = read_ranges(Path(recording), Path(anchors) if anchors is not None else None)
    name = str(noise) if noise is not None else None
    problem = measurements(ranges, robots, name, window, relative=relative)
    return PoseEstimates(problem, estimated(problem, ClaimRule(accuracy, confidence), solver=guarded))
