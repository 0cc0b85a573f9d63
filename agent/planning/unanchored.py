"""A robot of a group without an anchor: it waits until a localised robot finds it.

How it determines its pose depends on what its finder reports: an exact pose (`resected`), or one with a
covariance (`contacted`). Once localised, it may look for others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from agent.estimation.claim import is_definite
from agent.estimation.compiled import library
from agent.estimation.judged import sufficient_mutual_ranges
from agent.planning import coverage, meetings, searching
from agent.planning.contacted import Contacted
from agent.planning.exchange import LogPlanner
from agent.planning.planner import Summary
from agent.planning.resected import Resected
from agent.planning.state import RobotState
from agent.planning.tasks import Awaiting, Covering, Done
from protocol.messages import Estimate, Localised, Report, RobotConfig
from protocol.mission import Mission


class UnanchoredPlanner(LogPlanner):
    """The planner of a robot without an anchor: `GroupPlanner` asks it to decide in the one meeting."""

    REQUIRED_PLACES = 5
    """Three for a position, two for a heading."""

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet. Raises NoKernel."""
        state = RobotState(config, task=Awaiting())
        if state.estimator.corrects_poses:
            library()  # it is needed when the robot is found, and would end the mission then
        return replace(state, found=searching.steps_of(state).found, alone=True)

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the data in `reports`, and with a verdict if they determine the own pose.

        With exact sensors, a robot that is localised looks for the others without an anchor.
        """
        if state.robot_verdict is None:
            late = state.elapsed >= state.config.gives_up
            found = _found(state)
            state = state.undecided(found.why_undecided(state)) if late else found.informed(state, reports)
            state = replace(state, robot_verdict=state.verdict)
        return _searching(state, reports) if searching.takes_part(state) else state

    def estimate(self, state: RobotState) -> Estimate:
        """Return the hypotheses in <W>."""
        localised = isinstance(state.robot_verdict, Localised)
        return _found(state).estimate(state, replace(super().estimate(state), localised=localised))

    # --- optional ---

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log or the pose in a report is malformed, or None."""
        if (prior := body.prior) is not None and prior.covariance is not None:
            if prior.tick > body.since:
                return f"a log from tick {body.since} on, before its pose at tick {prior.tick}"
            if not is_definite(np.array(prior.covariance.matrix)):
                return "a covariance of a pose that is not positive definite"
        return super().malformed(body)

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return sufficient_mutual_ranges(mission.noise)

    def summary(self, state: RobotState) -> Summary:
        """Return the number of hypotheses, and what prevents a claim."""
        return _found(state).summary(state)


def _found(state: RobotState) -> Resected | Contacted:
    """Return what a robot without an anchor knows by others."""
    assert state.found is not None
    return state.found


def _searching(state: RobotState, reports: Sequence[Report]) -> RobotState:
    """Return `state` of a localised robot that looks for others, first in strips that its finder leaves it.

    It begins when its finder, in range, has heard that it is localised, and reports no pose any more.
    """
    for one in reports:
        state = meetings.with_sender(state, one)
    if state.parts == 0:
        offered = [one.strips for one in reports if one.strips is not None]
        state = coverage.second_half(state, offered[0]) if offered else state
    if any(one.prior is not None for one in reports) and not isinstance(state.task, Covering):
        return state
    if state.covers:
        state = searching.after_tick(state)
        if not coverage.is_over(state):
            return state
        assert state.robot_verdict is not None
        state = state.doing(Done(3, state.robot_verdict))
    return searching.next_part(state) if searching.wanted(state) else state
