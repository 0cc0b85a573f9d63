"""A range recording that is made of rows, and the checks that they are one recording."""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import astuple

from compose.errors import BadRecording
from compose.recording.ranging.range_recording import (
    LONG_GAP_S,
    LONGEST_GAP_S,
    SAME_TIME_S,
    Jump,
    RangeRecording,
    RangeSeries,
    RecordedRobot,
    RobotOdometry,
    TruePath,
    locked,
)
from compose.recording.ranging.recording_rows import (
    AnchorRow,
    AntennaRow,
    AnyRow,
    OdometryRow,
    PoseRow,
    RangeRow,
    TruePoseRow,
    check_anchor,
)
from compose.recording.reasons import listed
from protocol.motion import Pose, heading_of, relative, wrap
from protocol.spelling import did_you_mean

Covariance6 = tuple[float, float, float, float, float, float]
"""The upper triangle of a covariance of (dx, dy, dheading), row by row."""
HEADINGS = {
    1.0: "in rad",
    math.radians(1.0): "as degrees: are they in degrees",
    -1.0: "clockwise: are they those of a compass, or are x and y exchanged",
    -math.radians(1.0): "as degrees, clockwise: are they those of a compass",
}
"""The kinds of headings, by the factor that makes them rad counter-clockwise; the first is what is needed."""
AGREEING = 0.9
"""The part of the way from which on it is along the headings. Those of another kind have less than half."""
FEWEST_COURSES = 8
"""The least number of increments by which headings are compared.

With two or three, another kind may agree by chance: at the beginning of a stream, a robot that turns on the
spot would be refused for the jitter of its poses.
"""
EXPLAINED = 3.0
"""The factor by which headings of another kind must be nearer to the way than a single direction is.

Headings taken as degrees hardly turn: a robot that drives straight, sideways, and spins agrees with them.
"""
UPPER = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""The place in a Covariance6 of each element of the matrix."""


class RecordingBuilder:
    """A range recording that is being read, row by row. Its errors are BadRecording and name the row."""

    def __init__(self, source: object, anchors: Iterable[AnchorRow] = ()) -> None:
        """Begin the recording in `source`. `anchors` replace those of the same names there."""
        self.source = str(source)
        self.unused: Counter[str] = Counter()
        """The number of entries that are not used, by kind."""
        self._odometry: dict[str, list[tuple[OdometryRow, Covariance6 | None]]] = {}
        self._jumps: dict[str, list[Jump]] = {}
        self._truth: dict[str, list[TimedPose]] = {}
        self._poses: dict[str, TimedPose] = {}
        self._courses: dict[str, tuple[float, list[complex]]] = {}
        """The way (m) of each robot with poses, and its sums along x and the headings as in HEADINGS."""
        self._given = {row.anchor: row for row in anchors}
        self._anchors: dict[str, AnchorRow] = {}
        self._antennas: dict[str, AntennaRow] = {}
        self._ranges: list[tuple[RangeRow, object]] = []
        self._last_range: dict[frozenset[str], float] = {}
        self._claims: dict[str, object] = {}
        """The robots that antennas and true poses name, with the first place of each."""

    @property
    def spans(self) -> dict[str, tuple[float, float]]:
        """The first and the last time in s of the odometry of each robot that has some."""
        return {name: (rows[0][0].t0, rows[-1][0].t1) for name, rows in self._odometry.items() if rows}

    def add(self, row: AnyRow, place: object) -> None:
        """Add the row at `place`. Raises BadRecording if it contradicts an earlier row."""
        match row:
            case OdometryRow():
                sigmas = (row.sigma_dx, row.sigma_dy, row.sigma_dheading)
                stated = [sigma for sigma in sigmas if sigma is not None]
                if len(stated) not in (0, 3):
                    raise BadRecording(
                        f"{place}: it needs all of sigma_dx, sigma_dy, sigma_dheading, or none"
                    )
                x, y, turn = [one**2 for one in stated or (0.0, 0.0, 0.0)]
                self.add_odometry(row, (x, 0.0, 0.0, y, 0.0, turn) if stated else None, place)
            case RangeRow():
                self._add_range(row, place)
            case AnchorRow():
                check_anchor(row, place)
                if self._anchors.setdefault(row.anchor, row) != row:
                    raise BadRecording(f"{place}: there are two anchors {row.anchor}")
            case AntennaRow():
                if self._antennas.setdefault(row.robot, row) != row:
                    raise BadRecording(f"{place}: there are two antennas of {row.robot}")
                self._claims.setdefault(row.robot, place)
            case TruePoseRow():
                path = self._truth.setdefault(row.robot, [])
                path.append(_after(path[-1] if path else None, row, "true pose", place))
                self._claims.setdefault(row.robot, place)
            case PoseRow():
                self._add_pose(row, place)

    def add_prior(self, row: AnchorRow) -> None:
        """Add an anchor in place of one of the same name, unless that was given from outside."""
        self._given.setdefault(row.anchor, row)

    def add_robot(self, robot: str) -> None:
        """Add a robot, which may have no odometry."""
        self._odometry.setdefault(robot, [])

    def add_odometry(self, row: OdometryRow, covariance: Covariance6 | None, place: object) -> None:
        """Add an increment with its covariance. Raises BadRecording if it overlaps the one before."""
        if row.t1 < row.t0:
            raise BadRecording(f"{place}: t1: {row.t1:.15g} s is before t0, {row.t0:.15g} s")
        path = self._odometry.setdefault(row.robot, [])
        if path and row.t0 < path[-1][0].t1 - SAME_TIME_S:
            end = f"the increment of {row.robot} before it ends at {path[-1][0].t1:.15g} s"
            raise BadRecording(f"{place}: t0: it starts at {row.t0:.15g} s, and {end}")
        self._add_jump(row, path[-1][0].t1 if path else row.t0, place)
        path.append((row, covariance))

    def forget(self, before_s: float) -> None:
        """Drop the measurements and true poses before `before_s`, but keep the last ones of each path."""
        for rows in self._odometry.values():
            rows[:-1] = [one for one in rows[:-1] if one[0].t1 > before_s]
        for path in self._truth.values():
            path[:-1] = [one for one in path[:-1] if one.t > before_s]
        for jumps in self._jumps.values():
            jumps[:] = [one for one in jumps if one.end_s > before_s]
        self._ranges = [one for one in self._ranges if one[0].t > before_s]

    def _add_pose(self, row: PoseRow, place: object) -> None:
        """Add the increment from the pose before to this one. The same pose again is none."""
        before = self._poses.get(row.robot)
        if before is None and row.robot in self._odometry:
            raise BadRecording(f"{place}: robot: {row.robot} has increments of odometry, too")
        pose = self._poses[row.robot] = _after(before, row, f"pose of {row.robot}", place)
        self.add_robot(row.robot)
        if before is not None and pose != before:
            self._add_course(row.robot, before.pose, pose.pose)
            dx, dy, turn = astuple(relative(before.pose, pose.pose))
            self.add_odometry(OdometryRow(row.robot, before.t, row.t, dx, dy, wrap(turn)), None, place)

    def _add_course(self, robot: str, start: Pose, end: Pose) -> None:
        """Add a way to the sums. Its direction relative to the heading is doubled: a robot may back up."""
        way, sums = complex(end.x - start.x, end.y - start.y), []
        for unit in (0.0, *HEADINGS):
            heading = unit * start.heading + wrap(unit * (end.heading - start.heading)) / 2.0
            along = way * cmath.exp(-1j * heading)
            sums.append(along**2 / abs(along) if along else 0j)
        length, before = self._courses.get(robot, (0.0, [0j] * (1 + len(HEADINGS))))
        self._courses[robot] = length + abs(way), [one + more for one, more in zip(before, sums, strict=True)]

    def _check_headings(self) -> None:
        """Raise BadRecording if the headings of a robot agree with its motion only in others of HEADINGS."""
        for robot, (length, (straight, radians, *others)) in self._courses.items():
            if len(self._odometry[robot]) < FEWEST_COURSES:
                continue
            most_off = (length - abs(straight)) / EXPLAINED
            for along, meaning in zip(others, [*HEADINGS.values()][1:], strict=True):
                agreeing = length - abs(along) < most_off and abs(along) > AGREEING * length
                if agreeing and AGREEING * length > 2.0 * abs(radians):
                    what = f"the headings of {robot} agree with its motion only {meaning}"
                    raise BadRecording(f"{self.source}: {what}? They have to be in rad, counter-clockwise")

    def _add_jump(self, row: OdometryRow, before: float, place: object) -> None:
        """Note an increment that lasts, or begins after the time `before` by, more than LONGEST_GAP_S."""
        late, lasts = row.t0 - before, row.t1 - row.t0
        if max(late, lasts) <= LONGEST_GAP_S:
            return
        what = f"{'t' if row.robot in self._poses else 't1'}: it lasts {lasts:.6g} s"
        begin, end = row.t0, row.t1
        if late > LONGEST_GAP_S:
            what = f"t0: it starts {late:.6g} s after the end of the increment of {row.robot} before it"
            begin, end = before, row.t0
        limit = f"an estimate bridges at most {LONGEST_GAP_S:g} s"
        what += f", and {limit}; was a clock set, or is it in ms or ns? --window chooses a part of a file"
        self._jumps.setdefault(row.robot, []).append(Jump(begin, end, f"{place}: {what}"))

    def _add_range(self, row: RangeRow, place: object) -> None:
        if row.first == row.second:
            raise BadRecording(f"{place}: it is a range from {row.first} to itself")
        pair = frozenset((row.first, row.second))
        last = self._last_range.get(pair)
        if last is not None and row.t < last:
            before = f"the range between {row.first} and {row.second} before it is of {last:.15g} s"
            raise BadRecording(f"{place}: t: it is of {row.t:.15g} s, and {before}")
        self._last_range[pair] = row.t
        self._ranges.append((row, place))

    def recording(self, *, whole: bool = True) -> RangeRecording:
        """Return the recording. Raises BadRecording if a name is unknown, or if there is no odometry.

        If it is not `whole`, rows with unknown names are left out: what makes them known may come later.
        """
        if not self._odometry:
            there = ", ".join([f"{what}: {count}" for what, count in self.unused.items()])
            hint = f", but {there}; a .toml file maps topics of ROS" if there else ""
            raise BadRecording(f"{self.source}: there is no odometry{hint}")
        for why in self.unknown().values() if whole else ():
            raise BadRecording(why)
        anchors = self._anchors | self._given
        for anchor in anchors:
            if anchor in self._odometry:
                raise BadRecording(f"{self.source}: {anchor} is a robot and an anchor")
        recording = RangeRecording(
            self.source,
            tuple(map(self._robot, self._odometry)),
            tuple([one.fixed for one in anchors.values()]),
            self._range_series([*self._odometry, *anchors]),
            dict(self.unused),
        )
        self._check_times(recording)
        self._check_headings()
        return recording

    def _check_times(self, recording: RangeRecording) -> None:
        """Raise BadRecording if stamps or ranges are missing, or stamps are not in s.

        Then, all ranges of a pair are 0, or they or all increments of a robot are of one time, or most
        increments that move it are so long that there is no estimate in them.
        """
        paths = [(f"increments of {one.id}", one.odometry.t0, one.odometry.t1) for one in recording.robots]
        for pair, rows in recording.pairs().items():
            t = recording.ranges.t[rows]
            if len(t) >= NOT_AT_ONCE and not np.any(recording.ranges.range[rows]):
                all_of_them = f"all {len(t)} ranges of {' and '.join(pair)} are 0 m"
                raise BadRecording(f"{self.source}: {all_of_them}: nothing was measured")
            paths.append((f"ranges of {' and '.join(pair)}", t, t))
        for what, begin, end in paths:
            if len(end) >= NOT_AT_ONCE and begin[-1] == end[0]:
                all_of_them = f"all {len(end)} {what} are of {end[0]:.15g} s"
                raise BadRecording(f"{self.source}: {all_of_them}: stamps are missing")
        for one in recording.robots:
            moves = np.any(one.odometry.increments, axis=1)
            lasts = float(np.median((one.odometry.t1 - one.odometry.t0)[moves])) if np.any(moves) else 0.0
            if len(moves) >= NOT_AT_ONCE and lasts > LONG_GAP_S:
                long = f"increments of {one.id} last {lasts:.6g} s in the median"
                limit = f"{LONG_GAP_S:g} s is the limit"
                raise BadRecording(
                    f"{self.source}: {long}, and {limit}: are times in ms or ns? They have to be in s"
                )

    def _robot(self, name: str) -> RecordedRobot:
        rows, truth, antenna = self._odometry[name], self._truth.get(name), self._antennas.get(name)
        stated = _table([one or UNSTATED_COVARIANCE for _, one in rows], 6)
        moved = _table([(row.t0, row.t1, row.dx, row.dy, row.dheading) for row, _ in rows], 5)
        true = _table([(t, *astuple(pose)) for t, pose in truth or ()], 4)
        t0, t1, increments = [locked(moved[:, part].copy()) for part in (0, 1, slice(2, 5))]
        path: Any = [locked(true[:, part].copy()) for part in (0, slice(1, 4))]
        return RecordedRobot(
            name,
            RobotOdometry(t0, t1, increments, locked(stated[:, UPPER])),
            TruePath(*path) if truth else None,
            (antenna.forward, antenna.left, antenna.height) if antenna is not None else (0.0, 0.0, 0.0),
            tuple(self._jumps.get(name, ())),
        )

    def unknown(self, before_s: float = math.inf) -> dict[str, str]:
        """Return the place of each unknown name, and what is wrong there.

        Ranges after `before_s` are not looked at.
        """
        robots, anchors = self._odometry, self._anchors | self._given
        found = {
            robot: f"{place}: robot: {robot} has no odometry"
            for robot, place in self._claims.items()
            if robot not in robots
        }
        there = f"robots: {listed([*robots])}; anchors: {listed([*anchors]) or 'none'}"
        for row, place in self._ranges:
            for name in (row.first, row.second):
                if name in robots or name in anchors or name in found or row.t >= before_s:
                    continue
                advice = did_you_mean(name, [*robots, *anchors])
                advice = advice or "; --anchors FILE adds some, without x and y if unknown"
                found[name] = (
                    f"{place}: {name} is neither a robot with odometry nor a known anchor; {there}{advice}"
                )
        return found

    def _range_series(self, names: Sequence[str]) -> RangeSeries:
        radios = {name: i for i, name in enumerate(names)}
        robots = len(self._odometry)
        used = [(row, place) for row, place in self._ranges if row.first in radios and row.second in radios]
        ends = np.array([(radios[row.first], radios[row.second]) for row, _ in used], np.intp).reshape(-1, 2)
        for row, place in [used[i] for i in np.flatnonzero(ends.min(axis=1) >= robots)[:1]]:
            raise BadRecording(f"{place}: {row.first} and {row.second} are both anchors")
        ends = np.where(ends[:, :1] >= robots, ends[:, ::-1], ends)
        lengths = [(row.t, row.range, np.nan if row.sigma is None else row.sigma) for row, _ in used]
        t, measured, sigma = _table(lengths, 3).T
        unsorted = RangeSeries(t, ends[:, 0], ends[:, 1], measured, sigma)
        return unsorted.rows(np.argsort(t, kind="stable"))


class TimedPose(NamedTuple):
    """A pose at the time `t` in s."""

    t: float
    pose: Pose


def _after(before: TimedPose | None, row: PoseRow, what: str, place: object) -> TimedPose:
    """Return the pose at `place`, which must not be earlier than that `before`. Raises BadRecording."""
    if before is not None and row.t < before.t:
        earlier = f"the {what} before it is of {before.t:.15g} s"
        raise BadRecording(f"{place}: t: it is of {row.t:.15g} s, and {earlier}")
    quaternion = [one for one in (row.qx, row.qy, row.qz, row.qw) if one is not None]
    if (row.heading is None, len(quaternion)) not in ((True, 4), (False, 0)):
        raise BadRecording(f"{place}: it needs heading, or all of qx, qy, qz, qw")
    try:
        heading = heading_of(*quaternion) if row.heading is None else row.heading
    except ValueError as error:
        raise BadRecording(f"{place}: qx, qy, qz, qw: {error}") from None
    return TimedPose(row.t, Pose(row.x, row.y, heading))


NOT_AT_ONCE = 8
"""The number of ranges of two radios, or of increments of a robot, that cannot all be of one time.

A driver may send a few in one message; an estimate needs eight.
"""

UNSTATED_COVARIANCE = (np.nan,) * 6


def _table(rows: list[Any], columns: int) -> Any:
    return np.array(rows, float).reshape(-1, columns)
