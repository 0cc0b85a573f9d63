"""The `assured` planner: it handles the failure cases of the paper, with exact and with noisy sensors.

With exact sensors, it follows the paper's phases with more manoeuvres to choose from, until one placement is
left and a redundant range has confirmed it. With noisy sensors, it measures until the poses are as accurate
as the mission asks (`accuracy_seeking`).
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from agent.estimation.gaussian.inference import PlanningHypothesis
from agent.planning import accuracy_seeking, active_sensing, exchange, phase3_last_manoeuvre, transitions
from agent.planning.drive import controls
from agent.planning.exchange import LogPlanner
from agent.planning.state import RobotState
from agent.planning.tasks import Done, Listening, Orbital, Resting, Standing, Surveying, Travelling, Waiting
from protocol.messages import Command, Localised, Report
from protocol.mission import Mission
from protocol.motion import REST, Controls

PEER_RESTS = (Standing.name, Waiting.name)
"""The tasks of the peer in which this robot may plan a manoeuvre.

If both moved at once, they might do so in mirror image, and the new range would not select a placement.
"""


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
                return self._begin_phase3(state)
            case Resting():
                return self._decide_phase3(state)
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

    def _continue_phase2(self, state: RobotState, task: Orbital, ranged: bool) -> RobotState:
        """Continue phase 2 from `task`; under noise, the latest range corrects the pose."""
        if state.estimator.corrects_poses:
            return accuracy_seeking.continue_phase2(state, task, ranged=ranged)
        return transitions.continue_phase2(state, task)

    def _sense(self, state: RobotState, ranged: bool) -> RobotState:
        """Continue active sensing, or search for the anchor: only under noise."""
        return accuracy_seeking.sensed(state, ranged)

    def _begin_phase3(self, state: RobotState) -> RobotState:
        """Begin phase 3 once the peer's phase 1 has ended, and with exact sensors b is off its anchor."""
        peer = state.peer_state
        if state.estimator.corrects_poses:
            return accuracy_seeking.decided(state, self.joint_manoeuvres)
        met = peer.phase == 3 or (peer.start is not None and state.off_anchor)
        return transitions.begin_phase3(state) if met else state

    def _after_range(self, state: RobotState) -> RobotState:
        """Continue phase 1 with the branches +alpha and -alpha that the ranges allow (eq. (2)).

        Phase 1 ends when one branch is left, and the ranges determine the anchor's position as accurately as
        a claim needs. Under noise, further ranges follow until they are no longer worth the time.
        """
        if state.estimator.corrects_poses:
            return accuracy_seeking.continue_phase1(state)
        kind = transitions.branch_kind(state)
        estimate = transitions.anchor_estimate(state)
        state = replace(state, belief=estimate.belief)
        if kind is not None and len(estimate.branches) == 1:
            fitted = state.estimator.fitted(state, estimate.branches[0])
            if fitted.enough:
                return transitions.end_phase1(state, fitted, kind)
        return transitions.to_third_point(
            state, estimate, self.MANOEUVRES, pinning=len(estimate.branches) == 1
        )

    def _decide_phase3(self, state: RobotState) -> RobotState:
        """Return `state` after the evaluation of both logs: with a verdict, a last manoeuvre, or as it was.

        All ticks count, including those before the encounter. The robots take turns until a redundant range
        has confirmed the placement, and then until the ranges determine it.
        """
        evaluated = transitions.with_new_ticks(state)
        if evaluated is None:
            return state
        state, estimate = transitions.pair_estimate(evaluated, 0, second_range=True)
        if estimate is None:  # There are too few ranges, or b was still driving while a drove straight on.
            b_is_standing = isinstance(state.task, Waiting) and state.peer_state.state == Standing.name
            return transitions.begin_phase3(state) if b_is_standing else state
        if state.verdict is not None:
            return state
        # A peer that has localised itself does not move again.
        if not isinstance(state.peer_state.verdict, Localised):
            turn = phase3_last_manoeuvre.turn(estimate.observations) if estimate.checked else "b"
            if state.config.role != turn or state.peer_state.state not in PEER_RESTS:
                return state
        return transitions.last_manoeuvre(state, estimate, self.last_manoeuvre) or state
