"""The next task of a robot of a team, by what it knows.

It drives a loop until it is located. If it has ranges to one anchor only, it drives past the nearest other
one on a circle about the first. Then it drives to where its next ranges are expected to tell most, until it
can claim its pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation.following import Following
from agent.estimation.gaussian.measured_rows import near_anchors
from agent.estimation.gaussian.odometry_noise import Array, track
from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.estimation.gaussian.search import of_anchor
from agent.estimation.posterior import Hypothesis
from agent.planning.active_sensing import AmongBeacons, plan_among
from agent.planning.drive import pursuit, towards
from agent.planning.strides import stride
from agent.planning.team_state import Spiral, TeamState, Way
from agent.planning.travelling import limited, passed
from protocol.coverage_ticks import coverage_speed
from protocol.messages import Undecided
from protocol.motion import REST, TAU, Controls, Pose
from protocol.orbits import Orbit
from protocol.team_motion import loop, loop_ticks, nearest_other, spiral, way_past

ARRIVED = 0.01
"""The distance from a place, as a fraction of A_0, and the error (rad) of the way, at which it is there."""

LOOPS_UNTIL_RETURN = 3
"""The time, in loops, for which a robot drives to where it expects a range before it returns."""

LAPS_UNTIL_RETURN = 2
"""The laps without any range after which the anchor is not where it seemed to be. The robot returns to it."""

MANY_RETURNS = 2
"""The number of returns to a contact after which what the robot does there has led away too often.

With less, missions in which the next ranges would suffice take longer by these loops.
"""

SLOWEST = 0.5
"""The least speed at the beginning, as a fraction of the largest one, at which a robot stays in contact.

From nearer places, ranges tell less about its heading.
"""

LAPS = (0.0, 0.5, -0.5, 1.0, -1.0)
"""The distances by which consecutive laps of the way past an anchor lie outside it, in units of R."""


def next_task(state: TeamState) -> TeamState:
    """Return `state` with the task and the controls of the next tick: the first that has a reason."""
    for task in (_at_rest, _searching, _looping, _joining, _returning):
        if (after := task(state)) is not None:
            break
    else:
        arrived = _arrived(state)
        after = _as_beacon(arrived) or _surveying(arrived) or _passing(arrived) or _circling(arrived)
    return _passing_robots(after)


def _passing_robots(state: TeamState) -> TeamState:
    """Return `state` on its way past robots (see `travelling`). It waits for those earlier in the team."""
    mission, passing = state.config.mission, state.passing
    if not mission.safety_distance:
        return state
    if passing.places and _aside(state) is None:
        passing = replace(passing, places=passing.places[1:])
        state = replace(state, passing=passing)
    earlier = [one for one in state.team.robots[: state.own] if one in state.apart]
    controls = _aside(state) or state.controls
    return replace(state, passing=passed(passing, state.apart, earlier, state.odometry, controls, mission))


def safe_controls(state: TeamState) -> Controls:
    """Return the controls of the task, or aside of it, at a speed that keeps the safety distance."""
    return limited(_aside(state) or state.controls, state.passing, state.config.mission)


def _aside(state: TeamState) -> Controls | None:
    """Return the controls to the next place of the way aside; None at that place, or on no such way."""
    if not state.passing.places:
        return None
    return towards(state.passing.places[0], state.odometry, state.config.mission, ARRIVED, backward=True)


def _at_rest(state: TeamState) -> TeamState | None:
    """Return `state` at rest at the end: it is undecided, or nobody waits for a result."""
    if isinstance(state.verdict, Undecided):
        return state.doing_next("undecided", None)
    return state.doing_next("localised", None) if state.verdict and not state.waiting else None


def _as_beacon(state: TeamState) -> TeamState | None:
    """Return `state` with a claim: in loops while a robot in contact has no result. The origin goes on."""
    if state.verdict is None or state.config.robot == state.team.origin:
        return None
    return state.doing_next("localised", _loop(state) if state.waiting_here else None)


def _searching(state: TeamState) -> TeamState | None:
    """Return `state` on the spiral, on which the first robot searches; the others stand.

    It searches if nothing connects it with a robot that has no result. After a meeting, it goes on where it
    has left the spiral.
    """
    if not (state.team.diameter and state.waiting and _alone(state)):
        return None
    if state.config.robot != state.team.origin:
        return state.doing_next("waiting", None)
    mission, here, (corner, place) = state.config.mission, state.odometry, state.spiral
    corners, v = spiral(mission, state.team.diameter), coverage_speed(mission)
    if math.hypot(here.x - place[0], here.y - place[1]) <= (1.0 + ARRIVED) * v * mission.period:
        place = here.x, here.y
    for k in (corner, corner + 1):
        at = corners[k % len(corners)] if place == (here.x, here.y) else place
        way = towards(at, here, mission, ARRIVED)
        if way is not None:
            break
    controls = Controls(min(way.v, v), way.omega) if way is not None else None
    return replace(state, spiral=Spiral(k, place)).doing_next("searching", controls)


def _alone(state: TeamState) -> bool:
    """Return whether nothing connects this robot with the first, or the first with one that is waiting."""
    first = state.team.robots.index(state.team.origin or "")
    others = state.waiting if first == state.own else [first]
    return not any(state.log.logs[one] or state.nearest[one].range < math.inf for one in others)


def _joining(state: TeamState) -> TeamState | None:
    """Return `state`, in a team without anchors, on its way to a robot that has no result.

    A robot that has none itself also goes to those that have one: they return to where both were nearest.
    """
    others = state.waiting if state.verdict else [*state.waiting, *sorted(state.log.done)]
    lost = [state.nearest[one].place for one in others if state.nearest[one].range < math.inf]
    if state.team.origin is None or not lost or state.waiting_here or (not state.verdict and state.apart):
        return None
    return _homing(state, lost[0])


def _returning(state: TeamState) -> TeamState | None:
    """Return `state` on its way back if it is not where it seemed to be: its estimate begins again."""
    place = _lost(state) if state.verdict is None else None
    if place is None:
        return None
    return replace(_homing(state, place), joint=state.joint._replace(following=Following()))


def _homing(state: TeamState, place: Pose) -> TeamState:
    way = towards((place.x, place.y), state.odometry, state.config.mission, ARRIVED, backward=True)
    return state.doing_next("homing", way)


def _arrived(state: TeamState) -> TeamState:
    """Return `state`, after it has returned as often as MANY_RETURNS for two loops."""
    if state.doing != "homing":
        return state
    loops = 2 * loop_ticks(state.config.mission, state.own)
    until = state.tick + loops if state.returns >= MANY_RETURNS else -1
    return replace(state, returns=state.returns + 1, loops_until=until)


def _lost(state: TeamState) -> Pose | None:
    """Return the place to which the robot returns if it is not where it seemed to be; None if that is open.

    It has had no range for a few loops to what determines the frame: an anchor, or the robot whose start is
    the origin. If it has never had one, others bring it: it returns to where it had the latest range to one.
    """
    team = state.team
    if team.origin is None:
        anchors = state.nearest[len(team.robots) :]
        beacon = min(anchors, key=lambda one: one.range)._replace(latest=max([one.latest for one in anchors]))
    elif (beacon := state.nearest[team.robots.index(team.origin)]).range == math.inf:
        beacon = max(state.nearest, key=lambda one: (one.range < math.inf, one.latest))
    if beacon.range == math.inf or state.config.robot == team.origin:
        return None
    waits = 0.0
    if state.doing != "homing" and state.place is not None:
        waits = LOOPS_UNTIL_RETURN * loop_ticks(state.config.mission, state.own)
    elif state.doing != "homing":
        waits = LAPS_UNTIL_RETURN * _lap_ticks(state, state.way) if state.way is not None else math.inf
    return beacon.place if state.tick > beacon.latest + waits else None


def _circling(state: TeamState) -> TeamState:
    return state.doing_next("circling", _loop(state))


def _loop(state: TeamState) -> Controls:
    """Return the controls of a loop. Without anchors, it keeps the contacts that connect the team.

    The robot turns back, on another arc, where a range would leave R if it grew as in the latest tick. Before
    there is a growth, it drives so far that it mostly stays in range, wherever both drive.
    """
    mission, entries = state.config.mission, state.log.logs[state.own]
    controls = loop(mission, state.own, state.tick)
    if state.team.origin is None:
        return controls
    before = {one.to: one.range for one in entries[-2].robots} if len(entries) > 1 else {}
    driven, v, back = entries[-1].executed or REST, abs(controls.v), False
    for robot, rho in _connecting(state):
        free = mission.sensing_range - rho
        if robot in before and driven.v:
            back = back or (rho - before[robot]) * max(v / abs(driven.v), 1.0) > free
        else:
            v = min(v, max(0.5 * free / mission.period, SLOWEST * mission.max_speed))
    return Controls(v if (driven.v < 0.0) == back else -v, controls.omega)


def _connecting(state: TeamState) -> list[tuple[int, float]]:
    """Return the robots in contact, and the ranges to them (m), without those that are nearer to a third one.

    They are those to which no way by two shorter ranges leads. If all robots keep them, all stay connected.
    """
    names, logs = state.team.robots, state.log.logs
    own = {names.index(name): rho for name, rho in state.apart.items()}
    ranges = {
        k: {one.to: one.range for one in logs[k][state.tick].robots} if state.tick < len(logs[k]) else {}
        for k in own
    }
    return [
        (k, rho)
        for k, rho in sorted(own.items())
        if not any(max(own[c], ranges[k][c]) < rho for c in own if c in ranges[k])
    ]


def _looping(state: TeamState) -> TeamState | None:
    """Return `state` in the loops after MANY_RETURNS."""
    return _circling(state) if state.tick < state.loops_until else None


def _passing(state: TeamState) -> TeamState | None:
    """Return `state` on the way past another anchor, once there is one."""
    way = _way(state)
    return replace(state, way=way).doing_next("orbiting", _along(state, way)) if way is not None else None


def _way(state: TeamState) -> Way | None:
    """Return the way past the next anchor, once a loop has ranges to one with a position alone.

    While there are ranges to that anchor, its place is estimated again.
    """
    mission, anchors = state.config.mission, state.team.anchors
    entries, ranges_of = state.log.logs[state.own], dict[int, list[tuple[int, float]]]()
    for tick, entry in enumerate(entries):
        for one in entry.anchors:
            if anchors[one.to].position is not None:
                ranges_of.setdefault(one.to, []).append((tick, one.range))
    if len(entries) <= loop_ticks(mission, state.own) or not ranges_of:
        return state.way
    first = max(ranges_of, key=lambda anchor: (len(ranges_of[anchor]), -anchor))
    known = [one for one in anchors if one.id in state.config.ranges]
    distance = nearest_other(anchors[first], known)
    if distance is None or (state.way is not None and ranges_of[first][-1][0] < state.tick):
        return state.way
    driven = [one.executed for one in entries if one.executed is not None]
    v, omega = (np.array([getattr(one, name) for one in driven]) + 0.0 for name in ("v", "omega"))
    path = track(v, omega, mission.period)
    alone = near_anchors((path,), (ranges_of[first],), ((0.0, 0.0),), mission.noise, mission.sensing_range)
    found = of_anchor((), alone.alone(0))
    if not found:
        return state.way
    start = found[0].fit.start.poses[0].tolist()
    orbit = way_past(mission, distance)
    since = state.tick if state.way is None else state.way.since
    return Way(Pose(-start[0], -start[1], 0.0), orbit, since)


def _lap_ticks(state: TeamState, way: Way) -> float:
    """Return the ticks of a lap, with some for the way to it."""
    return 1.25 * TAU / (state.config.mission.period * way.orbit.omega)


def _along(state: TeamState, way: Way) -> Controls:
    """Return the controls that lead to the way and along it. Each lap is aside of the last one."""
    mission, orbit = state.config.mission, way.orbit
    lap = int((state.tick - way.since) / _lap_ticks(state, way))
    radius = max(orbit.radius + LAPS[lap % len(LAPS)] * mission.sensing_range, 0.3 * mission.sensing_range)
    omega = min(mission.max_turn_rate, mission.max_speed / radius)
    local = Pose(state.odometry.x - way.centre.x, state.odometry.y - way.centre.y, state.odometry.heading)
    return pursuit(local, Orbit(radius, omega * radius, omega), mission)


def _surveying(state: TeamState) -> TeamState | None:
    """Return `state` on the way to where the next ranges are expected to tell most; None if that is open."""
    mission, seen = state.config.mission, _seen(state)
    if not seen or not len(seen[0].beacons):
        return None
    if (controls := _to_anchor(state)) is not None:
        return state.doing_next("surveying", controls)
    if state.doing == "surveying" and state.tick < state.planned + stride(mission):
        return state
    sigma = max(mission.noise.anchor_sigma, mission.noise.mutual_sigma)
    if state.team.origin is not None and (own := state.following.judged.get(state.config.robot)):
        mission = replace(mission, accuracy=own.accuracy)  # with exact sensors, that of rounding
    controls = plan_among(seen, sigma, mission, _frame_sigma(state))
    return replace(state, planned=state.tick).doing_next("surveying", controls)


def _to_anchor(state: TeamState) -> Controls | None:
    """Return the controls to where the robot was nearest to an anchor that too few ranges locate.

    If it has never ranged that anchor, it goes to where it was nearest to a robot that has. None if it has no
    such anchor, or is in range of it, or there.
    """
    names, logs, count = [one.id for one in state.team.anchors], state.log.logs, len(state.team.robots)
    located = state.following.part.robots if state.following.part is not None else ()
    for name in [one for one in state.wanted if one not in located]:
        anchor = names.index(name)
        near = state.nearest[count + anchor]
        if near.range == math.inf:
            met = [k for k in range(count) if state.nearest[k].range < math.inf]
            ranged = [k for k in met if any(one.to == anchor for entry in logs[k] for one in entry.anchors)]
            near = state.nearest[ranged[0]] if ranged else near
        if near.latest < state.tick and near.range < math.inf:
            return towards((near.place.x, near.place.y), state.odometry, state.config.mission, ARRIVED)
    return None


def _seen(state: TeamState) -> list[AmongBeacons]:
    """Return the hypotheses that the next ranges have to distinguish; none if this robot is not located.

    The robot whose start is the origin knows where it is. It moves so that the others get to know it: what
    counts is the place of the least accurate of them as seen from it, and all hypotheses about them. So it is
    with an anchor that is wanted.
    """
    place, known = state.place, state.following.known.hypotheses
    if place is None:
        return []
    part = state.following.part
    assert part is not None
    wanted = [part.robots.index(one) for one in state.wanted if one in part.robots][:1]
    surveys = bool(wanted) and state.config.robot != state.team.origin
    if state.config.robot == state.team.origin:
        wanted = [k for k in range(len(part.robots)) if k != place]
        if not wanted:
            return []
    chosen = known if wanted else state.hypotheses
    total = math.fsum([one.probability for one in chosen])
    return [
        AmongBeacons(
            PlanningHypothesis(
                one.probability / total,
                one.fit.poses[place],
                _as_seen(one, place, () if surveys else wanted, wanted if surveys else ()),
            ),
            *_beacons(state, one, wanted if state.wanted else ()),
            surveys,
        )
        for one in chosen
    ]


def _as_seen(
    hypothesis: Hypothesis, place: int, wanted: Sequence[int], surveyed: Sequence[int] = ()
) -> Array:
    """Return the covariance of a pose and of the places of the anchors that are `surveyed`.

    The position is relative to the least accurate one that is `wanted`.
    """
    joint, own = hypothesis.fit.covariance, slice(3 * place, 3 * place + 2)
    rows = [3 * place, 3 * place + 1, 3 * place + 2, *[3 * k + axis for k in surveyed for axis in (0, 1)]]
    found = joint[np.ix_(rows, rows)].copy()
    places = [slice(3 * k, 3 * k + 2) for k in wanted]
    away = [joint[own, own] + joint[k, k] - joint[own, k] - joint[k, own] for k in places]
    found[:2, :2] = max(away, key=lambda one: float(np.trace(one)), default=found[:2, :2])
    return found


def _frame_sigma(state: TeamState) -> float:
    """Return the sigma (rad) of the heading of the robot whose start is the origin; 0 with anchors."""
    part, origin = state.following.part, state.team.origin
    if origin is None or part is None:
        return 0.0
    fit, i = state.following.known.hypotheses[0].fit, 3 * part.robots.index(origin) + 2
    return math.sqrt(max(float(fit.covariance[i, i]), 0.0))


def _beacons(state: TeamState, hypothesis: Hypothesis, wanted: Sequence[int]) -> tuple[Array, Array]:
    """Return the places (m) of the anchors and robots that the robot may range, and of those to stay near.

    Without anchors, it stays near the robot whose start is the origin. A robot that has ranged one anchor
    only goes to another one. If an anchor is `wanted`, it is the first one, and the surveyed ones tell in
    which frame it stands.
    """
    part = state.following.part
    assert part is not None
    config, origin = state.config, part.origin
    known = {
        one.id: (one.position.x - origin[0], one.position.y - origin[1])
        for one in state.team.anchors
        if one.position is not None and one.id in config.ranges
    }
    if wanted:
        there = hypothesis.fit.poses[list(wanted), :2]
        surveyed = [at for name, at in known.items() if name not in part.robots]
        return np.concatenate((there, np.array(surveyed).reshape(-1, 2))), there
    found, gone, first = list(known.values()), [], None
    ranged = {state.team.anchors[one.to].id for entry in state.log.logs[state.own] for one in entry.anchors}
    if others := [place for name, place in known.items() if len(ranged) == 1 and name not in ranged]:
        first = np.array(others)
    for name, (x, y, _) in zip(part.robots, hypothesis.fit.poses.tolist(), strict=True):
        if name in config.ranges or name in state.apart:
            found.append((x, y))
        elif name in state.team.robots and name != config.robot:
            gone.append((x, y))  # it may have left that place
        if name == state.team.origin and name != config.robot:
            first = np.array([(x, y)])
    places = np.array(found or gone, np.float64).reshape(-1, 2)
    return places, places if first is None else first
