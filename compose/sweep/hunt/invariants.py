"""The invariants of a run, beside the rules of the audit: what no input of a mission may break."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations

import msgspec
import numpy as np

from agent.estimation.claim import is_definite
from compose.audit import agent_rules, journal_rules, rules, scenario_rules
from compose.recording.group_localisation import meeting_results, search_results
from compose.recording.run import Run
from compose.sweep.trial import Trial, row
from protocol.messages import Inconsistent, Localised, Report
from protocol.motion import travelled
from world.faults import Fault
from world.referee import errors
from world.scenario import Scenario

TRUTH_M = 1e-5
"""The distance in m, and in rad, within which a pose of exact sensors is the true one."""


class Breach(msgspec.Struct, frozen=True):
    """An invariant that does not hold."""

    kind: str
    """The invariant."""
    what: str
    """The finding, and its place."""


def breaches(run: Run, *, in_full: bool, replayed: bool) -> Iterator[Breach]:
    """Yield the invariants that do not hold in `run`, the rules of the audit included.

    The rules `decision` and `scenario`, which take longer than all others, are left out unless the run is
    examined `in_full`; the first one, too, if it was `replayed`: a second run has given the same bytes. The
    rule `order` would report that the journals of a run that is cut break off.
    """
    applied = list(rules.AUDIT_RULES)
    if replayed or not in_full:
        applied.remove(agent_rules.decision)
    if not in_full:
        applied.remove(scenario_rules.scenario)
    if run.end is None:
        applied.remove(journal_rules.order)
    for one in rules.audit_run(run, applied).violations:
        if one.rule != "claim" or _must_be_right(run.scenario):
            yield Breach(f"audit: {one.rule}", one.line)
    for check in (blamed, unfinished, late, truth_lost, forgotten, kept, indefinite):
        yield from check(run)


def _must_be_right(scenario: Scenario) -> bool:
    """Return whether claims must be right: more attackers than are tolerated can mislead noisy robots."""
    attackers = sum([one.attack is not None for one in scenario.robots])
    if scenario.range_model is not None:  # an attacked link of two robots counts as one of them
        attackers += 1 if len(scenario.attacked) == 2 else scenario.tolerates + 1
    return scenario.mission.noise.exact or attackers <= scenario.tolerates


def guaranteed(scenario: Scenario) -> bool:
    """Return whether every robot must be localised in the end, and within the bounds."""
    fair = all(one.let_through or one.ticks or one.contact_ticks for one in scenario.faults)
    fair = fair and not any(one.partition and not (one.ticks or one.contact_ticks) for one in scenario.faults)
    exact = scenario.mission.noise.exact and scenario.world_noise is None and scenario.range_model is None
    honest = all(one.attack is None for one in scenario.robots) and not scenario.deaths
    free = _apart(scenario) > scenario.mission.safety_distance  # others do not move
    delivers = fair and scenario.radio_model is None
    return delivers and exact and honest and free and scenario.planner_name == "assured"


def _apart(scenario: Scenario) -> float:
    """Return the least distance (m) between the starts of two robots; infinite of one robot."""
    starts = [one.start for one in scenario.robots]
    return min([travelled(*two) for two in combinations(starts, 2)], default=math.inf)


def blamed(run: Run) -> Iterator[Breach]:
    """No robot finds an honest peer inconsistent."""
    honest = {one.id for one in run.scenario.robots if one.attack is None} - run.scenario.attacked
    for robot, agent in run.agents.items():
        for step in agent.steps:
            for contact, framed in zip(step.observation.contacts, step.reports, strict=False):
                if contact.peer in honest and isinstance(verdict := framed.report.verdict, Inconsistent):
                    what = f"tick {step.observation.tick}: {robot} finds {contact.peer} inconsistent"
                    yield Breach("honest peer inconsistent", f"{what}: {verdict.claim}")
                    return


def unfinished(run: Run) -> Iterator[Breach]:
    """Every robot is localised in the end, with exact sensors, honest peers and a radio that delivers."""
    if run.end is not None and run.end.outcome != "localised" and guaranteed(run.scenario):
        yield Breach("unfinished", f"tick {run.end.tick}: {run.end.outcome}: {run.end.causes}")


def bounds(run: Run) -> list[tuple[str, int | None, int]]:
    """Return what has a bound in `run`, the ticks that it took, None if it did not happen, and the bound.

    It is the meeting of a pair, or each robot that a group localises.
    """
    scenario = run.scenario
    if not guaranteed(scenario) or any(one != Fault() for one in scenario.faults) or run.end is None:
        return []
    if scenario.mission.safety_distance and _apart(scenario) <= scenario.mission.sensing_range:
        return []  # robots that begin in range of each other drive aside, for which no bound allows
    found = [(one.visited, one.localised_tick, one.bound_ticks) for one in meeting_results(run)]
    found += [(one.robot, one.localised_tick, one.bound_ticks) for one in search_results(run)]
    if scenario.in_pairs:
        pair = row(Trial(0, 0, scenario, processes=False), run, 0.0)
        if pair.meeting_tick is not None and pair.orbiting_tick is not None:
            found.append(("meeting", pair.meeting_tick - pair.orbiting_tick, pair.t_max_ticks or 0))
    return found


def late(run: Run) -> Iterator[Breach]:
    """The computed bounds hold."""
    for what, ticks, bound in bounds(run):
        if ticks is None or ticks > bound:
            yield Breach("bound", f"{what}: {ticks} ticks, bound {bound}")


def truth_lost(run: Run) -> Iterator[Breach]:
    """The true pose is one of a robot's hypotheses, with exact sensors and honest peers.

    In a team, the first ranges of a robot may leave its heading open, or have two poses that are nearly one.
    """
    scenario = run.scenario
    honest = all(one.attack is None for one in scenario.robots)
    if not (scenario.mission.noise.exact and honest and scenario.team is None):
        return
    for place, robot in enumerate(scenario.robots):
        for estimate in run.estimates(robot.id):
            truth = run.ticks[estimate.tick].truth.poses[place]
            if estimate.world and not any(max(errors(one, truth)) < TRUTH_M for one in estimate.world):
                what = f"tick {estimate.tick}: none of the {len(estimate.world)} poses of {robot.id} is true"
                yield Breach("truth lost", what)
                break


def forgotten(run: Run) -> Iterator[Breach]:
    """No acknowledgement of a pair goes back, and nothing is sent from an earlier tick than before."""
    for robot, agent in run.agents.items() if run.scenario.in_pairs else ():
        before = (0, 0, 0, 0)
        for step in agent.steps:
            for framed in step.reports:
                one: Report = framed.report
                now = one.heard, one.ranges_heard, one.since, one.ranges_since
                if any(a < b for a, b in zip(now, before, strict=True)) and one.verdict is None:
                    yield Breach(
                        "acknowledgement", f"tick {one.tick}: {robot} goes back from {before} to {now}"
                    )
                    return
                before = now


def kept(run: Run) -> Iterator[Breach]:
    """The world keeps the claims that robots have made and not withdrawn, and no others."""
    dead = {one.robot for one in run.scenario.deaths}
    after = [*[tick.world.verdicts for tick in run.ticks[1:]], run.verdicts()]
    for tick, verdicts in zip(run.ticks, after, strict=True):
        for robot, command in tick.commands.items():
            claims, is_kept = (isinstance(one, Localised) for one in (command.verdict, verdicts.get(robot)))
            if claims != is_kept and robot not in dead and not run.scenario.in_pairs:
                what = (
                    f"tick {tick.truth.tick}: the world keeps {'the' if is_kept else 'no'} claim of {robot}"
                )
                yield Breach("withdrawn claim", what)
                return


def indefinite(run: Run) -> Iterator[Breach]:
    """Every covariance of a claim is positive definite, and finite."""
    for robot, agent in run.agents.items():
        for step in agent.steps:
            verdict = step.command.verdict if step.command is not None else None
            covariance = verdict.covariance if isinstance(verdict, Localised) else None
            if covariance is not None and not is_definite(np.array(covariance.matrix)):
                yield Breach("covariance", f"tick {step.observation.tick}: {robot}: {covariance}")
                break
