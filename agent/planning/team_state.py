"""The knowledge of a robot of a team: the measurements of all, their poses, and its claim."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from agent.estimation.claim import CONDITIONS, WITHOUT_FITS, blocked
from agent.estimation.following import ClaimRule, Following
from agent.estimation.gaussian.claim_agreement import agreed
from agent.estimation.gaussian.joint_claims import undetermined
from agent.estimation.gaussian.search import position_sigma
from agent.estimation.posterior import Hypothesis, certainties, with_other_poses
from agent.estimation.team_measurements import TeamMeasurements
from agent.peer.team_log import TeamLog
from agent.planning.state import Bypass
from protocol.coverage_strips import Place
from protocol.messages import Localised, RobotConfig, SurveyedAnchor, Team, Undecided, Verdict
from protocol.mission import Anchor
from protocol.motion import ORIGIN, REST, Controls, Pose, compose, relative, wrap
from protocol.orbits import Orbit

UNMET = "it has reported nothing"
"""The reason against a claim by the measurements of a robot that there are none of."""

PHASES = {"searching": 2, "orbiting": 2, "surveying": 3, "localised": 3, "undecided": 3}
"""The phase of the paper to which a task corresponds; 1 for all others."""

MOST_SIGMA = 1e6
"""The largest sigma (m) of an anchor that is stated."""


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
    """The shortest range of this robot to an anchor or to another robot, and where it measured that."""

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
    apart: Mapping[str, float] = {}
    """The distance (m) to each robot in contact: its range, or what the latest one admits at least."""
    passing: Bypass = Bypass()
    """The way past robots that are near, if the mission has a safety distance."""
    nearest: tuple[Near, ...] = ()
    """The place where the robot was nearest to each robot of the team, then to each anchor."""
    joint: TeamEstimate = TeamEstimate(why_not="it has not moved yet")
    """The estimate by all measurements; in a team that tolerates false data, by the own ones alone."""
    pairs: tuple[TeamEstimate, ...] = ()
    """The estimates by these and the measurements of each other robot, in such a team."""
    wanted: tuple[str, ...] = ()
    """The anchors that are not accurate enough yet, the least accurate one first."""
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

    @property
    def following(self) -> Following:
        """The estimate of all poses."""
        return self.joint.following

    @property
    def place(self) -> int | None:
        """The index of this robot in the fits; None if it is not located."""
        part = self.following.part
        if part is None or self.config.robot not in part.robots or not self.following.known.hypotheses:
            return None
        return part.robots.index(self.config.robot)

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """The hypotheses with different poses of this robot, likeliest first; none if it is not located."""
        return with_other_poses(self.following.known, self.place) if self.place is not None else []

    @property
    def unverified_anchors(self) -> dict[str, str]:
        """The anchors of which no range tells whether they stand elsewhere, and why; none before a claim."""
        tested = self.following.displacements if isinstance(self.verdict, Localised) else ()
        accuracy = self.config.mission.accuracy
        return {one.anchor: reason for one in tested if (reason := one.unverified(accuracy))}

    @property
    def waiting_here(self) -> bool:
        """True if another robot in contact has no result, as far as this one knows."""
        return any(self.team.robots[one] in self.apart for one in self.waiting)

    @property
    def phase(self) -> int:
        """The phase of the paper to which the task corresponds."""
        return PHASES.get(self.doing, 1)

    def doing_next(self, doing: str, controls: Controls | None) -> TeamState:
        """Return this with another task, and its controls; None: it stands still."""
        return replace(self, doing=doing, controls=controls or REST)


def followed(state: TeamState) -> TeamState:
    """Return `state` with the estimate by all measurements so far."""
    own, logs = state.own, state.log.logs
    joint = _estimated(state, state.joint, (own,) if state.config.tolerates else None)
    wanted = _wanted(joint.following, state.team, state.config.mission.confidence)
    if wanted and not joint.why_not:
        joint = joint._replace(why_not=f"anchor {wanted[0]} is not known to {state.team.survey:g} m yet")
    elif state.team.survey and not joint.why_not:
        found = blocked(joint.following.judged[state.config.robot])
        joint = joint._replace(why_not=found.reason if found is not None else "")
    pairs = [
        _estimated(state, pair, (own, k)) if k != own and logs[k] else pair
        for k, pair in enumerate(state.pairs)
    ]
    return replace(state, joint=joint, wanted=wanted, pairs=tuple(pairs))


def _estimated(state: TeamState, before: TeamEstimate, of: Collection[int] | None) -> TeamEstimate:
    """Return the estimate that goes on from the one `before`, by the measurements `of` robots; None: all."""
    mission, robot = state.config.mission, state.config.robot
    measured = before.measured.grown(state.log, state.team, mission, of)
    conditions = WITHOUT_FITS if state.team.survey else CONDITIONS
    rule = ClaimRule(mission.accuracy, mission.confidence, conditions)
    used = measured.joint(state.team, mission)
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


def claimed(state: TeamState) -> TeamState:
    """Return `state` with a verdict, if there is one now."""
    if not state.joint.why_not:
        return _with_verdict(state, state.following.judged[state.config.robot].localised)
    claiming = [pair.following for pair in state.pairs if not pair.why_not]
    claims = [one.judged[state.config.robot].localised for one in claiming]
    if (found := agreed(claims, state.config.tolerates, state.config.mission)) is not None:
        claim, chosen = found
        joint = state.joint._replace(following=claiming[chosen[-1]])
        return _with_verdict(replace(state, joint=joint), claim)
    late = state.tick * state.config.mission.period >= state.config.gives_up
    if late or state.following.displacement_confirmed:
        return _with_verdict(state, Undecided(state.joint.why_not))
    return state


def _with_verdict(state: TeamState, verdict: Verdict) -> TeamState:
    done = state.log.done | {state.own}
    return replace(state, verdict=verdict, log=replace(state.log, done=done))


def in_world(state: TeamState, hypothesis: Hypothesis) -> Pose:
    """Return the pose of this robot in <W> under a hypothesis, moved by the odometry since its fit."""
    part, place = state.following.part, state.place
    assert part is not None
    assert place is not None
    x, y, heading = hypothesis.fit.poses[place].tolist()
    at = Pose(part.origin[0] + x, part.origin[1] + y, wrap(heading))
    path = part.paths[place]
    before = Pose(float(path.x[-1]), float(path.y[-1]), float(path.heading[-1]))
    return at if state.verdict is None else compose(at, relative(before, state.odometry))


def located_anchors(state: TeamState) -> tuple[SurveyedAnchor, ...]:
    """Return the anchors that are not surveyed, as far as they are located."""
    part, known = state.following.part, state.following.known.hypotheses
    if part is None or not known:
        return ()
    fit, (x, y) = known[0].fit, part.origin
    places = [(k, *one) for k, one in enumerate((fit.poses[:, :2] + (x, y)).tolist()) if part.is_anchor(k)]
    sigmas = {k: min(position_sigma(fit, k), MOST_SIGMA) for k, *_ in places}
    return tuple([SurveyedAnchor(part.robots[k], Anchor(*at), sigmas[k]) for k, *at in places])
