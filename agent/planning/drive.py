"""The controls of each task, and the command: how the robot drives in the next tick."""

from __future__ import annotations

import math

from agent.planning import tasks
from agent.planning.separation import leeway, leeway_of_each, slowed
from agent.planning.state import RobotState
from agent.planning.tasks import Beacon
from protocol.coverage_strips import Place
from protocol.coverage_ticks import coverage_speed
from protocol.messages import Command
from protocol.mission import Mission
from protocol.motion import REST, TAU, Controls, Pose, relative, travelled, wrap
from protocol.orbits import Orbit

ASIDE = 1e-9
"""The distance from a place at which a straight to it may end beside it, as a fraction of A_0."""

OFF_CIRCLE = 0.1
"""How far a robot may be off its circle, as a fraction of A_0, and turned from its tangent, in rad.

A robot that is farther off was held back by another one (see `separation`), and returns to the circle.
"""

LOOKAHEAD = 1.5
"""The distance of the pursued point ahead on the orbit, in ticks of the orbit's speed.

With more, a robot joins its orbit later; with 1, it turns to and fro about it.
"""


def controls(state: RobotState) -> Controls:
    """Return the controls of the current task, or of a way aside (see `travelling`)."""
    task, odometry, mission = state.task, state.odometry, state.config.mission
    match task:
        case _ if state.passing.places and tasks.drives_aside(task):
            return way_to(state, state.passing.places[0], backward=True) or REST
        case tasks.Orbiting():
            return task.command or state.config.orbit.controls
        case tasks.Aligning(heading) | tasks.Tangent(heading):
            return turn(odometry, heading, mission)
        case tasks.Radial():
            return straight(left_to_orbit(state), mission)
        case tasks.Searching():
            return _seeking(state, task)
        case tasks.ThirdPoint():
            return left_of(task, odometry, mission)
        case tasks.LastManoeuvre() | tasks.Returning() | tasks.Surveying() | tasks.Retreating():
            return task.command
        case tasks.Homing(place) | tasks.Travelling(place):
            return way_to(state, place, backward=isinstance(task, tasks.Homing)) or REST
        case tasks.Covering((place, *_)) | tasks.Looping((place, *_)):
            way = way_to(state, place) or REST
            return Controls(min(way.v, coverage_speed(mission)), way.omega)
        case _:
            return REST


def command(state: RobotState, controls: Controls) -> Command:
    """Return the command with `controls`, limited by the safety distance, the task and the verdict."""
    config = state.config
    if state.in_contact and config.mission.safety_distance:
        controls = _safe(state, controls)
    return Command(
        state.tick,
        config.robot,
        controls.v,
        controls.omega,
        state.phase,
        state.task.name,
        state.verdict,
        config.peer,
        config.role,
        rests=state.verdict is not None,
    )


def _safe(state: RobotState, controls: Controls) -> Controls:
    """Return `controls` for the next tick, limited so that the safety distance is kept.

    The peer is in contact. The limit applies while the robot does not plan with the peer's position: before
    phase 3, and on the way back into range.
    """
    mission = state.config.mission
    if state.phase == 3 and not isinstance(state.task, tasks.Retreating):
        return controls
    if not state.mutual or state.mutual[-1].tick != state.tick:  # the range was not measured
        return REST
    aside = bool(state.passing.places) and tasks.drives_aside(state.task)
    return slowed(controls, leeway_of_each(state.mutual[-1].range, mission, aside=aside), mission)


def _seeking(state: RobotState, task: tasks.Searching) -> Controls:
    """Return the controls of the search for a second range to a beacon."""
    odometry, mission, origin = state.odometry, state.config.mission, task.origin
    step = step_length(task.beacon, task.rho0, mission)
    match task:
        case tasks.Straight():
            return straight(step - travelled(origin, odometry), mission)
        case tasks.Backing():
            return straight(-step - relative(origin, odometry).x, mission)
        case tasks.Turning(heading=heading):
            return turn(odometry, heading, mission)
        case _:
            return _on_circle(state, task, step)


def _on_circle(state: RobotState, task: tasks.Searching, radius: float) -> Controls:
    """Return the controls on the circle of this radius (m) about the origin of `task`, or back to it.

    The way back leads straight to the nearest place of the circle.
    """
    odometry, mission, center = state.odometry, state.config.mission, task.origin
    x, y = odometry.x - center.x, odometry.y - center.y
    distance = math.hypot(x, y)
    if distance > 0.0 and abs(distance - radius) > OFF_CIRCLE * mission.first_straight:
        place = center.x + x * radius / distance, center.y + y * radius / distance
        return way_to(state, place, backward=True) or REST
    off = wrap(math.atan2(y, x) + 0.5 * math.pi - odometry.heading)
    if abs(off) > OFF_CIRCLE:
        return turn(odometry, odometry.heading + off, mission)
    part = inside_arc(task.rho0, radius, mission.sensing_range) / mission.period
    omega = min(mission.max_turn_rate, part, mission.max_speed / radius)
    return Controls(omega * radius, omega)


def left_of(task: tasks.ThirdPoint, odometry: Pose, mission: Mission) -> Controls:
    """Return the controls of what is left of the arc to the third point."""
    v, omega = task.command.v, task.command.omega
    if odometry == task.origin:
        return task.command
    turned, driven = odometry.heading - task.origin.heading, travelled(task.origin, odometry)
    done = turned / omega if omega else driven / abs(v)
    left = max(0.0, 1.0 - done / mission.period)
    return Controls(v * left, omega * left)


def step_length(beacon: Beacon, rho0: float, mission: Mission) -> float:
    """Return the length in m of the straight from a point with range `rho0` in m to `beacon`.

    The length is A_0, or less to keep a safety distance from the peer.
    """
    step = mission.first_straight
    return step if beacon == "anchor" else min(step, leeway(rho0, mission))


def inside_arc(rho0: float, radius: float, reach: float) -> float:
    """Return 2 pi - 2 eta in rad (Section III.A.2): the part of a circle that is in range of the beacon.

    The circle has the radius `radius` and its centre is `rho0` from the beacon, whose range is `reach`; all
    in m.
    """
    rho0 = min(rho0, reach)  # an outlier may be longer than R
    cosine = (reach * reach - rho0 * rho0 - radius * radius) / (2.0 * radius * rho0) if rho0 > 0.0 else 1.0
    return TAU - 2.0 * math.acos(min(1.0, max(-1.0, cosine)))


def left_to_orbit(state: RobotState) -> float:
    """Return the distance in m from the robot outward to its orbit; negative outside the orbit."""
    local = state.local_pose
    return state.config.orbit.radius - math.hypot(local.x, local.y)


def way_to(state: RobotState, place: Place, *, backward: bool = False) -> Controls | None:
    """Return the controls from where the robot is to `place` (see `towards`); None if it is there."""
    tolerance = state.estimator.pose_tolerance
    return towards(place, state.odometry, state.config.mission, tolerance, backward=backward)


def towards(
    place: Place, odometry: Pose, mission: Mission, tolerance: float, *, backward: bool = False
) -> Controls | None:
    """Return the controls from the pose `odometry` to `place`: a turn, then straight on; None on arrival.

    With `backward`, the robot drives backward if that needs the smaller turn. `tolerance` is
    `Estimator.pose_tolerance`.
    """
    dx, dy = place[0] - odometry.x, place[1] - odometry.y
    distance = math.hypot(dx, dy)
    if distance <= tolerance * mission.first_straight:
        return None
    bearing = wrap(math.atan2(dy, dx) - odometry.heading)
    if backward and abs(bearing) > math.pi / 2:
        bearing, distance = wrap(bearing + math.pi), -distance
    # a tick of driving that begins with a small error of the heading ends beside the place by that error
    if abs(bearing) > max(tolerance, ASIDE * mission.first_straight / abs(distance)):
        return turn(odometry, odometry.heading + bearing, mission)
    return straight(distance, mission)


def pursuit(local: Pose, orbit: Orbit, mission: Mission) -> Controls:
    """Return the controls that lead back to the orbit after odometry or actuation noise (pure pursuit).

    The robot drives an arc to the point of the orbit LOOKAHEAD ticks ahead. On the orbit, this is eq. (6).
    """
    ahead = math.atan2(local.y, local.x) + LOOKAHEAD * orbit.omega * mission.period
    x, y = orbit.radius * math.cos(ahead) - local.x, orbit.radius * math.sin(ahead) - local.y
    omega = 2.0 * wrap(math.atan2(y, x) - local.heading) / (LOOKAHEAD * mission.period)
    limit = mission.max_turn_rate
    return Controls(orbit.v, min(max(omega, -limit), limit))


def turn(pose: Pose, heading: float, mission: Mission) -> Controls:
    """Return the controls of a turn on the spot towards `heading`, limited to one tick."""
    rate = (heading - pose.heading) / mission.period
    if rate == 0.0:
        return REST
    return Controls(0.0, math.copysign(min(abs(rate), mission.max_turn_rate), rate))


def straight(distance: float, mission: Mission) -> Controls:
    """Return the controls of a straight by `distance` m (backward if negative), limited to one tick."""
    speed = distance / mission.period
    return Controls(math.copysign(min(abs(speed), mission.max_speed), speed), 0.0)
