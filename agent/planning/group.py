"""A robot of a group: it meets one robot after another, and in each meeting the two are a pair.

The first meeting localises the robot. In a later one it visits a robot that waits beside its anchor. Both
determine their poses from the logs and ranges of the two of them alone, so no robot has to believe what
another one has concluded, and no measurement counts twice.

Nobody leads. Each robot follows the meetings of its configuration. One that has made its visits goes to
those that should be localised by then and have not reported it; one that waits meets whoever comes. If the
first pair has failed, another one meets in its place. If robots may report false data, those that are
localised make visits to confirm poses (`confirmation`).
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.planning import (
    appointments,
    confirmation,
    exchange,
    meetings,
    plausibility,
    searching,
    travelling,
)
from agent.planning.exchange import LogPlanner
from agent.planning.meeting_planner import MeetingPlanner
from agent.planning.planner import Planner, Summary
from agent.planning.state import RobotState
from agent.planning.tasks import UNCONFIRMED, Deciding, Done, Homing, Orbital, Retreating, Travelling
from protocol.messages import (
    Command,
    Estimate,
    Inconsistent,
    Localised,
    Observation,
    Report,
    RobotConfig,
    Undecided,
)
from protocol.mission import Mission
from protocol.motion import Controls, compose


class GroupPlanner(Planner[RobotState, Report]):
    """The planner of a robot in a group, which leaves each meeting to the planner of a pair.

    A robot without an anchor has one meeting, in which it is found (`unanchored`).
    """

    BODY = Report

    def __init__(self, pair_planner: LogPlanner | MeetingPlanner) -> None:
        """`pair_planner` decides in each meeting."""
        self.pair_planner = pair_planner
        self.REQUIRED_PLACES = pair_planner.REQUIRED_PLACES

    # --- decisions ---

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet."""
        return self.pair_planner.start(config)

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the sensor data of one tick, ranges to all robots of the group included."""
        before, state = state, self.pair_planner.observe(state, observation)
        if state.in_contact and (before.alone or appointments.refused(before, state.config.peer)):
            state = replace(state, in_contact=False)
        if state.visiting and _is_out_of_range_again(before, state):
            state = state.doing(Travelling(travelling.stop(state)))
        state = travelling.onward(state, observation.contacts)
        if isinstance(state.task, Travelling) and not state.in_contact and not state.passing.places:
            state = travelling.searching(state)
        lasting = state.parting if state.in_contact == before.in_contact else 0
        parting = lasting + 1 if isinstance(state.task, Done) else 0
        return state if parting == state.parting else replace(state, parting=parting)

    def report(self, state: RobotState) -> Report:
        """Return the report to the peer of the present meeting."""
        return self.pair_planner.report(state)

    def report_to(self, state: RobotState, peer: str) -> Report:
        """Return the report to `peer`: the log, or outside a meeting what others need to know.

        Until this robot is localised, one with which its meeting has failed gets the verdict of that meeting.
        """
        if (found := state.found) is not None and not searching.takes_part(state):
            return found.answered(exchange.report_without_log(state, state.robot_verdict), peer)
        if searching.is_helped(state, peer):
            return searching.outside_meeting(state, peer)
        if appointments.refused(state, peer):
            report = exchange.report_without_log(state, state.failure)
        elif (state.meets and peer == state.config.peer) or peer == searching.beacon(state):
            return self.report(state)
        else:
            report = searching.outside_meeting(state, peer)
        unconfirmed = state.config.confirms and state.fix is not None and report.verdict is None
        return replace(report, state=UNCONFIRMED) if unconfirmed else report

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the `reports` of others, and in the next meeting if this one has ended."""
        if state.found is not None:
            return self.pair_planner.decide(state, reports)
        for one in reports:
            state = meetings.with_sender(state, one)
        if searching.is_apart(state):
            return self._apart(state, reports)
        state = self._met(state, reports)
        return confirmation.onward(state) if state.config.confirms else state

    def _met(self, state: RobotState, reports: Sequence[Report]) -> RobotState:
        """Return `state` with the decisions of the present meeting, or in the next one if it has ended."""
        anchored = [one.robot for one in state.config.members]
        logs = [one for one in reports if one.has_log and one.robot in anchored]  # others are in no meeting
        visitors = [one.robot for one in logs if one.state == Travelling.name]
        before = meetings.answering(state, visitors)
        peer = before.config.peer
        alone = not before.meets or appointments.refused(before, peer)
        of_peer = [] if alone else [one for one in logs if one.robot == peer]
        state = self.pair_planner.decide(before, of_peer)
        if before.verdict is None and state.verdict is not None and state.own_anchor.done_tick is None:
            return appointments.parted(before, state.verdict)  # it goes on with phase 1
        silence = state.silence + 1 if state.in_contact and not of_peer else 0
        if silence != state.silence:
            state = replace(state, silence=silence)
        if isinstance(state.verdict, Localised) and before.verdict is None:
            state = meetings.with_pose(state, state.verdict)
        refusals = [one for one in reports if one.robot == peer and not one.has_log]
        has_failed = any(isinstance(one.verdict, Inconsistent | Undecided) for one in refusals)
        if state.verdict is None and not alone and has_failed:
            return meetings.after_refusal(state)
        # exact robots claim within a tick of each other, and wait for each other's verdict
        left = any(
            one.state == UNCONFIRMED or (isinstance(one.verdict, Localised) and one.verdict.covariance)
            for one in refusals
        )
        return meetings.onward(state, peer_has_left=left or has_failed)

    def _apart(self, state: RobotState, reports: Sequence[Report]) -> RobotState:
        """Return `state` of a robot that is in no meeting, with the `reports` of others, and one tick on."""
        for one in reports:
            state = state.with_other(one.robot, acknowledged=one.heard)  # if overtaken, more is sent again
        of_peer = [one for one in reports if one.has_log and one.robot == state.config.peer]
        heard = plausibility.with_reports(state, of_peer, self.pair_planner.rendezvous)
        if heard.verdict == state.verdict:
            state = heard
        return meetings.onward(state) if state.covers else state

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the robot's verdict."""
        rests, config = meetings.rests(state), state.config
        meets = state.meets and not rests
        command = self.pair_planner.command(state)
        verdict = state.robot_verdict
        unconfirmed = config.confirms and verdict is None and isinstance(state.verdict, Localised)
        controls = travelling.limited(Controls(command.v, command.omega), state.passing, config.mission)
        return replace(
            command,
            v=controls.v,
            omega=controls.omega,
            task=UNCONFIRMED if unconfirmed else command.task,
            verdict=verdict,
            peer=config.peer if meets else None,
            role=config.role if meets else None,
            rests=rests,
        )

    def estimate(self, state: RobotState) -> Estimate:
        """Return the robot's pose under each hypothesis, in its anchor's frame and in <W>.

        Once it is localised, there is one. On the way to another robot, it has no covariance, because the
        planner does not compute how the noise of the odometry adds up.
        """
        estimate, latest = self.pair_planner.estimate(state), state.verdict
        if state.fix is None:
            return estimate
        return replace(
            estimate,
            world=(compose(state.frame, state.odometry),),
            localised=isinstance(state.robot_verdict, Localised),
            probabilities=(),
            covariance=latest.covariance if isinstance(latest, Localised) else None,
        )

    # --- optional ---

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log in a report is malformed, or None."""
        return self.pair_planner.malformed(body)

    def summary(self, state: RobotState) -> Summary:
        """Return the numbers of the latest meeting, but those of ranges and reports for all of them."""
        return replace(self.pair_planner.summary(state), mutual_ranges=None, reports_heard=None)

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
    back = isinstance(before.task, Retreating) and isinstance(after.task, Homing)
    left = isinstance(after.task, Deciding) and not after.in_contact
    return back or left or isinstance(after.task, Orbital)
