"""The base of planners whose robots exchange their motion logs in `messages.Report`."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from agent.estimation.judged import required_mutual_ranges
from agent.estimation.solver import Solver
from agent.peer import peer_state
from agent.planning import exchange, phase3_last_manoeuvre, transitions
from agent.planning.manoeuvres import Manoeuvres
from agent.planning.phase3_last_manoeuvre import Plan, Question
from agent.planning.planner import Planner, Summary
from agent.planning.state import RobotState
from protocol.messages import Estimate, Observation, Report, RobotConfig
from protocol.mission import Mission
from protocol.motion import Controls

KEPT_PLACES = 3
"""The number of relative placements that a claim from exact ranges needs; two leave several solutions."""


class LogPlanner(Planner[RobotState, Report]):
    """A planner with the state of the shipped planners. Subclasses define `decide` and `command`."""

    BODY = Report
    MANOEUVRES: Manoeuvres
    SOLVER: Solver | None = None
    """The solver that fits the poses under noise; None for the smoother. A subclass may choose its own."""
    REQUIRED_PLACES = KEPT_PLACES

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet."""
        return exchange.start(config, self.SOLVER)

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the sensor data of one tick, and with the mode that follows from them."""
        state = exchange.observed(state, observation)
        return transitions.after_observation(
            state, observation.anchor_range, self.MANOEUVRES, self._after_range
        )

    def _after_range(self, state: RobotState) -> RobotState:
        """Return `state` with the next mode of phase 1, after a range to the anchor."""
        raise NotImplementedError

    def report(self, state: RobotState) -> Report:
        """Return the part of the log that the peer has not acknowledged."""
        return exchange.report(state)

    def estimate(self, state: RobotState) -> Estimate:
        """Return all poses that the robot considers possible in its anchor's frame and in <W>."""
        return exchange.estimate(state)

    def last_manoeuvre(self, question: Question, mission: Mission) -> Plan | None:
        """Return the last manoeuvre for `question`; None if every one violates the safety distance (eq. (8)).

        A subclass may plan another one. It is executed for one tick, and driven back if it leaves the peer's
        range.
        """
        return phase3_last_manoeuvre.last_manoeuvre(
            question.mover, question.a, question.b, question.candidates, mission, self.MANOEUVRES
        )

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return required_mutual_ranges(mission.noise)

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log in a report is malformed, or None."""
        return peer_state.contradiction(body)

    def summary(self, state: RobotState) -> Summary:
        """Return the numbers of ranges and hypotheses, and the last manoeuvre."""
        belief, plan = state.belief, state.plan
        return Summary(
            anchor_ranges=len(state.log.ranges),
            mutual_ranges=len(state.mutual),
            reports_heard=state.peer_state.heard,
            branch=belief.branch_kind,
            alpha=belief.branch.alpha if belief.branch is not None else None,
            candidates=belief.candidates,
            last_turn_rate=plan.command.omega if plan is not None else None,
            separation_m2=plan.separation_m2 if plan is not None else None,
            hypotheses=(len(belief.pair or belief.placements) if belief.candidates is not None else None),
            probability=belief.pair[0].probability if belief.pair else None,
            blocking_reason=belief.blocking_reason,
            p_value=belief.p_value,
        )

    def misreport(self, body: Report, observations: Sequence[Observation]) -> str | None:
        """Return how the manoeuvres and ranges in a report differ from the robot's own; None if not."""
        contradiction = peer_state.contradiction(body)
        if contradiction is not None:
            return f"it reported {contradiction}"
        k = body.since
        for run in body.runs:
            for _ in range(run.ticks):
                k += 1
                driven = observations[k].executed
                if driven != Controls(run.v, run.omega):
                    return f"it reported ({run.v:g}, {run.omega:g}) until tick {k}, expected {_json(driven)}"
        for reported in body.ranges:
            ranged = observations[reported.tick].anchor_range
            if ranged != reported.range:
                return f"it reported {reported.range!r} m at tick {reported.tick}, expected {_json(ranged)}"
        return None


def _json(value: Controls | float | None) -> str:
    return msgspec.json.encode(value).decode()
