"""A planner of the user in the meetings of a group: the group brings robots into contact, it decides there.

It has a state of its own, and reports of its own. To each report, the group adds what it has to know: whether
the robot travels, and its verdict. On the way to another robot, the planner's commands are not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from agent.peer import peer_state
from agent.planning import drive, exchange
from agent.planning.planner import Planner, Summary, decoded
from agent.planning.state import RobotState
from agent.planning.tasks import Asleep, Deciding, Done, Travelling
from protocol.messages import Command, Estimate, Observation, Report, RobotConfig
from protocol.mission import Mission
from protocol.motion import Controls
from protocol.wire import MalformedFrame


class MeetingPlanner(Planner[RobotState, Report]):
    """The planner `planner` of the user, as the planner of a pair that `GroupPlanner` calls."""

    BODY = Report

    def __init__(self, planner: Planner[Any, Any]) -> None:
        """`planner` defines `meet`."""
        self._planner = planner
        self.REQUIRED_PLACES = planner.REQUIRED_PLACES

    # --- decisions ---

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet."""
        return RobotState(config, own_state=(0, self._planner.start(config)))

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the sensor data of one tick; the planner of the user gets those of its peer."""
        state = exchange.observed(state, observation)
        contacts = tuple([one for one in observation.contacts if one.peer == state.config.peer])
        own = self._planner.observe(self._own(state), replace(observation, contacts=contacts))
        return replace(state, own_state=(state.meeting, own))

    def report(self, state: RobotState) -> Report:
        """Return the report to the peer: that of the user's planner, and what the group has to know."""
        body = self._planner.report_to(self._own(state), state.config.peer)
        return Report(
            state.tick,
            state.config.robot,
            phase=state.phase,
            state=state.task.name,
            heard=max(state.peer_state.latest, 0),
            verdict=state.verdict,
            body=msgspec.msgpack.encode(body),
        )

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports`, and with the phase and verdict of the user's planner."""
        peer = state.peer_state
        for one in reports:
            peer = peer_state.with_report(peer, one)
        bodies = [decoded(one, self._planner) for one in reports if one.body is not None]
        own = self._planner.decide(self._own(state), bodies)
        state = replace(state, peer_state=peer, own_state=(state.meeting, own))
        if isinstance(state.task, Done) or (isinstance(state.task, Travelling) and not state.in_contact):
            return state
        command, known = self._planner.command(own), state.own_anchor
        if known.done_tick is None and (command.phase > 1 or command.verdict is not None):
            state = replace(state, own_anchor=replace(known, done_tick=state.tick))
        if command.verdict is not None:
            return state.doing(Done(command.phase, command.verdict))
        return state.doing(Deciding(command.phase, command.task))

    def command(self, state: RobotState) -> Command:
        """Return the command of the user's planner; on the way to another robot, that of the group."""
        decides = isinstance(state.task, Asleep | Deciding)
        if isinstance(state.task, Done):
            decides = state.in_contact  # the peer may need further ranges
        if not decides:
            return drive.command(state, drive.controls(state))
        command = self._planner.command(self._own(state))
        return drive.command(state, Controls(command.v, command.omega))

    def estimate(self, state: RobotState) -> Estimate:
        """Return the estimate of the user's planner."""
        return self._planner.estimate(self._own(state))

    def _own(self, state: RobotState) -> Any:
        """Return the state of the user's planner in the present meeting."""
        number, own = state.own_state
        return own if number == state.meeting else self._planner.meet(own, state.config)

    # --- optional ---

    def malformed(self, body: Report) -> str | None:
        """Return why a received report is refused: the group's part, or the body."""
        if body.body is None:
            return None if not body.has_log else "a log, and this robot's planner has reports of its own"
        try:
            return self._planner.malformed(decoded(body, self._planner))
        except MalformedFrame as error:
            return str(error)

    def summary(self, state: RobotState) -> Summary:
        """Return the numbers of the user's planner."""
        return self._planner.summary(self._own(state))

    def misreport(self, body: Report, observations: Sequence[Observation]) -> str | None:
        """Return how a report contradicts the robot's own measurements; None if it does not."""
        if body.body is None:
            return None
        return self._planner.misreport(decoded(body, self._planner), observations)

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return self._planner.required_mutual_ranges(mission)
