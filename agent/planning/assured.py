"""The `assured` planner: it handles the failure cases of the paper, with exact and with noisy sensors.

With exact sensors, it follows the paper's phases with more manoeuvres to choose from, until one placement is
left and a redundant range has confirmed it. With noisy sensors, it measures until the poses are as accurate
as the mission asks, in the phases of the paper (`phase1_anchor`, `phase2_orbit`, `phase3_encounter`).
"""

from __future__ import annotations

from collections.abc import Sequence

from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.planning import (
    active_sensing,
    exchange,
    phase1_anchor,
    phase2_orbit,
    phase3_encounter,
    plausibility,
    tasks,
)
from agent.planning.exchange import LogPlanner, Steps
from agent.planning.phase3_last_manoeuvre import LAST_SPEEDS
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.strides import is_planning_tick
from protocol.messages import Command, Report
from protocol.mission import Mission
from protocol.motion import REST, Controls


class Assured(LogPlanner):
    """The planner `assured`. Subclasses may plan other manoeuvres of phase 3, and choose a `SOLVER`."""

    MANOEUVRES = Manoeuvres(
        directions=(1.0, -1.0), sides=(1.0, -1.0), last_speeds=LAST_SPEEDS, fewest_out_of_range=True
    )
    """Both ways, to both sides in phase 1, and at several speeds."""
    DEAD_RECKONED = Steps(
        phase1_anchor.unranged, phase1_anchor.until_accurate, phase2_orbit.continued, phase3_encounter.met
    )
    """The paper's steps, with more manoeuvres to choose from."""
    CORRECTED = Steps(
        phase1_anchor.still_unranged, phase1_anchor.surveyed, phase2_orbit.surveyed, phase3_encounter.surveyed
    )
    ACTIVE_SENSING = True

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports` and with the task that follows from them."""
        if reports:
            state = plausibility.with_reports(state, reports)
        if not state.in_contact or isinstance(state.task, tasks.Done):
            return state
        match state.task:
            case tasks.Orbital() | tasks.Travelling():
                return self._steps(state).phase3(state, self.joint_manoeuvres)
            case tasks.Resting():
                return phase3_encounter.decided(state, self.last_manoeuvre)
            case tasks.Listening() | tasks.Surveying("peer") if is_planning_tick(state):
                return phase3_encounter.surveyed(state, self.joint_manoeuvres)
            case _:
                return state

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return exchange.command(state, REST) if _must_wait(state) else super().command(state)

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
        return active_sensing.plan_together(tuple(hypotheses), m2, rho, mission)


def _must_wait(state: RobotState) -> bool:
    """Return whether the robot stands still, in range of a peer with which phase 3 cannot begin yet.

    The peer is then in phase 1, or none of its reports has been received, or it is b and too near its anchor.
    """
    return (
        state.in_contact
        and (state.peer_state.start is None or state.config.role == "a")
        and isinstance(state.task, tasks.Orbital | tasks.Travelling)
    )
