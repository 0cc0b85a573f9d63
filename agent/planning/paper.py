"""The `paper` planner: the algorithm as published, with exact and with noisy sensors.

With noisy sensors, the planner continues with the most probable branch and claims a pose only if it meets the
mission's requirements. The few ranges that the paper's manoeuvres collect are mostly not enough, and never
with outliers. The verdict Undecided then states what is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

from agent.planning import phase1_anchor, phase2_orbit, phase3_encounter, plausibility
from agent.planning.exchange import LogPlanner, Steps
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.tasks import Orbiting, Resting, Standing, Waiting
from protocol.messages import Report
from protocol.mission import Mission
from protocol.orbits import Rendezvous, rendezvous


class Paper(LogPlanner):
    """The algorithm as published. Subclasses may plan another last manoeuvre."""

    MANOEUVRES = Manoeuvres(directions=(1.0,), sides=(1.0,), last_speeds=None, fewest_out_of_range=False)
    """Forward, to the left in phase 1, and at v_max."""
    DEAD_RECKONED = Steps(
        phase1_anchor.unranged,
        phase1_anchor.as_published,
        phase2_orbit.continued,
        phase3_encounter.met_on_orbits,
    )
    CORRECTED = DEAD_RECKONED._replace(unranged=lambda state: state)
    """A first range may be missing by chance."""

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports` and with the task that follows from them.

        Phase 3 begins when both robots are on their orbits.
        """
        if reports:
            state = plausibility.with_reports(state, reports)
        if not state.in_contact:
            return state
        match state.task:
            case Orbiting():
                return self._steps(state).phase3(state, None)
            case Resting():
                return self._decide_phase3(state)
            case _:
                return state

    def rendezvous(self, mission: Mission, distance: float) -> Rendezvous:
        """Return the orbits of eq. (6)."""
        return rendezvous(mission, distance, "paper")

    def _decide_phase3(self, state: RobotState) -> RobotState:
        """Evaluate phase 3 after a's second mutual range, and again after b's last manoeuvre.

        The mutual ranges count from the encounter on. Return `state` with a verdict, with b's last
        manoeuvre, or with the same task.
        """
        evaluated = phase3_encounter.with_new_ticks(state)
        if evaluated is None:
            return state
        first_tick, planned = state.belief.encounter_tick, state.plan is not None
        assert first_tick is not None
        a_waits = not isinstance(state.task, Standing) or state.peer_state.state == Waiting.name
        second = a_waits or planned
        state, estimate = phase3_encounter.pair_estimate(evaluated, first_tick, second_range=second)
        if estimate is None or state.verdict is not None or state.config.role == "a":
            return state
        if planned:
            return state.undecided(estimate.failure)
        moving = phase3_encounter.last_manoeuvre(state, estimate, self.last_manoeuvre)
        return moving if moving is not None else state.undecided("no manoeuvre keeps the safety distance")
