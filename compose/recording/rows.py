"""The tables of a run: a type for the rows of each, whose fields are the columns, and the rows.

`ticks.csv`, `ticks.parquet`, `frames.csv` and the tables of the Python API are made of them. Poses are in the
world frame unless stated.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgspec
from msgspec.structs import astuple

from compose.recording import run as recorded
from compose.recording.claim_errors import Claim, nees
from compose.recording.frames import Journaled, verdict_name
from protocol.messages import Estimate
from protocol.motion import Pose, wrap
from world.referee import errors


class TickRow(msgspec.Struct, frozen=True):
    """One row of `ticks.csv`: one robot in one tick. None is an empty field of the file."""

    tick: int
    """The tick k."""
    robot: str
    """The robot's name."""
    x: float | None
    """True x in m; None in hardware mode."""
    y: float | None
    """True y in m; None in hardware mode."""
    heading: float | None
    """True heading in rad, in (-pi, pi]; None in hardware mode."""
    v: float | None
    """Speed in m/s executed until the next tick, measured in hardware mode; None in the last tick."""
    omega: float | None
    """Turn rate in rad/s, like `v`."""
    anchor_range: float | None
    """Measured range to the anchor in m; in a team, to the nearest anchor."""
    mutual_range: float | None
    """Measured range to the peer in m; in a group or a team, to the nearest robot."""
    phase: int | None
    """Phase of the Command; None if the Command was late."""
    state: str | None
    """Planner state of the Command; None if the Command was late."""


class RobotTick(msgspec.Struct, frozen=True):
    """The first columns of a row about one robot in one tick."""

    tick: int
    """The tick k."""
    time_s: float
    """The simulated time k T_s in s."""
    robot: str
    """The robot's name."""


class TruthRow(RobotTick, frozen=True):
    """The true pose of one robot in one tick."""

    x: float
    """True x in m."""
    y: float
    """True y in m."""
    heading: float
    """True heading in rad, in (-pi, pi]."""


class ObservationRow(RobotTick, frozen=True):
    """The measurements of one robot in one tick."""

    v: float | None
    """The odometry over the tick before: speed in m/s; missing in tick 0."""
    omega: float | None
    """The odometry over the tick before: turn rate in rad/s; missing in tick 0."""
    anchor_range: float | None
    """The range to the robot's anchor in m, in a team to the nearest anchor; missing without one."""
    contact: bool
    """True if the peer is within sensing range."""
    mutual_range: float | None
    """The range to the peer in m; missing without one."""


class CommandRow(RobotTick, frozen=True):
    """The Command of one robot in one tick. A Command that was late has no row."""

    v: float
    """The commanded speed in m/s until the next tick."""
    omega: float
    """The commanded turn rate in rad/s until the next tick."""
    phase: int
    """The paper's phase, 1 to 3."""
    state: str
    """The state of the planner."""
    verdict: str | None
    """The final result: `localised`, `undecided` or `inconsistent`; missing until there is one."""


class EstimateRow(RobotTick, frozen=True):
    """One hypothesis about the pose of one robot in one tick; a tick has as many rows as hypotheses."""

    frame: str
    """The frame of the pose: `world`, or `local`, the anchor frame, while its direction is unknown."""
    hypothesis: int
    """The number of the hypothesis, from 0; with probabilities, the most probable first."""
    localised: bool
    """True if the robot claims its pose."""
    x: float
    """Estimated x in m."""
    y: float
    """Estimated y in m."""
    heading: float
    """Estimated heading in rad, in (-pi, pi]."""
    probability: float | None
    """The probability of the hypothesis; missing with exact sensors."""
    position_sigma_m: float | None
    """The square root of the trace of the position covariance in m, of hypothesis 0 under noise."""
    heading_sigma_rad: float | None
    """The standard deviation of the heading in rad, likewise."""
    position_error_m: float | None
    """The distance from the true position in m; missing in the local frame and without ground truth."""
    heading_error_rad: float | None
    """The absolute error of the heading in rad, likewise."""
    nees: float | None
    """The normalised estimation error squared, of hypothesis 0 under noise, likewise."""


class MessageRow(msgspec.Struct, frozen=True):
    """One journaled frame."""

    journal: str
    """The file name of the journal."""
    place: int
    """The number of frames before it in the journal."""
    tick: int
    """The tick in which it was journaled."""
    kind: str
    """The kind of message, such as `report`."""
    bytes: int
    """The size of the frame in bytes."""
    message: str
    """The message as JSON."""


class ClaimRow(msgspec.Struct, frozen=True):
    """The result of one robot."""

    robot: str
    """The robot's name."""
    localised: bool
    """True if the robot claimed its pose."""
    tick: int | None
    """The tick of the claim; all columns from here to `nees` are missing without a claim."""
    x: float | None
    """Claimed x in m."""
    y: float | None
    """Claimed y in m."""
    heading: float | None
    """Claimed heading in rad, in (-pi, pi]."""
    position_error_m: float | None
    """The distance from the true position in m."""
    heading_error_rad: float | None
    """The absolute error of the heading in rad."""
    position_sigma_m: float | None
    """The claimed standard deviation of the position in m; missing with exact sensors."""
    heading_sigma_rad: float | None
    """The claimed standard deviation of the heading in rad; missing with exact sensors."""
    nees: float | None
    """The normalised estimation error squared; missing with exact sensors."""
    anchor_ranges: int | None
    """The number of ranges to anchors; this and all below are missing if the robot sent no FinalReport."""
    mutual_ranges: int | None
    """The number of ranges to the peer, or to all robots."""
    reports_sent: int | None
    """The number of reports sent."""
    reports_heard: int | None
    """The number of reports received and used."""
    bytes_sent: int | None
    """The size of all reports sent in bytes."""


def tick_rows(run: recorded.Run) -> Iterator[TickRow]:
    """Yield one row per tick and robot, from tick 0. A robot whose journal ends earlier has no later rows."""
    truths = {robot: run.truth(robot) for robot in run.robots}
    for tick in range(run.length):
        for robot, observation in run.observations[tick].items():
            pose = truths[robot][tick] if truths[robot] else None
            contact, command = run.contact(robot, tick), run.command(robot, tick)
            values: list[Any] = [
                tick,
                robot,
                *parts(pose, "x", "y"),
                wrap(pose.heading) if pose is not None else None,
            ]
            values += [*parts(run.driven(robot, tick), "v", "omega"), observation.nearest_anchor_range]
            values += [*parts(contact, "range"), *parts(command, "phase", "task")]
            yield TickRow(*values)


def parts(value: object | None, *names: str) -> list[Any]:
    """Return the attributes `names` of `value`; None for each if there is none."""
    return [getattr(value, name) if value is not None else None for name in names]


def truth_rows(run: recorded.Run, period: float) -> Iterator[TruthRow]:
    """Yield the true poses by tick; `period` is T_s in s. There are none in hardware mode."""
    paths = {robot: run.truth(robot) for robot in run.robots}
    for tick in range(run.length if run.world is not None else 0):
        for robot, path in paths.items():
            pose = path[tick]
            yield TruthRow(tick, tick * period, robot, pose.x, pose.y, wrap(pose.heading))


def observation_rows(run: recorded.Run, period: float) -> Iterator[ObservationRow]:
    """Yield the measurements by tick; `period` is T_s in s."""
    for tick, observations in enumerate(run.observations[: run.length]):
        for robot, one in observations.items():
            contact = recorded.nearest_contact(one.contacts)
            values: list[Any] = [
                tick,
                tick * period,
                robot,
                *parts(one.executed, "v", "omega"),
                one.nearest_anchor_range,
            ]
            values += [contact is not None, *parts(contact, "range")]
            yield ObservationRow(*values)


def command_rows(run: recorded.Run, period: float) -> Iterator[CommandRow]:
    """Yield the Commands by tick; `period` is T_s in s."""
    for tick in range(run.length):
        for robot in run.robots:
            one = run.command(robot, tick)
            if one is not None:
                yield CommandRow(
                    tick, tick * period, robot, one.v, one.omega, one.phase, one.task, verdict_name(one)
                )


def estimate_rows(run: recorded.Run, period: float) -> Iterator[EstimateRow]:
    """Yield the estimates in the agents' journals by tick; `period` is T_s in s."""
    paths = {robot: run.truth(robot) for robot in run.agents}
    found = [one for agent in run.agents.values() for one in agent.estimates]
    for one in sorted(found, key=lambda one: one.tick):
        path = paths[one.robot]
        yield from hypotheses(one, path[one.tick] if one.tick < len(path) else None, period)


def hypotheses(one: Estimate, truth: Pose | None, period: float) -> Iterator[EstimateRow]:
    """Yield the hypotheses of an estimate; `truth` is the true pose in its tick, if it is known."""
    for place, pose in enumerate(one.world or one.local):
        covariance = one.covariance if one.world and not place else None
        position, heading = errors(pose, truth) if one.world and truth is not None else (None, None)
        values: list[Any] = [one.tick, one.tick * period, one.robot, "world" if one.world else "local", place]
        values += [one.localised, pose.x, pose.y, wrap(pose.heading)]
        values += [one.probabilities[place] if one.probabilities else None]
        squared = nees(pose, truth, covariance) if covariance is not None and truth is not None else None
        values += [*parts(covariance, "position_sigma", "heading_sigma"), position, heading, squared]
        yield EstimateRow(*values)


def message_rows(
    frames: Iterable[Journaled], check: Callable[[], object] = lambda: None
) -> Iterator[MessageRow]:
    """Yield the rows of journaled frames. Calls `check` before each, which may raise."""
    for one in frames:
        check()
        yield MessageRow(one.journal, one.place, one.tick, one.kind, len(one.frame), one.json)


def claim_rows(run: recorded.Run) -> Iterator[ClaimRow]:
    """Yield the result of each robot."""
    for robot in run.robots:
        claim = _claim(run, robot)
        pose, covariance = parts(claim, "pose", "covariance")
        values: list[Any] = [robot, claim is not None, *parts(claim, "tick"), *parts(pose, "x", "y")]
        values += [wrap(pose.heading) if pose is not None else None]
        values += parts(claim, "position_error", "heading_error")
        values += [*parts(covariance, "position_sigma", "heading_sigma"), *parts(claim, "nees")]
        values += parts(run.final_reports.get(robot), *ClaimRow.__struct_fields__[-5:])
        yield ClaimRow(*values)


def _claim(run: recorded.Run, robot: str) -> Claim | None:
    """Return the standing claim of `robot`; in hardware mode, its errors are NaN."""
    if (
        run.world is not None
        or robot not in run.agents
        or (found := run.agents[robot].standing_claim) is None
    ):
        return run.claim(robot)
    tick, verdict = found
    return Claim(tick, verdict.pose, verdict.covariance, math.nan, math.nan, None)


def ticks_csv(run: recorded.Run) -> str:
    """Return the text of `ticks.csv`."""
    return csv_text(TickRow, tick_rows(run))


def csv_text(kind: type[msgspec.Struct], rows: Iterable[msgspec.Struct]) -> str:
    """Return `rows`, of type `kind`, as a CSV table; floats are in their shortest exact form."""
    values = ([str(one).lower() if isinstance(one, bool) else one for one in astuple(row)] for row in rows)
    return csv_table(kind.__struct_fields__, values)


def csv_table(names: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return `rows` as a CSV table whose columns have these `names`."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([names, *rows])
    return out.getvalue()
