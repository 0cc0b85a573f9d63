"""Whether what a peer tells can be so: against what it told before, what it can drive, and what it measured.

What the mutual ranges say of it is weighed where they are: `meeting`, and under noise `survey`.
"""

from __future__ import annotations

import math

from agent.peer.motion_log import MotionLog
from agent.peer.peer_state import PeerState
from agent.planning.phase2_orbit import Orbiting
from agent.planning.state import MODE_NAMES
from protocol.messages import Inconsistent, Report, RobotConfig
from protocol.mission import Mission
from protocol.motion import wrap

SLACK = 1e-9
"""of v_max and omega_max: rounding"""

NOISY = 6.0
"""standard deviations: more than this is no noise of wheels or odometry"""

EXACT = 1e-6
"""m and rad: where sensors are exact, what is told of one tick agrees so far"""


def objection(
    before: PeerState, after: PeerState, report: Report, config: RobotConfig
) -> Inconsistent | None:
    """What in `report` cannot be so, which led from `before` to `after`; None if all of it may be."""
    return (
        _second_story(before, report, config.mission)
        or _impossible_drive(report, config.mission)
        or (_ranges_off_path(before, after, config.mission) if config.mission.noise.exact else None)
        or (_off_orbit(after, report, config) if config.mission.noise.exact else None)
    )


def _second_story(before: PeerState, report: Report, mission: Mission) -> Inconsistent | None:
    """What was told once is told the same ever after."""
    last = min(report.through, before.peer.through)
    if report.since < last:
        told = MotionLog(report.through - report.since, report.runs)
        if told.between(0, last - report.since) != before.peer.between(report.since, last):
            return Inconsistent(f"manoeuvres over [{report.since}, {last}] that it told otherwise before")
    known = before.peer.ranges[report.ranges_since :][: len(report.ranges)]
    if known != report.ranges[: len(known)]:
        return Inconsistent("ranges to its anchor that it told otherwise before")
    if mission.noise.exact and before.start is not None and report.start not in (None, before.start):
        return Inconsistent("a start that it told otherwise before")
    return None


def _impossible_drive(report: Report, mission: Mission) -> Inconsistent | None:
    """Nobody drives faster than v_max, or turns faster than omega_max."""
    noise = mission.noise
    speed = _most(mission.max_speed, noise.actuation.v, noise.odometry.v, noise.standstill_bound[0])
    rate = _most(
        mission.max_turn_rate, noise.actuation.omega, noise.odometry.omega, noise.standstill_bound[1]
    )
    for run in report.runs:
        for what, value, most in (("v", abs(run.v), speed), ("omega", abs(run.omega), rate)):
            if value > most:
                return Inconsistent(f"{what} = {value:.6g}, of {most:.6g} at the most", value - most)
    return None


def _most(asked: float, by_wheels: float, by_odometry: float, floor: float) -> float:
    """What is hardly ever measured to be more, where `asked` is the most that is asked for."""
    return asked * (1.0 + SLACK + NOISY * math.hypot(by_wheels, by_odometry)) + floor


def _ranges_off_path(before: PeerState, after: PeerState, mission: Mission) -> Inconsistent | None:
    """Its ranges to its anchor are those of the path that it tells; those that are news are looked at."""
    book, start = after.peer, after.start
    if start is None:
        return None
    for place, ranged in enumerate(book.ranges):
        seen = place < len(before.peer.ranges) and ranged.tick <= before.peer.through
        if ranged.tick > book.through or (seen and before.start is not None):
            continue
        pose = book.pose(start, ranged.tick, mission.period)
        off = abs(math.hypot(pose.x, pose.y) - ranged.range)
        if off > EXACT * max(1.0, ranged.range):
            return Inconsistent(
                f"a range to its anchor at tick {ranged.tick} that is not of the path it tells", off
            )
    return None


def _off_orbit(after: PeerState, report: Report, config: RobotConfig) -> Inconsistent | None:
    """Who orbits is on its circle, and heads along it."""
    plan = config.rendezvous
    orbit = plan.b if config.role == "a" else plan.a
    if report.state != MODE_NAMES[Orbiting] or after.start is None or after.peer.through != report.tick:
        return None
    pose = after.peer.pose(after.start, report.tick, config.mission.period)
    off = abs(math.hypot(pose.x, pose.y) - orbit.radius)
    if off > EXACT * max(1.0, orbit.radius):
        return Inconsistent(f"a place off the orbit that it is on at tick {report.tick}", off)
    along = math.copysign(0.5 * math.pi, orbit.omega)
    askew = abs(wrap(pose.heading - math.atan2(pose.y, pose.x) - along))
    if orbit.v != 0.0 and askew > EXACT:
        return Inconsistent(f"a heading that is none of the orbit that it is on at tick {report.tick}", askew)
    return None
