"""The `paper` planner: the algorithm as published, with exact and with noisy sensors.

With noisy sensors, the planner continues with the most probable branch and claims a pose only if it meets the
mission's requirements. The few ranges that the paper's manoeuvres collect are mostly not enough, and never
with outliers. The verdict Undecided then states what is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

from agent.planning import drive, exchange, phase1_anchor, turns
from agent.planning.exchange import LogPlanner
from agent.planning.planner import Manoeuvres
from agent.planning.state import RobotState
from agent.planning.tasks import Orbiting, Resting, Standing, ThirdPoint, Waiting
from protocol.messages import Command, Report
from protocol.mission import Mission
from protocol.orbits import Rendezvous, rendezvous


class Paper(LogPlanner):
    """The algorithm as published. Subclasses may plan another last manoeuvre."""

    MANOEUVRES = Manoeuvres(directions=(1.0,), sides=(1.0,), last_speeds=None, fewest_out_of_range=False)
    """Forward, to the left in phase 1, and at v_max."""

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports` and with the task that follows from them.

        Phase 3 begins when both robots are on their orbits.
        """
        if reports:
            state = exchange.with_reports(state, reports)
        if not state.in_contact:
            return state
        match state.task:
            case Orbiting() if state.peer_state.phase == 3 or state.peer_state.state == state.task.name:
                return turns.begun(state)
            case Resting():
                return self._decide_phase3(state)
            case _:
                return state

    def rendezvous(self, mission: Mission, distance: float) -> Rendezvous:
        """Return the orbits of eq. (6)."""
        return rendezvous(mission, distance, "paper")

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return exchange.command(state, drive.controls(state))

    def _after_range(self, state: RobotState) -> RobotState:
        """Continue phase 1 with the branches +alpha and -alpha that the ranges allow (eq. (2)).

        The third range is the last one. It selects the most probable branch, if there is one.
        """
        third = isinstance(state.task, ThirdPoint)
        state, estimate, kind = phase1_anchor.with_branches(state)
        branch = estimate.best if third or len(estimate.branches) == 1 else None
        if kind is not None and branch is not None:
            return phase1_anchor.ended(state, state.estimator.fitted(state, branch), kind)
        if estimate.branches and third:
            return state.undecided("the third range does not distinguish +alpha from -alpha")
        return phase1_anchor.to_third_point(state, estimate, self.MANOEUVRES)

    def _decide_phase3(self, state: RobotState) -> RobotState:
        """Evaluate phase 3 after a's second mutual range, and again after b's last manoeuvre.

        The mutual ranges count from the encounter on. Return `state` with a verdict, with b's last
        manoeuvre, or with the same task.
        """
        evaluated = turns.with_new_ticks(state)
        if evaluated is None:
            return state
        first_tick, planned = state.belief.encounter_tick, state.plan is not None
        assert first_tick is not None
        a_waits = not isinstance(state.task, Standing) or state.peer_state.state == Waiting.name
        second = a_waits or planned
        state, estimate = turns.pair_estimate(evaluated, first_tick, second_range=second)
        if estimate is None or state.verdict is not None or state.config.role == "a":
            return state
        if planned:
            return state.undecided(estimate.failure)
        moving = turns.last_manoeuvre(state, estimate, self.last_manoeuvre)
        return moving if moving is not None else state.undecided("no manoeuvre keeps the safety distance")
