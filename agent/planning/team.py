"""A robot of a team: all robots share all measurements, and each estimates the poses of all from them.

It drives a loop until it is located. If it has ranges to one anchor only, it drives past the nearest other
one on a circle about the first. Then it drives to where its next ranges are expected to tell most, until it
can claim its pose. No plan is made beforehand: what anchors there are is data.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import combinations
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from agent.estimation.following import ClaimRule, Following
from agent.estimation.gaussian.claim_agreement import united
from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.estimation.gaussian.joint_claims import undetermined
from agent.estimation.gaussian.joint_ranges import near_anchors
from agent.estimation.gaussian.odometry_noise import Array, track
from agent.estimation.gaussian.search import of_anchor, position_sigma
from agent.estimation.posterior import Hypothesis, certainties, same
from agent.estimation.team_measurements import TeamMeasurements
from agent.peer.false_reports import falsified_entries
from agent.peer.team_log import TeamLog, TeamReport
from agent.planning.active_sensing import AmongBeacons, plan_among
from agent.planning.drive import pursuit, towards
from agent.planning.planner import Planner, Summary
from agent.planning.strides import stride
from protocol.messages import (
    Command,
    Estimate,
    Localised,
    Observation,
    RobotConfig,
    SurveyedAnchor,
    Team,
    Undecided,
    Verdict,
)
from protocol.mission import Anchor
from protocol.motion import ORIGIN, REST, TAU, Controls, Pose, compose, relative, step, wrap
from protocol.orbits import Orbit
from protocol.sweep_strips import Place
from protocol.sweep_ticks import sweep_speed
from protocol.team_motion import loop, loop_ticks, nearest_other, spiral, way_past

ARRIVED = 0.01
"""The distance from a place, as a fraction of A_0, and the error (rad) of the way, at which it is there."""

LOOPS_UNTIL_RETURN = 3
"""The time, in loops, for which a robot drives to where it expects a range before it returns."""

UNMET = "it has reported nothing"
"""The reason against a claim by the measurements of a robot that there are none of."""
MANY_RETURNS = 2
"""The number of returns to a contact after which what the robot does there has led away too often.

With less, missions in which the next ranges would suffice take longer by these loops.
"""
LAPS = (0.0, 0.5, -0.5, 1.0, -1.0)
"""The distances by which consecutive laps of the way past an anchor lie outside it, in units of R."""


class Way(msgspec.Struct, frozen=True):
    """The way past the anchor that is nearest to the one to which the robot has ranges."""

    centre: Pose
    """The place of the latter, in the frame of the odometry."""
    orbit: Orbit
    """The circle about it."""
    since: int
    """The tick in which the robot set out."""


class Spiral(NamedTuple):
    """The place of the first robot in its search for robots that nobody has met."""

    corner: int = 0
    """The corner of the spiral to which it drives."""
    place: Place = (0.0, 0.0)
    """The place (m) up to which it has searched, in the frame of the odometry."""


class Near(NamedTuple):
    """The place of the shortest range to a robot, where both are in the same tick, or to any anchor."""

    range: float = math.inf
    """The range in m; infinite before there is one."""
    place: Pose = ORIGIN
    """The pose of this robot, in the frame of the odometry."""
    latest: int = 0
    """The tick of the latest range."""

    def ranged(self, rho: float | None, place: Pose, tick: int) -> Near:
        """Return this after a tick with the range `rho` (m), or without one."""
        if rho is None:
            return self
        return Near(rho, place, tick) if rho < self.range else self._replace(latest=tick)


class TeamEstimate(NamedTuple):
    """An estimate by a part of the measurements."""

    measured: TeamMeasurements = TeamMeasurements()
    """The part of the log that the estimate has read."""
    following: Following = Following()
    """The estimate of all poses."""
    why_not: str = UNMET
    """The reason against a claim; empty if there is none."""


class TeamState(msgspec.Struct, frozen=True):
    """The knowledge of a robot of a team, and its task."""

    config: RobotConfig
    log: TeamLog
    tick: int = -1
    odometry: Pose = ORIGIN
    """The pose by dead reckoning, in the frame of the pose at tick 0."""
    peers: tuple[str, ...] = ()
    """The robots that are in contact."""
    nearest: tuple[Near, ...] = ()
    """The place where the robot was nearest to each robot of the team."""
    anchored: Near = Near()
    """The place where the robot was nearest to an anchor."""
    measured: TeamMeasurements = TeamMeasurements()
    """The part of the log that the estimate has read."""
    following: Following = Following()
    """The estimate of all poses; in a team that tolerates false data, by the own measurements alone."""
    pairs: tuple[TeamEstimate, ...] = ()
    """The estimates by these and the measurements of each other robot, in such a team."""
    wanted: tuple[str, ...] = ()
    """The anchors that are not accurate enough yet, the least accurate one first."""
    why_not: str = "it has not moved yet"
    """The reason against a claim; empty if there is none."""
    verdict: Verdict | None = None
    way: Way | None = None
    """The way past an anchor; None until it has none."""
    returns: int = 0
    """The number of returns to a contact."""
    loops_until: int = -1
    """The tick until which it drives loops there, after MANY_RETURNS."""
    spiral: Spiral = Spiral()
    """The search for robots that start elsewhere."""
    doing: str = "asleep"
    """The name of the present task."""
    phase: int = 1
    """The phase of the paper to which it corresponds."""
    controls: Controls = REST
    """The controls of the next tick."""
    planned: int = -1
    """The tick of the latest plan of where ranges tell most."""

    @property
    def team(self) -> Team:
        """The team."""
        assert self.config.team is not None
        return self.config.team

    @property
    def own(self) -> int:
        """The place of this robot in the team."""
        return self.team.robots.index(self.config.robot)

    @property
    def waiting(self) -> list[int]:
        """The other robots that have no result, as far as this one knows."""
        return [one for one in range(len(self.team.robots)) if one not in {*self.log.done, self.own}]


class TeamPlanner(Planner[TeamState, TeamReport]):
    """The planner `assured` of a team."""

    BODY = TeamReport

    def start(self, config: RobotConfig) -> TeamState:
        """Return the state of a robot that has measured nothing yet."""
        assert config.team is not None
        log = TeamLog.of(config.team, hearsay=not config.tolerates)
        pairs = (TeamEstimate(),) * len(config.team.robots) if config.tolerates else ()
        return TeamState(config, log, pairs=pairs, nearest=(Near(),) * len(config.team.robots))

    def observe(self, state: TeamState, observation: Observation) -> TeamState:
        """Return `state` with the sensor data of one tick."""
        driven = observation.executed
        odometry, period = state.odometry, state.config.mission.period
        if driven is not None:
            odometry = step(odometry, driven.v, driven.omega, period)
        ranges = {one.peer: one.range for one in observation.contacts if one.range is not None}
        nearest = zip(state.team.robots, state.nearest, strict=True)
        anchor = min([one.range for one in observation.anchors], default=None)
        return replace(
            state,
            tick=observation.tick,
            odometry=odometry,
            log=state.log.measured(state.own, observation, state.team),
            peers=tuple([one.peer for one in observation.contacts]),
            nearest=tuple(
                [one.ranged(ranges.get(robot), odometry, observation.tick) for robot, one in nearest]
            ),
            anchored=state.anchored.ranged(anchor, odometry, observation.tick),
        )

    def report(self, state: TeamState) -> TeamReport:
        """Return the report to a robot that has acknowledged nothing."""
        return self.report_to(state, state.config.robot)

    def report_to(self, state: TeamState, peer: str) -> TeamReport:
        """Return what `peer` has not acknowledged, falsified if the configuration contains an attack."""
        log, attack, own = state.log, state.config.attack, state.own
        if attack is not None:
            told = falsified_entries(log.logs[own], attack, state.config.mission.period)
            log = replace(log, logs=(*log.logs[:own], told, *log.logs[own + 1 :]))
        return log.report(own, state.team.robots.index(peer))

    def decide(self, state: TeamState, reports: Sequence[TeamReport] = ()) -> TeamState:
        """Return `state` with the `reports` of others, and with what follows from all measurements."""
        state = replace(state, log=state.log.received(reports, state.own))
        helps = state.config.robot == state.team.origin and state.waiting
        if state.tick > 0 and (state.verdict is None or helps):  # before a motion, no heading is known
            state = _followed(state)
        if state.verdict is None:
            state = _claimed(state)
        return _moved_on(state)

    def command(self, state: TeamState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        robot, rests = state.config.robot, state.verdict is not None and state.controls == REST
        v, omega = state.controls.v, state.controls.omega
        return Command(
            state.tick, robot, v, omega, state.phase, state.doing, verdict=state.verdict, rests=rests
        )

    def estimate(self, state: TeamState) -> Estimate:
        """Return all poses of this robot that explain the measurements."""
        poses = _poses(state)
        world = [_in_world(state, one) for one in poses]
        total = math.fsum([one.probability for one in poses])
        if isinstance(state.verdict, Localised):
            world = world or [state.verdict.pose]
        judged = state.following.judged.get(state.config.robot)
        covariance = judged.localised.covariance if judged is not None and poses else None
        return Estimate(
            state.tick,
            state.config.robot,
            (state.odometry,) if poses else (),
            tuple(world),
            isinstance(state.verdict, Localised),
            tuple([min(one.probability / total, 1.0) for one in poses]) if covariance is not None else (),
            covariance,
            _anchors(state),
        )

    def summary(self, state: TeamState) -> Summary:
        """Return the number of hypotheses, their probability, and what prevents a claim."""
        entries, poses = state.log.logs[state.own], _poses(state)
        judged = state.following.judged.get(state.config.robot)
        pairs = [one.following.judged.get(state.config.robot) for one in state.pairs]
        tests = [one.inconsistency for one in (judged, *pairs) if one is not None]
        p_value = min([one.p_value for one in tests if one is not None], default=None)
        noisy = judged is not None and judged.localised.covariance is not None
        total = math.fsum([one.probability for one in poses])
        return Summary(
            anchor_ranges=sum([len(one.anchors) for one in entries]),
            hypotheses=len(poses) or None,
            probability=min(poses[0].probability / total, 1.0) if noisy and poses else None,
            blocking_reason=state.why_not or None if noisy and state.verdict is None else None,
            p_value=p_value if noisy else None,
        )


# --- knowledge ------------------------------------------------------------------------------------------


def _followed(state: TeamState) -> TeamState:
    """Return `state` with the estimate by all measurements so far."""
    own = state.own
    before = TeamEstimate(state.measured, state.following)
    known = _estimated(state, before, (own,) if state.config.tolerates else None)
    wanted, why_not = _wanted(known.following, state.team, state.config.mission.confidence), known.why_not
    if wanted and not why_not:
        why_not = f"anchor {wanted[0]} is not known to {state.team.survey:g} m yet"
    pairs = tuple(
        [
            _estimated(state, pair, (own, k)) if k != own and state.log.logs[k] else pair
            for k, pair in enumerate(state.pairs)
        ]
    )
    measured, following = known.measured, known.following
    return replace(state, measured=measured, following=following, why_not=why_not, wanted=wanted, pairs=pairs)


def _estimated(state: TeamState, before: TeamEstimate, of: Collection[int] | None) -> TeamEstimate:
    """Return the estimate that goes on from the one `before`, by the measurements `of` robots; None: all."""
    mission, robot = state.config.mission, state.config.robot
    measured = before.measured.grown(state.log, state.team, mission, of)
    used, rule = measured.joint(state.team, mission), ClaimRule(mission.accuracy, mission.confidence)
    following = before.following.after(used, rule, "team", (robot,))
    why_not = following.reasons.get(robot)
    if why_not is None:
        why_not = undetermined(used.robots.index(robot), following.known.located, used)
    return TeamEstimate(measured, following, why_not)


def _wanted(following: Following, team: Team, confidence: float) -> tuple[str, ...]:
    """Return the anchors that have to be measured further, the least accurate one first.

    They are not surveyed, and some robot has ranged them.
    """
    part, left = following.part, []
    if part is None or not team.survey or not following.known.hypotheses:
        return ()
    sure = certainties(following.known)
    for anchor in team.anchors:
        if anchor.position is not None and not anchor.sigma:
            continue
        if anchor.id in part.robots:
            k = part.robots.index(anchor.id)
            sigma = position_sigma(following.known.hypotheses[0].fit, k)
            if sigma > team.survey or sure[k].probability < confidence:
                left.append((-sigma, anchor.id))
        elif anchor.id in part.anchors:
            left.append((-math.inf, anchor.id))
    return tuple([name for _, name in sorted(left)])


def _claimed(state: TeamState) -> TeamState:
    """Return `state` with a verdict, if there is one now."""
    if not state.why_not:
        return _with_verdict(state, state.following.judged[state.config.robot].localised)
    claiming = [pair.following for pair in state.pairs if not pair.why_not]
    for agreed in combinations(claiming, state.config.tolerates + 1):
        claim = united([one.judged[state.config.robot].localised for one in agreed], state.config.mission)
        if claim is not None:  # one of these robots is honest
            return _with_verdict(replace(state, following=agreed[-1]), claim)
    if state.tick * state.config.mission.period >= state.config.gives_up:
        return _with_verdict(state, Undecided(state.why_not))
    return state


def _with_verdict(state: TeamState, verdict: Verdict) -> TeamState:
    done = state.log.done | {state.own}
    return replace(state, verdict=verdict, log=replace(state.log, done=done))


class _Pose(NamedTuple):
    """A pose of this robot under the most probable hypothesis that has it."""

    probability: float
    hypothesis: Hypothesis


def _poses(state: TeamState) -> list[_Pose]:
    """Return the different poses of this robot, the most probable first; none if it is not located."""
    place = _place(state)
    found: list[_Pose] = []
    for one in state.following.known.hypotheses if place is not None else ():
        if not any(same(one.fit, other.hypothesis.fit)[place or 0] for other in found):
            found.append(_Pose(one.probability, one))
    return found


def _place(state: TeamState) -> int | None:
    """Return the index of this robot in the fits; None if it is not located."""
    part = state.following.part
    if part is None or state.config.robot not in part.robots or not state.following.known.hypotheses:
        return None
    return part.robots.index(state.config.robot)


def _in_world(state: TeamState, pose: _Pose) -> Pose:
    """Return a pose of this robot in <W>, moved by the odometry since its fit."""
    part, place = state.following.part, _place(state)
    assert part is not None
    assert place is not None
    x, y, heading = pose.hypothesis.fit.poses[place].tolist()
    at = Pose(part.origin[0] + x, part.origin[1] + y, wrap(heading))
    path = part.paths[place]
    before = Pose(float(path.x[-1]), float(path.y[-1]), float(path.heading[-1]))
    return at if state.verdict is None else compose(at, relative(before, state.odometry))


def _anchors(state: TeamState) -> tuple[SurveyedAnchor, ...]:
    """Return the anchors that are not surveyed, as far as they are located."""
    part, known = state.following.part, state.following.known.hypotheses
    if part is None or not known:
        return ()
    fit, (x, y) = known[0].fit, part.origin
    return tuple(
        [
            SurveyedAnchor(
                name,
                Anchor(float(x + fit.poses[k, 0]), float(y + fit.poses[k, 1])),
                min(position_sigma(fit, k), MOST_SIGMA),
            )
            for k, name in enumerate(part.robots)
            if part.is_anchor(k)
        ]
    )


MOST_SIGMA = 1e6
"""The largest sigma (m) of an anchor that is stated."""


def _own_covariance(state: TeamState, pose: _Pose) -> Array:
    place = _place(state) or 0
    own = slice(3 * place, 3 * place + 3)
    return pose.hypothesis.fit.covariance[own, own]


# --- motion ---------------------------------------------------------------------------------------------


def _moved_on(state: TeamState) -> TeamState:
    """Return `state` with the task and the controls of the next tick.

    A robot with a verdict drives on in loops while another one in contact has none: it is its beacon.
    """
    mission, own = state.config.mission, state.own
    waiting = [one for one in state.waiting if state.team.robots[one] in state.peers]
    if isinstance(state.verdict, Undecided) or (state.verdict is not None and not state.waiting):
        name = "undecided" if isinstance(state.verdict, Undecided) else "localised"
        return replace(state, doing=name, phase=3, controls=REST)
    if state.team.diameter and state.waiting and _alone(state):
        return _searching(state)
    if state.tick < state.loops_until:
        return replace(state, doing="circling", phase=1, controls=loop(mission, own, state.tick))
    lost = [state.nearest[one].place for one in state.waiting if state.nearest[one].range < math.inf]
    if state.team.origin is not None and lost and not waiting and (state.verdict or not state.peers):
        back = towards((lost[0].x, lost[0].y), state.odometry, mission, ARRIVED)
        return replace(state, doing="homing", phase=1, controls=back or REST)
    if state.verdict is None and (place := _lost(state)) is not None:
        back = towards((place.x, place.y), state.odometry, mission, ARRIVED)
        return replace(state, doing="homing", phase=1, controls=back or REST, following=Following())
    if state.doing == "homing":
        until = state.tick + 2 * loop_ticks(mission, own) if state.returns >= MANY_RETURNS else -1
        state = replace(state, returns=state.returns + 1, loops_until=until)
    if state.verdict is not None and state.config.robot != state.team.origin:
        return replace(
            state, doing="localised", phase=3, controls=loop(mission, own, state.tick) if waiting else REST
        )
    seen = _seen(state)
    if seen and len(seen[0].beacons):
        return _surveying(state, seen)
    state = _on_way(state)
    if state.way is None:
        return replace(state, doing="circling", phase=1, controls=loop(mission, own, state.tick))
    return replace(state, doing="orbiting", phase=2, controls=_along(state, state.way))


def _alone(state: TeamState) -> bool:
    """Return whether nothing connects this robot with the first, or the first with one that is waiting."""
    first = state.team.robots.index(state.team.origin or "")
    others = state.waiting if first == state.own else [first]
    return not any(state.log.logs[one] or state.nearest[one].range < math.inf for one in others)


def _searching(state: TeamState) -> TeamState:
    """Return `state` on the spiral, on which the first robot searches; the others stand.

    After a meeting, it goes on where it has left the spiral.
    """
    if state.config.robot != state.team.origin:
        return replace(state, doing="waiting", phase=1, controls=REST)
    mission, here, (corner, place) = state.config.mission, state.odometry, state.spiral
    corners, v = spiral(mission, state.team.diameter), sweep_speed(mission)
    if math.hypot(here.x - place[0], here.y - place[1]) <= (1.0 + ARRIVED) * v * mission.period:
        place = here.x, here.y
    for k in (corner, corner + 1):
        at = corners[k % len(corners)] if place == (here.x, here.y) else place
        way = towards(at, here, mission, ARRIVED)
        if way is not None:
            break
    way = way or REST
    controls = Controls(min(way.v, v), way.omega)
    return replace(state, doing="searching", phase=2, controls=controls, spiral=Spiral(k, place))


def _seen(state: TeamState) -> list[AmongBeacons]:
    """Return the hypotheses that the next ranges have to distinguish; none if this robot is not located.

    The robot whose start is the origin knows where it is. It moves so that the others get to know it: what
    counts is the place of the least accurate of them as seen from it, and all hypotheses about them. So it is
    with an anchor that is wanted.
    """
    place, known = _place(state), state.following.known.hypotheses
    if place is None:
        return []
    part = state.following.part
    assert part is not None
    wanted = [part.robots.index(one) for one in state.wanted[:1] if one in part.robots]
    if state.config.robot == state.team.origin:
        wanted = [k for k in range(len(part.robots)) if k != place]
        if not wanted:
            return []
    chosen = [_Pose(one.probability, one) for one in known] if wanted else _poses(state)
    total = math.fsum([one.probability for one in chosen])
    return [
        AmongBeacons(
            PlanningHypothesis(
                one.probability / total,
                one.hypothesis.fit.poses[place],
                _as_seen(one.hypothesis, place, wanted) if wanted else _own_covariance(state, one),
            ),
            *_beacons(state, one.hypothesis, wanted if state.wanted else ()),
        )
        for one in chosen
    ]


def _lost(state: TeamState) -> Pose | None:
    """Return the place to which the robot returns if it is not where it seemed to be; None if that is open.

    It has had no range for a few loops to what determines the frame: an anchor, or the robot whose start is
    the origin. If it has never had one, others bring it: it returns to where it had the latest range to one.
    """
    team = state.team
    beacon = state.anchored if team.origin is None else state.nearest[team.robots.index(team.origin)]
    if team.origin is not None and beacon.range == math.inf:
        beacon = max(state.nearest, key=lambda one: (one.range < math.inf, one.latest))
    if beacon.range == math.inf or state.config.robot == team.origin:
        return None
    waits = LOOPS_UNTIL_RETURN * loop_ticks(state.config.mission, state.own) if state.doing != "homing" else 0
    if state.tick <= beacon.latest + waits or (_place(state) is None and state.doing != "homing"):
        return None
    return beacon.place


def _as_seen(hypothesis: Hypothesis, place: int, wanted: Sequence[int]) -> Array:
    """Return the covariance of a pose, its position relative to the least accurate of those wanted."""
    joint, own = hypothesis.fit.covariance, slice(3 * place, 3 * place + 2)
    found = joint[3 * place : 3 * place + 3, 3 * place : 3 * place + 3].copy()
    places = [slice(3 * k, 3 * k + 2) for k in wanted]
    away = [joint[own, own] + joint[k, k] - joint[own, k] - joint[k, own] for k in places]
    found[:2, :2] = max(away, key=lambda one: float(np.trace(one)))
    return found


def _surveying(state: TeamState, seen: Sequence[AmongBeacons]) -> TeamState:
    """Return `state` on the way to where the next ranges are expected to tell most."""
    mission = state.config.mission
    if state.doing == "surveying" and state.tick < state.planned + stride(mission):
        return state
    noise = mission.noise
    sigma = max(noise.anchor_sigma, noise.mutual_sigma)
    controls = plan_among(seen, sigma, mission, _frame_sigma(state))
    return replace(state, doing="surveying", phase=3, controls=controls, planned=state.tick)


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
    only goes to another one. If an anchor is `wanted`, it counts alone.
    """
    part = state.following.part
    assert part is not None
    if wanted:
        there = hypothesis.fit.poses[list(wanted), :2]
        return there, there
    config, origin = state.config, part.origin
    known = {
        one.id: (one.position.x - origin[0], one.position.y - origin[1])
        for one in state.team.anchors
        if one.position is not None and one.id in config.ranges
    }
    found, gone, first = list(known.values()), [], None
    ranged = {state.team.anchors[one.to].id for entry in state.log.logs[state.own] for one in entry.anchors}
    if others := [place for name, place in known.items() if len(ranged) == 1 and name not in ranged]:
        first = np.array(others)
    for name, (x, y, _) in zip(part.robots, hypothesis.fit.poses.tolist(), strict=True):
        if name in config.ranges or name in state.peers:
            found.append((x, y))
        elif name in state.team.robots and name != config.robot:
            gone.append((x, y))  # it may have left that place
        if name == state.team.origin and name != config.robot:
            first = np.array([(x, y)])
    places = np.array(found or gone, np.float64).reshape(-1, 2)
    return places, places if first is None else first


def _on_way(state: TeamState) -> TeamState:
    """Return `state` on the way past the next anchor, once a loop has ranges to one with a position alone.

    While there are ranges to that anchor, its place is estimated again.
    """
    mission, anchors = state.config.mission, state.team.anchors
    entries, rooms = state.log.logs[state.own], dict[int, list[tuple[int, float]]]()
    for tick, entry in enumerate(entries):
        for one in entry.anchors:
            if anchors[one.to].position is not None:
                rooms.setdefault(one.to, []).append((tick, one.range))
    if len(entries) <= loop_ticks(mission, state.own) or not rooms:
        return state
    first = max(rooms, key=lambda anchor: (len(rooms[anchor]), -anchor))
    known = [one for one in anchors if one.id in state.config.ranges]
    distance = nearest_other(anchors[first], known)
    if distance is None or (state.way is not None and rooms[first][-1][0] < state.tick):
        return state
    driven = [one.executed for one in entries if one.executed is not None]
    v, omega = (np.array([getattr(one, name) for one in driven]) + 0.0 for name in ("v", "omega"))
    path = track(v, omega, mission.period)
    alone = near_anchors((path,), (rooms[first],), ((0.0, 0.0),), mission.noise, mission.sensing_range)
    found = of_anchor((), alone.alone(0))
    if not found:
        return state
    start = found[0].fit.start.poses[0].tolist()
    orbit = way_past(mission, distance)
    since = state.tick if state.way is None else state.way.since
    return replace(state, way=Way(Pose(-start[0], -start[1], 0.0), orbit, since))


def _along(state: TeamState, way: Way) -> Controls:
    """Return the controls that lead to the way and along it. Each lap is aside of the last one."""
    mission, orbit = state.config.mission, way.orbit
    lap = int((state.tick - way.since) * mission.period * orbit.omega / (1.25 * TAU))
    radius = max(orbit.radius + LAPS[lap % len(LAPS)] * mission.sensing_range, 0.3 * mission.sensing_range)
    omega = min(mission.max_turn_rate, mission.max_speed / radius)
    local = Pose(state.odometry.x - way.centre.x, state.odometry.y - way.centre.y, state.odometry.heading)
    return pursuit(local, Orbit(radius, omega * radius, omega), mission)
