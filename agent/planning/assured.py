"""The `assured` planner: it handles the failure cases of the paper, with exact and with noisy sensors.

With exact sensors, it follows the paper's phases with more manoeuvres to choose from, until one placement is
left and a redundant range has confirmed it. With noisy sensors, it measures until the poses are as accurate
as the mission asks (`accuracy_seeking`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.planning import accuracy_seeking, active_sensing, exchange, phase2_orbit, turns
from agent.planning.accuracy_seeking import JointManoeuvres
from agent.planning.drive import controls
from agent.planning.exchange import LogPlanner
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.tasks import Done, Listening, Orbital, Resting, Surveying, Travelling
from protocol.messages import Command, Report
from protocol.mission import Mission
from protocol.motion import REST, Controls


class Steps(NamedTuple):
    """The steps of `assured` that differ with what later ranges tell: chosen once, by the estimator."""

    phase1: Callable[[RobotState, Manoeuvres], RobotState]
    """It continues phase 1 after a second or further range to the anchor."""
    phase2: Callable[[RobotState, Orbital, bool], RobotState]
    """It continues phase 2 from a task; the last argument says whether there is a new range to the anchor."""
    phase3: Callable[[RobotState, JointManoeuvres], RobotState]
    """It begins phase 3 in contact with the peer, if that can begin."""


BY_TURNS = Steps(turns.continue_phase1, phase2_orbit.continued, turns.met)
"""The paper's steps, with more manoeuvres to choose from."""

BY_ACCURACY = Steps(
    accuracy_seeking.continue_phase1, accuracy_seeking.continue_phase2, accuracy_seeking.decided
)
"""The steps of robots whose pose each range corrects."""


class Assured(LogPlanner):
    """The planner `assured`. Subclasses may plan other manoeuvres of phase 3, and choose a `SOLVER`."""

    MANOEUVRES = accuracy_seeking.MANOEUVRES
    ACTIVE_SENSING = True

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports` and with the task that follows from them."""
        if reports:
            state = exchange.with_reports(state, reports)
        if not state.in_contact or isinstance(state.task, Done):
            return state
        match state.task:
            case Orbital() | Travelling():
                return self._steps(state).phase3(state, self.joint_manoeuvres)
            case Resting():
                return turns.decided(state, self.last_manoeuvre)
            case Listening() | Surveying("peer") if accuracy_seeking.is_planning_tick(state):
                return accuracy_seeking.decided(state, self.joint_manoeuvres)
            case _:
                return state

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return exchange.command(state, REST if self._must_wait(state) else controls(state))

    def joint_manoeuvres(
        self,
        hypotheses: Sequence[PlanningHypothesis],
        m2: tuple[float, float],
        rho: float,
        mission: Mission,
    ) -> tuple[Controls, Controls]:
        """Return the manoeuvres of a and b in phase 3 with noisy sensors, for `stride` ticks.

        `hypotheses` are about the poses of both robots relative to M1, the most probable first. M2 is at
        `m2` in m, and `rho` is the latest range between the robots in m. A subclass may plan others; both
        robots compute both from the same measurements. It is not asked while they are stalled (see
        `strides`), nor when one of them has claimed its pose.
        """
        return active_sensing.plan_together(hypotheses, m2, rho, mission)

    def _must_wait(self, state: RobotState) -> bool:
        """Return whether the robot stands still, in range of a peer with which phase 3 cannot begin yet.

        The peer is then in phase 1, or none of its reports has been received, or it is b and too near its
        anchor.
        """
        return (
            state.in_contact
            and (state.peer_state.start is None or state.config.role == "a")
            and isinstance(state.task, Orbital | Travelling)
        )

    def _steps(self, state: RobotState) -> Steps:
        """Return the steps for the sensors of the mission."""
        return BY_ACCURACY if state.estimator.corrects_poses else BY_TURNS

    def _continue_phase2(self, state: RobotState, task: Orbital, ranged: bool) -> RobotState:
        return self._steps(state).phase2(state, task, ranged)

    def _sense(self, state: RobotState, ranged: bool) -> RobotState:
        """Continue active sensing, or search for the anchor: only under noise."""
        return accuracy_seeking.sensed(state, ranged)

    def _after_range(self, state: RobotState) -> RobotState:
        return self._steps(state).phase1(state, self.MANOEUVRES)
