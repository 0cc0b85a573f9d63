"""`tandem estimate`: the poses of recorded robots, from their odometry and ranges."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from agent.estimation.following import ClaimRule
from agent.estimation.solver import Solver
from compose.errors import BROKEN_PIPE, ENDED, NOT_LOCALISED, STOPPED_STATUS, UserError, writing
from compose.extras import need
from compose.launch.class_loader import solver_named
from compose.recording.estimating.estimate_rows import (
    EstimateSummary,
    PoseEstimateRow,
    RobotEstimate,
    estimate_csv,
)
from compose.recording.estimating.estimate_run import RecordingEstimate, StreamEstimate, estimated
from compose.recording.estimating.estimate_summary import write_estimate
from compose.recording.estimating.noise_files import told_noise
from compose.recording.estimating.recorded_measurements import Measurements, measurements
from compose.recording.estimating.true_poses import TRUTH_GAP_S
from compose.recording.ranging.range_files import read_ranges
from compose.recording.ranging.range_recording import RecordedRobot
from compose.recording.reasons import listed
from compose.recording.recording_files import make_folder
from compose.terminal.outcome import counting
from compose.terminal.progress import unverified
from compose.terminal.tables import shown
from compose.terminal.text_width import tell
from compose.view.epochs import write_player
from protocol.output import discard, say

DEPTH_SIGMAS = 4.0
"""The sigmas by which the share of ranges that is a depth must differ from 0 to be told."""


def main(options: argparse.Namespace) -> int:
    """Estimate, print a table and write the files.

    Return NOT_LOCALISED if a robot may not claim its pose at the end; if a stream was ended by a signal
    STOPPED_STATUS, and BROKEN_PIPE if the reader of the output has gone.
    """
    stopped, unread = None, ""
    rule = ClaimRule(options.accuracy, options.confidence)
    solver = solver_named(options.solver) if options.solver is not None else None
    if options.follow:
        problem, estimate, stopped = _followed(options, rule, solver)
    else:
        if str(options.recording) == "-":
            raise UserError("-: standard input is read with --follow only")
        recording = read_ranges(options.recording, options.anchors)
        unread = ", ".join([f"{what}: {count}" for what, count in recording.unused.items()])
        problem = measurements(
            *(recording, options.robots, options.noise, options.window), relative=options.relative
        )
        if problem.doubt:
            raise UserError(f"{problem.source}: {problem.doubt}")
        if options.out is not None:
            make_folder(options.out)
        with counting("tandem estimate", len(problem.ends)) as done:
            estimate = estimated(problem, rule, done, solver)
    if options.out is not None:
        written = _written(options.out, problem, estimate)
        say(*map(str, written), error=options.follow)
    if not options.follow:
        tell(*_lines(problem, estimate), *[f"not used: {unread}"] * bool(unread))
    if stopped is not None:
        return stopped
    robots = estimate.summary.robots.values()
    localised = all(one.first_claim is not None and one.withdrawn_s is None for one in robots)
    return ENDED if localised else NOT_LOCALISED


def _followed(
    options: argparse.Namespace, rule: ClaimRule, solver: Solver | None
) -> tuple[Measurements, RecordingEstimate, int | None]:
    """Print the estimates of a stream until it ends; return all of them, and the status if it did not end."""
    need("mcap")
    from compose.recording.ranging.range_mcap import rows_as_they_arrive  # noqa: PLC0415  # optional

    if options.window is not None or options.anchors is not None:
        raise UserError("--follow: a stream has its own anchors, and no window")
    if options.relative is not None and options.robots is None:
        raise UserError(
            "--relative: with --follow, --robots has to name the robots: with each, a frame begins"
        )
    name = "standard input" if str(options.recording) == "-" else str(options.recording)
    noise = told_noise(options.noise) if options.noise is not None else None
    estimate = StreamEstimate(*(name, options.robots, noise, rule, _tell, solver, options.relative))
    try:
        stream = sys.stdin.buffer if str(options.recording) == "-" else options.recording.open("rb")
    except OSError as error:
        raise UserError(f"{name} cannot be read: {error.strerror or error}") from None
    if options.out is not None:
        make_folder(options.out)
    printed = 0
    with stream:
        try:
            for row in estimate.rows(rows_as_they_arrive(stream, name)):
                say(*estimate_csv([row]).splitlines()[printed:])
                printed = 1  # the line of column names
        except BrokenPipeError:  # the files are of the estimates so far
            discard(sys.stdout)
            return *estimate.result(), BROKEN_PIPE
        except KeyboardInterrupt:
            return *estimate.result(), STOPPED_STATUS
        except UserError as error:
            if options.out is None or not printed:
                raise
            _written(options.out, *estimate.result())
            raise UserError(f"{error}; the estimates before that are in {options.out}") from None
    return *estimate.result(), None


def _tell(what: str) -> None:
    say(f"tandem estimate: {what}", error=True)


def _written(out: Path, problem: Measurements, estimate: RecordingEstimate) -> list[Path]:
    """Write all files into `out`, figures if there is Matplotlib; return their paths. Raises UserError."""
    with writing(out):
        paths = write_estimate(out, estimate.rows, estimate.summary)
        paths.append(write_player(out, problem, estimate))
        if find_spec("matplotlib") is None:
            say("tandem estimate: no figures: they need matplotlib (extra lab)", error=True)
            return paths
        from compose.figures.estimated import estimate_figures  # noqa: PLC0415  # it takes time
        from compose.figures.style import SCREEN, look, save  # noqa: PLC0415

        with look(SCREEN):
            for name, figure in estimate_figures(problem, estimate):
                paths += save(figure, out / name, ["svg", "png"], SCREEN.dpi)
        return paths


def _lines(problem: Measurements, estimate: RecordingEstimate) -> list[str]:
    """Return the table of the estimates, what limits them, and last which claims do not hold at the end."""
    summary = estimate.summary
    rows = [_row(name, one, summary.begin_s) for name, one in summary.robots.items()]
    right = ("first claim s", "x, y, heading", "sigma m", "error m", "NEES")
    found = shown(("robot", "anchors"), right, rows)
    every = {1: next(iter(summary.robots)), 2: "both"}.get(len(summary.robots), "all")
    found.append(
        f"noise: {summary.noise}; last pose in m and rad; time from the first odometry of {every} on"
    )
    found += _depths(summary)
    if summary.relative_to is not None:
        found.append(f"poses are in the frame of that of {summary.relative_to} at the beginning")
    for name, anchor in summary.anchors.items():
        x, y = anchor.position
        found.append(f"anchor {name}: {x:.2f} {y:.2f}, with a sigma of {anchor.sigma:.2f} m")
    surveyed = {one.id: one.sigma < math.inf for one in problem.anchors}
    for name, why in summary.doubtful_anchors.items():
        what = "seems to stand elsewhere than surveyed" if surveyed[name] else "has a doubtful estimate"
        found.append(f"anchor {name} {what}: {why}")
    if summary.unverified_anchors:
        found.append(unverified([*summary.unverified_anchors], "estimate.json"))
    if summary.blocking_reason:
        found.append(f"no claim at the end: {summary.blocking_reason}")
    found.append(f"{sum(summary.ranges.values())} ranges used")
    for why, count in summary.unused_ranges.items():
        found.append(f"{count} {'range' if count == 1 else 'ranges'} not used: {why}")
    for robot in problem.robots:
        found += _about(robot.id, summary.robots[robot.id])
        rows_of_robot = [row for row in estimate.rows if row.robot == robot.id]
        found += _without_truth(robot.recorded, rows_of_robot, summary.relative_to)
    for name, one in summary.robots.items():
        if one.first_claim is not None and one.withdrawn_s is not None:
            after = f"{one.withdrawn_s - summary.begin_s:.1f}"
            found.append(f"{name}: the claim is withdrawn after {after} s, and the last pose is no claim")
    return found


def _depths(summary: EstimateSummary) -> Iterator[str]:
    """Yield a sentence about ranges that are depths."""
    depth = summary.calibration.range_depth if summary.calibration is not None else None
    if depth is not None and depth.value > DEPTH_SIGMAS * depth.sigma:
        share = f"a share of {depth.value:.2f} with a sigma of {depth.sigma:.2f}"
        yield f"the ranges are depths along the headings, as of a camera: {share}"


def _about(name: str, one: RobotEstimate) -> Iterator[str]:
    """Yield what was changed in the odometry of a robot."""
    changes = {
        "turned by 2 pi or more too far: whole turns were removed": one.whole_turns,
        "replaced: more than three times as fast as nearly all others": one.gross_increments,
    }
    for what, count in changes.items():
        if count:
            verb = "" if what.startswith("turned") else "were " if count > 1 else "was "
            yield f"{name}: {count} increment{'s' if count > 1 else ''} of odometry {verb}{what}"


def _without_truth(
    robot: RecordedRobot, rows: list[PoseEstimateRow], relative_to: str | None
) -> Iterator[str]:
    """Yield how many estimates of a robot with true poses have no error."""
    without = sum([row.true_x is None for row in rows])
    if robot.truth is not None and without:
        why = f"no true poses around them are within {TRUTH_GAP_S:g} s"
        if relative_to is not None and not len(robot.truth.t):
            why = f"the true pose of {relative_to} at the beginning is not known"
        yield f"{robot.id}: {without} of {len(rows)} estimates have no error: {why}"


def _row(name: str, one: RobotEstimate, begin_s: float) -> list[str]:

    first, last = one.first_claim, one.final
    if last is None:
        return [name, listed(one.anchors), *["-"] * 5]
    x, y, heading = last.pose
    sigma = (last.covariance[0][0] + last.covariance[1][1]) ** 0.5
    return [
        name,
        listed(one.anchors),
        "-" if first is None else f"{first.t_s - begin_s:.1f}",
        f"{x:.2f} {y:.2f} {heading:+.2f}",
        f"{sigma:.2f}",
        "-" if last.position_error_m is None else f"{last.position_error_m:.2f}",
        "-" if last.nees is None else f"{last.nees:.1f}",
    ]
