"""The reports of a peer, checked against its earlier ones, its limits and its own measurements.

The mutual ranges are evaluated elsewhere: by the estimator (`Estimator.pair`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from msgspec.structs import replace

from agent.estimation.gaussian.odometry_noise import STRAY_DISTANCE, STRAY_TURN
from agent.peer.motion_log import MotionLog
from agent.peer.peer_state import PeerState, with_report
from agent.planning.state import RobotState
from agent.planning.tasks import Orbiting
from protocol.messages import Inconsistent, Report, RobotConfig, Undecided
from protocol.mission import Mission
from protocol.motion import Pose, wrap
from protocol.orbits import Orbit, Rendezvous

OrbitsOfPair = Callable[[Mission, float], Rendezvous]
"""The type of `Planner.rendezvous`."""

SPEED_SLACK = 1e-9
"""The relative tolerance of v_max and omega_max for rounding."""

NOISY = 6.0
"""The largest plausible noise of actuation and odometry, in standard deviations."""


def with_reports(state: RobotState, reports: Sequence[Report], orbits: OrbitsOfPair) -> RobotState:
    """Return `state` with the data of `reports`, and with a verdict if a report gives reason for one.

    The verdict is Inconsistent if a report is implausible, and Undecided if the peer has given up. `orbits`
    is `Planner.rendezvous` of both robots.
    """
    for received in reports:
        before, state = state, replace(state, peer_state=with_report(state.peer_state, received))
        if state.verdict is None:
            tolerance = state.estimator.report_tolerance
            found = objection(before.peer_state, state.peer_state, received, state.config, tolerance, orbits)
            if found is not None:
                return state.ended(found)
    if state.verdict is None:
        match state.peer_state.verdict:
            case Undecided(reason):
                return state.undecided(f"{state.config.peer} reports: {reason}")
            case Inconsistent(contradiction):
                return state.undecided(f"{state.config.peer} found a contradiction: {contradiction}")
    return state


def objection(
    before: PeerState,
    after: PeerState,
    report: Report,
    config: RobotConfig,
    tolerance: float,
    orbits: OrbitsOfPair,
) -> Inconsistent | None:
    """Return the first contradiction in `report`, which changed the peer's state from `before` to `after`.

    `tolerance` is `Estimator.report_tolerance`. If it is infinite, what noise may explain is not checked.
    `orbits` is `Planner.rendezvous`. The result is None if the report is plausible.
    """
    without_noise = math.isfinite(tolerance)
    return (
        _changed_log(before, report)
        or (_changed_start(before, report) if without_noise else None)
        or _exceeded_limit(report, config.mission)
        or (_ranges_off_path(before, after, config.mission, tolerance) if without_noise else None)
        or (_off_orbit(after, report, config, tolerance, orbits) if without_noise else None)
    )


def _changed_log(before: PeerState, report: Report) -> Inconsistent | None:
    """Return a contradiction if the report differs from an earlier report about the same ticks."""
    last = min(report.through, before.peer.through)
    if report.since < last:
        reported = MotionLog(report.through - report.since, report.runs)
        if reported.between(0, last - report.since) != before.peer.between(report.since, last):
            return Inconsistent(f"manoeuvres over [{report.since}, {last}] that contradict an earlier report")
    earlier = before.peer.ranges[report.ranges_since :][: len(report.ranges)]
    if earlier != report.ranges[: len(earlier)]:
        return Inconsistent("ranges to its anchor that contradict an earlier report")
    return None


def _changed_start(before: PeerState, report: Report) -> Inconsistent | None:
    """Return a contradiction if the report has another start than an earlier report."""
    if before.start is not None and report.start not in (None, before.start):
        return Inconsistent("a start that contradicts an earlier report")
    return None


def _exceeded_limit(report: Report, mission: Mission) -> Inconsistent | None:
    """Return a contradiction if a speed exceeds v_max or a turn rate exceeds omega_max."""
    noise = mission.noise
    scale = noise.priors.wheel_scale
    of_v, of_omega = (STRAY_DISTANCE, STRAY_TURN / mission.period) if noise.odometry_strays else (0.0, 0.0)
    speed = _largest_measurement(
        mission.max_speed, (noise.actuation.v, noise.odometry.v, scale, of_v), noise.standstill_bound[0]
    )
    rate = _largest_measurement(
        mission.max_turn_rate,
        (noise.actuation.omega, noise.odometry.omega, scale),
        math.hypot(noise.standstill_bound[1], NOISY * noise.priors.gyro_bias, NOISY * of_omega),
    )
    for run in report.runs:
        v, omega = abs(run.v), abs(run.omega)
        if v > speed:
            return Inconsistent(f"v = {v:.6g}, limit {speed:.6g}", v - speed)
        if omega > rate:
            return Inconsistent(f"omega = {omega:.6g}, limit {rate:.6g}", omega - rate)
    return None


def _largest_measurement(limit: float, relative: tuple[float, ...], floor: float) -> float:
    """Return the largest plausible measurement of a speed of at most `limit`.

    `relative` are the sigmas of the actuation, of the odometry, of its scale and of strays, as fractions of
    the speed.
    """
    return limit * (1.0 + SPEED_SLACK + NOISY * math.hypot(*relative)) + floor


def _ranges_off_path(
    before: PeerState, after: PeerState, mission: Mission, tolerance: float
) -> Inconsistent | None:
    """Return a contradiction if a range to the peer's anchor does not agree with the reported path.

    Only ranges that could not be checked before are checked.
    """
    log, start = after.peer, after.start
    if start is None:
        return None
    for index, ranged in enumerate(log.ranges):
        checked = index < len(before.peer.ranges) and ranged.tick <= before.peer.through
        if ranged.tick > log.through or (checked and before.start is not None):
            continue
        pose = log.pose(start, ranged.tick, mission.period)
        residual = abs(math.hypot(pose.x, pose.y) - ranged.range)
        if residual > tolerance * max(1.0, ranged.range):
            return Inconsistent(
                f"a range to its anchor at tick {ranged.tick} that contradicts its path", residual
            )
    return None


def _off_orbit(
    after: PeerState, report: Report, config: RobotConfig, tolerance: float, orbits: OrbitsOfPair
) -> Inconsistent | None:
    """Return a contradiction if an orbiting peer is off its orbit, or does not head along it.

    In a group, a robot that this one visits may still be on the orbit of their first meeting, or of a retry,
    in either role.
    """
    if report.state != Orbiting.name or after.start is None or after.peer.through != report.tick:
        return None
    pose = after.peer.pose(after.start, report.tick, config.mission.period)
    present = config.rendezvous.b if config.role == "a" else config.rendezvous.a
    found = _off(present, pose, report.tick, tolerance)
    if found is None or not config.members:
        return found
    earlier = orbits(config.mission, config.anchor_distance)
    is_off = [_off(orbit, pose, report.tick, tolerance) for orbit in (earlier.a, earlier.b)]
    return found if all(is_off) else None


def _off(orbit: Orbit, pose: Pose, tick: int, tolerance: float) -> Inconsistent | None:
    """Return a contradiction if `pose` is off `orbit`, or does not head along it."""
    residual = abs(math.hypot(pose.x, pose.y) - orbit.radius)
    if residual > tolerance * max(1.0, orbit.radius):
        return Inconsistent(f"a position off its orbit at tick {tick}", residual)
    tangent = math.copysign(0.5 * math.pi, orbit.omega)
    heading_residual = abs(wrap(pose.heading - math.atan2(pose.y, pose.x) - tangent))
    if orbit.v != 0.0 and heading_residual > tolerance:
        return Inconsistent(f"a heading off the tangent of its orbit at tick {tick}", heading_residual)
    return None
