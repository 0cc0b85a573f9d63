"""A robot of a team: all robots share all measurements, and each estimates the poses of all from them.

No plan is made beforehand: what anchors there are is data. In each tick, a robot adds what others report,
estimates all poses (`team_state`), claims its own if it can, and takes its next task (`team_tasks`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec.structs import astuple, replace

from agent.peer.false_reports import falsified_entries
from agent.peer.team_log import TeamLog, TeamReport
from agent.planning.planner import Planner, Summary
from agent.planning.team_state import (
    Near,
    TeamEstimate,
    TeamState,
    claimed,
    followed,
    in_world,
    located_anchors,
)
from agent.planning.team_tasks import next_task, safe_controls
from protocol.messages import Command, Estimate, Localised, Observation, RobotConfig
from protocol.motion import REST, step


class TeamPlanner(Planner[TeamState, TeamReport]):
    """The planner `assured` of a team."""

    BODY = TeamReport

    def start(self, config: RobotConfig) -> TeamState:
        """Return the state of a robot that has measured nothing yet."""
        assert config.team is not None
        log = TeamLog.of(config.team, hearsay=not config.tolerates)
        pairs = (TeamEstimate(),) * len(config.team.robots) if config.tolerates else ()
        nearest = (Near(),) * (len(config.team.robots) + len(config.team.anchors))
        return TeamState(config, log, pairs=pairs, nearest=nearest)

    def observe(self, state: TeamState, observation: Observation) -> TeamState:
        """Return `state` with the sensor data of one tick."""
        driven = observation.executed
        odometry, period = state.odometry, state.config.mission.period
        if driven is not None:
            odometry = step(odometry, driven.v, driven.omega, period)
        ranges = {one.peer: one.range for one in observation.contacts}
        ranges.update({one.anchor: one.range for one in observation.anchors})
        names = *state.team.robots, *[one.id for one in state.team.anchors]
        each = zip(names, state.nearest, strict=True)
        nearest = [one.ranged(ranges.get(name), odometry, observation.tick) for name, one in each]
        return replace(
            state,
            tick=observation.tick,
            odometry=odometry,
            log=state.log.measured(state.own, observation, state.team),
            apart={
                one.peer: one.range
                if one.range is not None
                else max(0.0, state.apart.get(one.peer, 0.0) - 2.0 * state.config.mission.first_straight)
                for one in observation.contacts
            },
            nearest=tuple(nearest),
        )

    def report(self, state: TeamState) -> TeamReport:
        """Return the report to a robot that has acknowledged nothing."""
        return self.report_to(state, state.config.robot)

    def report_to(self, state: TeamState, peer: str) -> TeamReport:
        """Return what `peer` has not acknowledged, falsified if the configuration contains an attack."""
        log, attack, own = state.log, state.config.attack, state.own
        if attack is not None:
            falsified = falsified_entries(log.logs[own], attack, state.config.mission.period)
            log = replace(log, logs=(*log.logs[:own], falsified, *log.logs[own + 1 :]))
        return log.report(own, state.team.robots.index(peer))

    def decide(self, state: TeamState, reports: Sequence[TeamReport] = ()) -> TeamState:
        """Return `state` with the `reports` of others, and with what follows from all measurements."""
        state = replace(state, log=state.log.received(reports, state.own))
        helps = state.config.robot == state.team.origin and state.waiting
        if state.tick > 0 and (state.verdict is None or helps):  # before a motion, no heading is known
            state = followed(state)
        if state.verdict is None:
            state = claimed(state)
        return next_task(state)

    def command(self, state: TeamState) -> Command:
        """Return the command for the next tick, with the phase, the task and the verdict."""
        robot, rests = state.config.robot, state.verdict is not None and state.controls == REST
        v, omega = astuple(safe_controls(state))
        return Command(
            state.tick, robot, v, omega, state.phase, state.doing, verdict=state.verdict, rests=rests
        )

    def estimate(self, state: TeamState) -> Estimate:
        """Return all poses of this robot that explain the measurements."""
        poses = state.hypotheses
        world = [in_world(state, one) for one in poses]
        total = math.fsum([one.probability for one in poses])
        world = world or ([state.verdict.pose] if isinstance(state.verdict, Localised) else [])
        judged = state.following.judged.get(state.config.robot)
        covariance = judged.localised.covariance if judged is not None and poses else None
        return Estimate(
            state.tick,
            state.config.robot,
            (state.odometry,) if poses else (),
            tuple(world),
            isinstance(state.verdict, Localised),
            tuple([min(one.probability / total, 1.0) for one in poses]) if covariance is not None else (),
            covariance,
            located_anchors(state),
        )

    def summary(self, state: TeamState) -> Summary:
        """Return the number of hypotheses, their probability, and what prevents a claim."""
        entries, poses = state.log.logs[state.own], state.hypotheses
        judged = state.following.judged.get(state.config.robot)
        pairs = [one.following.judged.get(state.config.robot) for one in state.pairs]
        tests = [one.inconsistency for one in (judged, *pairs) if one is not None]
        p_value = min([one.p_value for one in tests if one is not None], default=None)
        noisy = judged is not None and judged.localised.covariance is not None
        total = math.fsum([one.probability for one in poses])
        return Summary(
            anchor_ranges=sum([len(one.anchors) for one in entries]),
            hypotheses=len(poses) or None,
            probability=min(poses[0].probability / total, 1.0) if noisy and poses else None,
            blocking_reason=state.joint.why_not or None if noisy and state.verdict is None else None,
            p_value=p_value if noisy else None,
            unverified_anchors=state.unverified_anchors,
        )
