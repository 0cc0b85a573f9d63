"""A robot of a group: it meets one robot after another, and in each meeting the two are a pair.

The first meeting localises the robot. In a later one it visits a robot that waits beside its anchor. Both
determine their poses from the logs and ranges of the two of them alone, so no robot has to believe what
another one has concluded, and no measurement counts twice.

Nobody leads. Each robot follows the meetings of its configuration. One that has made its visits goes to
those that should be localised by then and have not reported it; one that waits meets whoever comes. If the
first pair has failed, another one meets in its place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import replace

from agent.planning import exchange, group_transitions, sweep_transitions, visit
from agent.planning.active_sensing import Retreating
from agent.planning.group_state import GroupState
from agent.planning.log_exchange import LogPlanner
from agent.planning.phase2_orbit import Aligning, Orbiting, Radial, Travelling
from agent.planning.planner import Planner, Summary
from agent.planning.range_seeking import Homing
from agent.planning.separation import slowed
from agent.planning.state import MODE_NAMES, UNCONFIRMED, Done, RobotState
from protocol.messages import (
    Command,
    Estimate,
    Inconsistent,
    Localised,
    Observation,
    Ranged,
    Report,
    ReportedPose,
    RobotConfig,
    Undecided,
)
from protocol.mission import Mission
from protocol.motion import Controls, compose

TRAVELLING_MODE = MODE_NAMES[Travelling]
"""The mode of a robot that is localised, and drives to another one."""


class GroupPlanner(Planner[GroupState, Report]):
    """The planner of a robot in a group, which leaves each meeting to the planner of a pair."""

    BODY = Report

    def __init__(self, pair_planner: LogPlanner) -> None:
        """`pair_planner` decides in each meeting."""
        self.pair_planner = pair_planner
        self.REQUIRED_PLACES = pair_planner.REQUIRED_PLACES

    # --- decisions ---

    def start(self, config: RobotConfig) -> GroupState:
        """Return the state of a robot that has measured nothing yet."""
        return GroupState(self.pair_planner.start(config))

    def observe(self, state: GroupState, observation: Observation) -> GroupState:
        """Return `state` with the sensor data of one tick, ranges to all robots of the group included."""
        pair = self.pair_planner.observe(state.pair, observation)
        if pair.in_contact and (state.alone or group_transitions.refused(state, pair.config.peer)):
            pair = replace(pair, in_contact=False)
        for contact in observation.contacts:
            if contact.peer != pair.config.peer and contact.range is not None:
                other = state.other(contact.peer)
                ranges = (*other.mutual, Ranged(observation.tick, contact.range))
                state = state.with_other(contact.peer, replace(other, mutual=ranges))
        if state.visiting and _is_out_of_range_again(state.pair, pair):
            pair = replace(pair, mode=Travelling(visit.stop(state.frame, pair)))
        state = group_transitions.passing_others(replace(state, pair=pair), observation.contacts)
        if isinstance(state.pair.mode, Travelling) and not pair.in_contact and not state.passing.places:
            state = visit.searching(state)
        ended = isinstance(state.pair.mode, Done)
        return replace(
            state,
            unmet=state.unmet + 1 if ended and not pair.in_contact else 0,
            lingering=state.lingering + 1 if ended and pair.in_contact else 0,
        )

    def report(self, state: GroupState) -> Report:
        """Return the report to the peer of the present meeting."""
        return exchange.report(state.pair)

    def report_to(self, state: GroupState, peer: str) -> Report:
        """Return the report to `peer`: the log, or outside a meeting only this robot's verdict.

        A robot without an anchor gets the pose of a localised one until it has determined its own by it.
        Until this robot is localised, one with which its meeting has failed gets the verdict of that meeting.
        """
        if group_transitions.refused(state, peer):
            return exchange.report_without_log(state.pair, state.failure)
        if peer == state.pair.config.peer and state.meets:
            return exchange.report(state.pair)
        without_log = exchange.report_without_log(state.pair, state.verdict)
        if not (sweep_transitions.is_helped(state, peer) and isinstance(state.verdict, Localised)):
            return without_log
        pose = exchange.reported_pose(state.pair, state.frame)
        return replace(without_log, prior=ReportedPose(state.pair.tick, pose))

    def decide(self, state: GroupState, reports: Sequence[Report] = ()) -> GroupState:
        """Return `state` with the `reports` of others, and in the next meeting if this one has ended."""
        for one in reports:
            state = self.with_sender(state, one)
        anchored = [one.robot for one in state.config.members]
        logs = [one for one in reports if one.has_log and one.robot in anchored]  # others are in no meeting
        state = group_transitions.answering(
            state, [one.robot for one in logs if one.state == TRAVELLING_MODE]
        )
        peer, before = state.pair.config.peer, state.pair
        alone = not state.meets or group_transitions.refused(state, peer)
        of_peer = [] if alone else [one for one in logs if one.robot == peer]
        pair = self.pair_planner.decide(before, of_peer)
        if before.verdict is None and pair.verdict is not None and pair.belief.phase1_done_tick is None:
            return group_transitions.without_peer(state, pair.verdict)
        silence = state.silence + 1 if pair.in_contact and not of_peer else 0
        state = replace(state, pair=pair, silence=silence)
        if isinstance(pair.verdict, Localised) and before.verdict is None:
            state = self.with_pose(state, pair.verdict)
        refusals = [one for one in reports if one.robot == peer and not one.has_log]
        has_failed = any(isinstance(one.verdict, Inconsistent | Undecided) for one in refusals)
        if pair.verdict is None and not alone and has_failed:
            return group_transitions.after_refusal(state)
        # exact robots claim within a tick of each other, and wait for each other's verdict
        left = any(
            one.state == UNCONFIRMED or (isinstance(one.verdict, Localised) and one.verdict.covariance)
            for one in refusals
        )
        return group_transitions.onward(state, peer_has_left=left or has_failed)

    def command(self, state: GroupState) -> Command:
        """Return the command for the next tick, with the phase, the mode and the robot's verdict."""
        rests, config = group_transitions.rests(state), state.config
        meets = state.meets and not rests
        command = replace(
            self.pair_planner.command(state.pair),
            verdict=state.verdict,
            peer=config.peer if meets else None,
            role=config.role if meets else None,
            rests=rests,
        )
        if state.passing.leeway == math.inf:
            return command
        controls = slowed(Controls(command.v, command.omega), state.passing.leeway, state.config.mission)
        return replace(command, v=controls.v, omega=controls.omega)

    def estimate(self, state: GroupState) -> Estimate:
        """Return all poses that the robot considers possible in its anchor's frame and in <W>.

        Once it is localised, there is one. On the way to another robot, it has no covariance, because the
        planner does not compute how the noise of the odometry adds up.
        """
        estimate, latest = exchange.estimate(state.pair), state.pair.verdict
        if state.fix is None:
            return estimate
        return replace(
            estimate,
            world=(compose(state.frame, state.pair.odometry),),
            localised=isinstance(state.verdict, Localised),
            probabilities=(),
            covariance=latest.covariance if isinstance(latest, Localised) else None,
        )

    # --- what a subclass decides otherwise ---

    def with_sender(self, state: GroupState, report: Report) -> GroupState:
        """Return `state` with what `report` says about its sender: whether it travels or is localised."""
        return with_sender(state, report)

    def with_pose(self, state: GroupState, pose: Localised) -> GroupState:
        """Return `state` of a robot that has determined its `pose` in the present meeting, and claims it."""
        peer = state.config.peer
        state = state.with_other(peer, replace(state.other(peer), localised=True))
        state = group_transitions.with_claim(state, pose)
        if state.fix is None:
            return state
        return state if state.verdict is not None else replace(state, verdict=pose)

    # --- optional ---

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log in a report is malformed, or None."""
        return self.pair_planner.malformed(body)

    def summary(self, state: GroupState) -> Summary:
        """Return the numbers of the latest meeting, but those of ranges and reports for all of them."""
        return replace(self.pair_planner.summary(state.pair), mutual_ranges=None, reports_heard=None)

    def misreport(self, body: Report, observations: Sequence[Observation]) -> str | None:
        """Return how the manoeuvres and ranges in a report differ from the robot's own; None if not."""
        return self.pair_planner.misreport(body, observations)

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return self.pair_planner.required_mutual_ranges(mission)


def _is_out_of_range_again(before: RobotState, after: RobotState) -> bool:
    """Return whether a visitor has lost the robot that it visits, and the planner of a pair leads it away.

    That planner sends a robot to its orbit, or back to its own anchor, which may be far from here.
    """
    back = isinstance(before.mode, Retreating) and isinstance(after.mode, Homing)
    return back or isinstance(after.mode, Aligning | Radial | Orbiting)


def with_sender(state: GroupState, report: Report) -> GroupState:
    """Return `state` with what `report` says about its sender: whether it travels, is localised or served."""
    known, travels = state.other(report.robot), report.state == TRAVELLING_MODE
    localised = known.localised or travels or (not report.has_log and isinstance(report.verdict, Localised))
    served = known.served or report.state == UNCONFIRMED
    if (travels, localised, served) == (known.travels, known.localised, known.served):
        return state
    return state.with_other(report.robot, replace(known, travels=travels, localised=localised, served=served))
