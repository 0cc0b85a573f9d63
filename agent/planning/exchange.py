"""The exchange of a tick, and the base of planners whose robots exchange their motion logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from agent.estimation.gaussian.planning_hypotheses import PlanningHypothesis
from agent.estimation.judged import required_mutual_ranges
from agent.estimation.solver import Solver
from agent.peer import false_reports, peer_state
from agent.peer.motion_log import MotionLog
from agent.planning import (
    active_sensing,
    drive,
    phase1_anchor,
    phase3_encounter,
    phase3_last_manoeuvre,
    plausibility,
    range_seeking,
    tasks,
    travelling,
)
from agent.planning.phase3_last_manoeuvre import Plan, Question
from agent.planning.planner import Manoeuvres, Planner, Summary
from agent.planning.state import RobotState
from agent.planning.strides import is_planning_tick
from protocol.messages import (
    Command,
    Estimate,
    Localised,
    Observation,
    Ranged,
    Report,
    RobotConfig,
    Verdict,
)
from protocol.mission import Mission
from protocol.motion import Controls, Pose, compose, inverse, step


def observed(state: RobotState, observation: Observation) -> RobotState:
    """Return `state` with the sensor data of one tick: odometry, ranges, and contact with the peer."""
    log, odometry, leg = state.log, state.odometry, state.leg
    if (executed := observation.executed) is not None:
        log = log.drove(executed.v, executed.omega)
        ticks = log.runs[-1].ticks
        if ticks == 1:
            leg = odometry
        odometry = step(leg, executed.v, executed.omega, ticks * state.config.mission.period)
    if observation.anchor_range is not None and state.estimator.is_informative(state, observation):
        log = log.ranged(observation.anchor_range)
    ranges = state.ranges
    for contact in observation.contacts:
        if contact.range is not None:
            latest = Ranged(observation.tick, contact.range)
            ranges = {**ranges, contact.peer: (*ranges.get(contact.peer, ()), latest)}
    return replace(
        state,
        tick=observation.tick,
        odometry=odometry,
        log=log,
        ranges=ranges,
        in_contact=any(contact.peer == state.config.peer for contact in observation.contacts),
        leg=leg,
    )


def _reported_log(state: RobotState) -> MotionLog:
    """Return the log of the robot, falsified if its configuration contains an attack."""
    attack = state.config.attack
    if attack is None:
        return state.log
    ends = state.own_anchor.done_tick, state.posterior.encounter_tick
    return false_reports.falsified_log(state.log, attack, *ends, state.config.mission.period)


def reported_pose(state: RobotState, frame: Pose) -> Pose:
    """Return the pose in <W> that a localised robot reports; `frame` is its pose at tick 0.

    That of an attacker follows from the start and the log that it reports to its peers.
    """
    attack, branch = state.config.attack, state.own_anchor.branch
    if attack is None or branch is None:
        return compose(frame, state.odometry)
    pose = compose(compose(frame, inverse(branch.start)), false_reports.start(branch.start, attack))
    for run in _reported_log(state).runs:
        pose = step(pose, run.v, run.omega, run.ticks * state.config.mission.period)
    return pose


def report_without_log(state: RobotState, verdict: Verdict | None) -> Report:
    """Return a report to a robot with which this one is not in a meeting: the `verdict` that it has."""
    return Report(
        tick=state.tick,
        robot=state.config.robot,
        phase=state.phase,
        state=state.task.name,
        ranges_since=len(state.log.ranges),
        verdict=verdict,
    )


class Steps(NamedTuple):
    """The steps of a planner that depend on the sensors: chosen once, by the estimator."""

    unranged: Callable[[RobotState], RobotState]
    """The step after a tick of a robot that has not measured a range to its anchor yet."""
    phase1: Callable[[RobotState, Manoeuvres], RobotState]
    """The step of phase 1 after a second or further range to the anchor."""
    phase2: Callable[[RobotState, tasks.Orbital, bool], RobotState]
    """The step of phase 2 from a task; the last argument says whether there is a new range to the anchor."""
    phase3: Callable[[RobotState, Any], RobotState]
    """The step that begins phase 3 in contact with the peer, if it can; it may plan by `joint_manoeuvres`."""
    turns: Callable[[RobotState, phase3_encounter.PlannedLast], RobotState] = phase3_encounter.decided
    """The step of phase 3 of a robot that stands still in contact; it plans by `last_manoeuvre`."""


class LogPlanner(Planner[RobotState, Report]):
    """A planner with the state of the shipped planners, which differ in their steps."""

    BODY = Report
    MANOEUVRES: Manoeuvres
    DEAD_RECKONED: Steps
    """The steps of a robot that knows its pose from the end of phase 1 on."""
    CORRECTED: Steps
    """The steps of a robot whose pose each range corrects."""
    SOLVER: Solver | None = None
    """The solver that fits the poses under noise; None for the smoother. A subclass may choose its own."""
    REQUIRED_PLACES = 3
    """Two leave several solutions."""

    def start(self, config: RobotConfig) -> RobotState:
        """Return the state of a robot that has measured nothing yet."""
        return RobotState(config, solver=self.SOLVER)

    def observe(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the sensor data of one tick, and with the task that follows from them."""
        after = self._with_task(observed(state, observation), observation)
        return after if after.config.members else travelling.onward(after, observation.contacts)

    def _with_task(self, state: RobotState, observation: Observation) -> RobotState:
        """Return `state` with the task that follows from its sensor data."""
        task, ranged = state.task, observation.anchor_range is not None
        match task:  # in real time, a manoeuvre may not have been executed
            case tasks.Orbiting(None) | tasks.Resting() | tasks.Done():  # most ticks
                return state
            case tasks.Orbital():
                return self._steps(state).phase2(state, task, ranged)
            case tasks.Searching("peer"):
                return phase3_encounter.sought(state, task, self.MANOEUVRES)
            case tasks.Searching():
                seeking = range_seeking.onward(state, task, ranged, self.MANOEUVRES)
                return state.doing(seeking) if seeking else self._steps(state).phase1(state, self.MANOEUVRES)
            case tasks.ThirdPoint() if phase1_anchor.has_ended(state, task, ranged):
                return self._steps(state).phase1(state, self.MANOEUVRES)
            case tasks.LastManoeuvre(_, origin) | tasks.Returning(_, origin) if state.odometry != origin:
                return phase3_encounter.after_last_manoeuvre(state, task)
            case tasks.Asleep():
                first = observation.anchor_range
                return (
                    self._steps(state).unranged(state) if first is None else phase1_anchor.begun(state, first)
                )
            case tasks.Surveying("anchor") | tasks.Homing():
                return phase1_anchor.sensed(state, task, ranged)
            case tasks.Surveying() | tasks.Listening() | tasks.Retreating():
                return phase3_encounter.sensed(state, task)
            case _:
                return state

    def decide(self, state: RobotState, reports: Sequence[Report] = ()) -> RobotState:
        """Return `state` with the peer's `reports` and with the task that follows from them."""
        if reports:
            state = plausibility.with_reports(state, reports, self.rendezvous)
        if not state.in_contact or isinstance(state.task, tasks.Done):
            return state
        match state.task:
            case tasks.Orbital() | tasks.Travelling():
                return self._steps(state).phase3(state, self.joint_manoeuvres)
            case tasks.Resting():
                return self._steps(state).turns(state, self.last_manoeuvre)
            case tasks.Listening() | tasks.Surveying("peer") if is_planning_tick(state):
                return phase3_encounter.surveyed(state, self.joint_manoeuvres)
            case _:
                return state

    def _steps(self, state: RobotState) -> Steps:
        """Return the steps for the sensors of the mission."""
        return self.CORRECTED if state.estimator.corrects_poses else self.DEAD_RECKONED

    def command(self, state: RobotState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        return drive.command(state, drive.controls(state))

    def report(self, state: RobotState) -> Report:
        """Return the report of this tick: the part of the log that the peer has not acknowledged.

        If the configuration contains an attack, the report holds the falsified log (see `protocol.attack`).
        """
        since, ranges_since = state.peer_state.acknowledged, state.peer_state.ranges_acknowledged
        start = state.own_anchor.branch.start if state.own_anchor.branch and state.phase > 1 else None
        log = _reported_log(state)
        if (attack := state.config.attack) is not None:
            start = false_reports.start(start, attack) if start is not None else None
        unacknowledged = log.after(since, ranges_since)
        return replace(
            report_without_log(state, state.verdict),
            start=start,
            since=since,
            through=unacknowledged.through,
            runs=unacknowledged.runs,
            ranges_since=ranges_since,
            ranges=unacknowledged.ranges,
            heard=state.peer_state.peer.through,
            ranges_heard=len(state.peer_state.peer.ranges),
        )

    def estimate(self, state: RobotState) -> Estimate:
        """Return the robot's pose under each hypothesis, in its anchor's frame and in <W>."""
        own, posterior, verdict = state.own_anchor, state.posterior, state.verdict
        branches_left = own.branches or ((own.branch,) if own.branch is not None else ())
        if not branches_left and isinstance(state.task, tasks.ThirdPoint):
            branches_left = state.task.branches
        if posterior.poses:
            world: tuple[Pose, ...] = state.poses
        elif isinstance(verdict, Localised):
            world = (verdict.pose,)
        else:
            world = tuple([state.world_pose(placement) for placement in posterior.placements])
        local = tuple(phase1_anchor.local(branches_left, state.odometry))
        shares = tuple([one.probability for one in (posterior.pair if world else own.hypotheses)])
        return Estimate(
            tick=state.tick,
            robot=state.config.robot,
            local=local,
            world=world,
            localised=isinstance(verdict, Localised),
            # after an encounter has failed, there are poses of it, and hypotheses about the anchor only
            probabilities=shares if len(shares) == len(world or local) else (),
            covariance=posterior.covariance,
        )

    def last_manoeuvre(self, question: Question, mission: Mission) -> Plan | None:
        """Return the last manoeuvre for `question`; None if every one violates the safety distance (eq. (8)).

        A subclass may plan another one. It is executed for one tick, and driven back if it leaves the peer's
        range.
        """
        return phase3_last_manoeuvre.last_manoeuvre(question, mission, self.MANOEUVRES)

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

    def required_mutual_ranges(self, mission: Mission) -> int:
        """Return the minimum number of noisy mutual ranges before a claim."""
        return required_mutual_ranges(mission.noise)

    def malformed(self, body: Report) -> str | None:
        """Return the reason why the log in a report is malformed, or None."""
        return peer_state.contradiction(body)

    def summary(self, state: RobotState) -> Summary:
        """Return the numbers of ranges and hypotheses, and the last manoeuvre."""
        own, posterior, plan = state.own_anchor, state.posterior, state.plan
        counts = posterior.hypothesis_counts
        return Summary(
            anchor_ranges=len(state.log.ranges),
            branch=own.kind,
            alpha=own.branch.alpha if own.branch is not None else None,
            candidates=counts,
            last_turn_rate=plan.command.omega if plan is not None else None,
            separation_m2=plan.separation_m2 if plan is not None else None,
            hypotheses=counts and len(posterior.pair or posterior.placements),
            probability=posterior.pair[0].probability if posterior.pair else None,
            blocking_reason=posterior.blocking_reason,
            p_value=posterior.attempt.p_value,
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
