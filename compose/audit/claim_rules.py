"""Audit rules for claims: their error, their sigmas, their redundancy, and the outcome of the run."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from agent.estimation.exact_estimator import ELSEWHERE
from agent.estimation.judged import EXACT_RANGES, sufficient_mutual_ranges
from agent.planning.planner import Planner
from agent.planning.separation import LARGEST_ERROR_SIGMAS
from agent.process.agent_journal import AgentHistory
from compose.audit.findings import Checks, Violation, between
from compose.launch.planner_loader import planner_of
from compose.recording.closest_approach import nearest
from compose.recording.reasons import of_it, reason_for
from compose.recording.run import Run
from protocol.messages import MissionEnd, Report
from protocol.motion import Pose, travelled
from world.referee import inaccuracy, mistake
from world.scenario import RobotSpec, Scenario

TOUCHING = 1e-9
"""The part of the safety distance by which rounding may bring two robots nearer."""


def claim(run: Run) -> Checks:
    """Check that each claim was right, as accurate as the mission requires, and based on a redundant range.

    The rule also checks `outcome`.
    """
    for place, placed in enumerate(run.scenario.robots):
        standing, mission = run.standing_claim(placed.id), run.scenario.mission
        if standing is None:
            continue
        tick, made = standing
        truth = run.ticks[tick].world.truth.poses[place]
        for why in (mistake(placed.id, made, truth, mission), inaccuracy(placed.id, made, mission)):
            yield None if why is None else Violation("claim", tick, placed.id, of_it(why))
        agent = run.agents.get(placed.id)
        if agent is not None and tick < len(agent.steps) and agent.steps[tick].command is not None:
            yield _redundant(run, placed, agent, tick)
    yield from outcome(run)


def distance(run: Run) -> Checks:
    """Check that no two robots came nearer than the safety distance, nor than they began.

    Under noise, three sigmas of a range less: that is how well robots know it. Robots cannot keep it with
    outliers, among attackers, or if their sensors are not what they were told.
    """
    mission = run.scenario.mission
    if not mission.safety_distance or mission.noise.outliers or not _as_told(run.scenario):
        return
    if (found := nearest(run)) is None:
        return
    begun = [travelled(*two) for two in combinations(run.ticks[0].truth.poses, 2)]
    least = min([mission.safety_distance, *begun]) - LARGEST_ERROR_SIGMAS * mission.noise.mutual_sigma
    what = f"two robots came {found:.6g} m near, expected at least {least:.6g} m"
    near = found < least * (1.0 - TOUCHING)
    yield Violation("distance", run.length - 1, None, what) if near else None


def bound(run: Run) -> Checks:
    """Check that a team whose first robot searches is localised within its bound.

    It need not be with faults, attackers, robots that die, or sensors that are not what robots were told.
    """
    scenario, end = run.scenario, run.end
    searches = scenario.team is not None and scenario.team.diameter and _as_told(scenario)
    if end is None or not searches or scenario.faults or scenario.deaths or end.outcome != "localised":
        return
    took = end.tick * scenario.mission.period
    what = f"it takes {took:.6g} s until all are localised, expected at most {scenario.t_max:.6g} s"
    yield Violation("bound", end.tick, None, what) if took > scenario.t_max else None


def _as_told(scenario: Scenario) -> bool:
    """Return whether all data that robots have are as they were told: by their sensors, and by each other."""
    changed = scenario.world_noise is not None or scenario.range_model is not None
    return not changed and all(one.attack is None for one in scenario.robots)


def _redundant(run: Run, placed: RobotSpec, agent: AgentHistory, tick: int) -> Violation | None:
    """Return a violation if the claim at `tick` is based on too few mutual ranges.

    How many it needs depends on the planner. Ranges count up to the latest tick for which the robot had
    received the peer's log, if there are logs. In a group, the peer may be any robot whose log it had, but
    ranges to several robots do not add up. In a team, all ranges of the robot do.
    """
    planner, mission = planner_of(agent.config), run.scenario.mission
    if agent.config.team is not None:
        exact = mission.noise.exact and agent.config.team.origin is not None
        least = EXACT_RANGES if exact else sufficient_mutual_ranges(mission.noise)
        return _too_few(tick, placed, "ranges that determine a pose", _determining(agent, tick), least)
    peers = [agent.config.peer]
    if run.scenario.meetings:
        senders = [framed.report.robot for step in agent.steps[: tick + 1] for framed in step.received]
        peers = list(dict.fromkeys([*peers, *senders]))
    ranged = {peer: _ranged(agent, peer, _known_until(agent, peer, tick, planner)) for peer in peers}
    if mission.noise.exact:
        least = planner.REQUIRED_PLACES
        places = max([_places(run, placed.id, peer, ranged[peer]) for peer in peers]) if least else 0
        return _too_few(tick, placed, "relative placements with a mutual range", places, least)
    least = planner.required_mutual_ranges(mission)
    return _too_few(tick, placed, "mutual ranges", max(map(len, ranged.values())), least)


def _determining(agent: AgentHistory, tick: int) -> int:
    """Return the number of ranges of a robot of a team up to `tick`, without those to an only anchor.

    The latter leave a circle.
    """
    observations = [step.observation for step in agent.steps[: tick + 1]]
    mutual = [one for observation in observations for one in observation.contacts if one.range is not None]
    anchors = [one.anchor for observation in observations for one in observation.anchors]
    return len(mutual) + (len(anchors) if len(set(anchors)) > 1 else 0)


def _known_until(agent: AgentHistory, peer: str, tick: int, planner: Planner[Any, Any]) -> int:
    """Return the latest tick up to `tick` for which the robot had received the log of `peer`.

    It is `tick` if the planner's reports have no logs.
    """
    if planner.BODY is not Report:
        return tick
    ends = [
        _through(framed.report)
        for step in agent.steps[: tick + 1]
        for framed in step.received
        if framed.report.robot == peer
    ]
    return min(max(ends, default=-1), tick)


def _through(report: Report) -> int:
    """Return the tick up to which a report tells where its sender was: by its log, its pose or its body."""
    if report.body is not None:
        return report.tick
    return max(report.through, report.prior.tick) if report.prior is not None else report.through


def _too_few(tick: int, placed: RobotSpec, what: str, found: int, expected: int) -> Violation | None:
    if found >= expected:
        return None
    return Violation("claim", tick, placed.id, f"it claims with {found} {what}, expected at least {expected}")


def _ranged(agent: AgentHistory, peer: str, through: int) -> list[int]:
    """Return the ticks of the ranges to `peer` up to the tick `through`."""
    return [
        step.observation.tick
        for step in agent.steps[: through + 1]
        if any(contact.range is not None and contact.peer == peer for contact in step.observation.contacts)
    ]


def _places(run: Run, robot: str, peer: str, ticks: Sequence[int]) -> int:
    """Return the number of different relative placements of `robot` and `peer` at `ticks`."""
    ids = [robot.id for robot in run.scenario.robots]
    one, other = ids.index(robot), ids.index(peer)
    found: list[tuple[Pose, Pose]] = []
    for tick in ticks:
        local = run.ticks[tick].world.truth.local
        here = local[one], local[other]
        if all(
            any(travelled(*both) > ELSEWHERE for both in zip(here, there, strict=True)) for there in found
        ):
            found.append(here)
    return len(found)


def outcome(run: Run) -> Checks:
    """Check that the MissionEnd has the outcome that the referee derives from the ground truth.

    A run that failed before the referee had an outcome is accepted.
    """
    end, expected = run.end, run.history.recomputed_end
    if end is None:
        return
    if expected is not None and end != expected:
        what = f"it ends {_ending(end)}, expected {_ending(expected)}"
        yield Violation("claim", end.tick, None, what, between(end, expected))
    elif expected is None and end.outcome != "failed":
        yield Violation("claim", end.tick, None, f"it ends {_ending(end)}, expected it to continue")
    else:
        yield None


def _ending(end: MissionEnd) -> str:
    why = reason_for(end)
    return f"{end.outcome} ({why})" if why else end.outcome
