"""A robot of a group: it meets one robot after another, and in each meeting the two are a pair.

The first meeting localises the robot. In a later one it visits a robot that waits beside its anchor. Both
determine their poses from the logs and ranges of the two of them alone, so no robot has to believe what
another one has concluded, and no measurement counts twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import replace

from agent.estimation.knowledge import Belief
from agent.planning import exchange
from agent.planning.log_exchange import LogPlanner
from agent.planning.phase2_orbit import Aligning, Orbiting, Radial, Travelling, next_side, travel_controls
from agent.planning.planner import Planner, Summary
from agent.planning.state import Done, RobotState
from protocol.messages import (
    Command,
    Estimate,
    Localised,
    Meeting,
    Observation,
    Ranged,
    Report,
    RobotConfig,
    RobotConfigInGroup,
    Verdict,
)
from protocol.mission import Mission
from protocol.motion import ORIGIN, Pose, compose, inverse

SHORT_OF_ANCHOR = 0.5
"""The distance from the visited robot's anchor at which a visitor stops, as a fraction of R.

The robot waits R / 8 from its anchor, so it is in range there; and on the anchor, the ranges to it would not
depend on where it waits.
"""

PARTED_AFTER = 8
"""The ticks out of range of a peer after which a robot whose meeting has ended goes on.

As long as it has not heard of the peer's verdict, it waits for it. A peer that goes on has heard this
robot's verdict before.
"""


class Earlier(msgspec.Struct, frozen=True):
    """What a robot keeps of one with which it is not in a meeting."""

    mutual: tuple[Ranged, ...] = ()
    """The ranges to it."""
    verdict: Verdict | None = None
    """This robot's verdict in their meeting; None if there was none."""


class GroupState(msgspec.Struct, frozen=True):
    """The state of a robot of a group."""

    pair: RobotState
    """The state in the present meeting. Its configuration names the peer and the role."""
    met: int = 0
    """The number of meetings that have ended."""
    verdict: Verdict | None = None
    """The verdict of the first meeting, which is the robot's."""
    frame: Pose = ORIGIN
    """The pose in <W> of the odometry's frame, from the latest meeting in which the robot was localised."""
    others: Mapping[str, Earlier] = {}
    """What the robot keeps of each other robot that it has been in range of."""
    unmet: int = 0
    """The number of consecutive ticks out of range of the peer since this robot's verdict in the meeting."""

    @property
    def later_meetings(self) -> tuple[Meeting, ...]:
        """The meetings after the first one."""
        config = self.pair.config
        return config.later_meetings if isinstance(config, RobotConfigInGroup) else ()


class GroupPlanner(Planner[GroupState, Report]):
    """The planner of a robot in a group, which leaves each meeting to the planner of a pair."""

    BODY = Report

    def __init__(self, pair_planner: LogPlanner) -> None:
        """`pair_planner` decides in each meeting."""
        self._pair = pair_planner
        self.REQUIRED_PLACES = pair_planner.REQUIRED_PLACES

    @property
    def pair_planner(self) -> LogPlanner:
        """The planner of each meeting."""
        return self._pair

    # --- decisions ---

    def start(self, config: RobotConfig) -> GroupState:
        """Return the state of a robot that has measured nothing yet."""
        return GroupState(self._pair.start(config))

    def observe(self, state: GroupState, observation: Observation) -> GroupState:
        """Return `state` with the sensor data of one tick, ranges to all robots of the group included."""
        pair = self._pair.observe(state.pair, observation)
        if state.met and isinstance(pair.mode, Aligning | Radial | Orbiting):  # out of range again
            pair = replace(pair, mode=Travelling(_stop(state.frame, pair)))
        others = state.others
        for contact in observation.contacts:
            if contact.peer != pair.config.peer and contact.range is not None:
                known = others.get(contact.peer, Earlier())
                ranges = (*known.mutual, Ranged(observation.tick, contact.range))
                others = {**others, contact.peer: replace(known, mutual=ranges)}
        if isinstance(pair.mode, Travelling) and not pair.in_contact:
            pair = _searching(pair)
        ended = isinstance(pair.mode, Done) and not pair.in_contact
        return replace(state, pair=pair, others=others, unmet=state.unmet + 1 if ended else 0)

    def report(self, state: GroupState) -> Report:
        """Return the report to the peer of the present meeting."""
        return exchange.report(state.pair)

    def report_to(self, state: GroupState, peer: str) -> Report:
        """Return the report to `peer`: the log, or without a meeting only the verdict of an earlier one."""
        if peer == state.pair.config.peer:
            return exchange.report(state.pair)
        verdict = state.others[peer].verdict if peer in state.others else None
        return exchange.report_without_log(state.pair, verdict)

    def decide(self, state: GroupState, reports: Sequence[Report] = ()) -> GroupState:
        """Return `state` with the peer's `reports`, and in the next meeting if the present one has ended."""
        peer = state.pair.config.peer
        pair = self._pair.decide(state.pair, [one for one in reports if one.robot == peer])
        frame = state.frame
        if isinstance(pair.verdict, Localised) and state.pair.verdict is None:
            frame = compose(pair.verdict.pose, inverse(pair.odometry))
        verdict = pair.verdict if state.verdict is None else state.verdict
        state = replace(state, pair=pair, verdict=verdict, frame=frame)
        if isinstance(pair.mode, Done) and isinstance(state.verdict, Localised) and _is_over(state):
            return _next_meeting(state)
        return state

    def command(self, state: GroupState) -> Command:
        """Return the command for the next tick, with the phase, the mode and the robot's verdict."""
        return replace(self._pair.command(state.pair), verdict=state.verdict)

    def estimate(self, state: GroupState) -> Estimate:
        """Return all poses that the robot considers possible in its anchor's frame and in <W>.

        Once it is localised, there is one.
        """
        estimate = exchange.estimate(state.pair)
        if not isinstance(state.verdict, Localised):
            return estimate
        return replace(
            estimate,
            world=(compose(state.frame, state.pair.odometry),),
            localised=True,
            probabilities=(),
            covariance=state.verdict.covariance,
        )

    # --- optional ---

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log in a report is malformed, or None."""
        return self._pair.malformed(body)

    def summary(self, state: GroupState) -> Summary:
        """Return the numbers of the latest meeting, but those of ranges and reports for all of them."""
        return replace(self._pair.summary(state.pair), mutual_ranges=None, reports_heard=None)

    def misreport(self, body: Report, observations: Sequence[Observation]) -> str | None:
        """Return how the manoeuvres and ranges in a report differ from the robot's own; None if not."""
        return self._pair.misreport(body, observations)

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return self._pair.required_mutual_ranges(mission)


def _searching(pair: RobotState) -> RobotState:
    """Return `pair`, a visitor out of range; if it has arrived, on the next side of the search."""
    assert isinstance(pair.mode, Travelling)
    mission, tolerance = pair.config.mission, pair.estimator.pose_tolerance
    if travel_controls(pair.mode, pair.odometry, mission, tolerance) is not None:
        return pair
    return replace(pair, mode=next_side(pair.mode, mission))


def _is_over(state: GroupState) -> bool:
    """Return whether the robot may leave its meeting: the peer has its verdict, or has left before."""
    return state.pair.peer_state.verdict is not None or state.unmet >= PARTED_AFTER


def _next_meeting(state: GroupState) -> GroupState:
    """Return `state` on the way to the next robot; at rest if there is none."""
    pair = state.pair
    if state.met >= len(state.later_meetings):
        return state
    meeting = state.later_meetings[state.met]
    config = pair.config
    assert isinstance(config, RobotConfigInGroup)
    known = state.others.get(config.peer, Earlier())
    others = {**state.others, config.peer: replace(known, mutual=pair.mutual, verdict=pair.verdict)}
    belief = pair.belief
    visitor = RobotState(
        config.at(meeting),
        tick=pair.tick,
        odometry=pair.odometry,
        log=pair.log,
        leg=pair.leg,
        mutual=others[meeting.peer].mutual if meeting.peer in others else (),
        belief=Belief(
            possible=belief.possible,
            branch=belief.branch,
            branch_kind=belief.branch_kind,
            phase1_done_tick=belief.phase1_done_tick,
            own_anchor=belief.own_anchor,
            own=belief.own,
            branches=belief.branches,
            ranges_at_last_fit=belief.ranges_at_last_fit,
        ),
    )
    return GroupState(
        pair=replace(visitor, mode=Travelling(_stop(state.frame, visitor))),
        met=state.met + 1,
        verdict=state.verdict,
        frame=state.frame,
        others=others,
    )


def _stop(frame: Pose, pair: RobotState) -> tuple[float, float]:
    """Return the place of a visit, in m in the odometry's frame: on the way to the anchor, but short of it."""
    peer_anchor = pair.config.peer_anchor
    anchor = compose(inverse(frame), Pose(peer_anchor.x, peer_anchor.y, 0.0))
    dx, dy = anchor.x - pair.odometry.x, anchor.y - pair.odometry.y
    distance = math.hypot(dx, dy)
    short = SHORT_OF_ANCHOR * pair.config.mission.sensing_range
    share = 1.0 - short / distance if distance > short else 0.0
    return pair.odometry.x + share * dx, pair.odometry.y + share * dy
