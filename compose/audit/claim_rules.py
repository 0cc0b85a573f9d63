"""Whether nobody was wrong, or could have been; and whether it ended as the referee says."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import astuple

from agent.planning.assured import CHECKED, CHECKED_WITH_OUTLIERS
from agent.planning.paper import CHECKED as CHECKED_BY_LETTER
from agent.planning.phase3_last_manoeuvre import ELSEWHERE
from agent.planning.range_seeking import travelled
from agent.process.agent_journal import Past
from compose.audit.evidence import Evidence
from compose.audit.findings import Checks, Violation, between
from protocol.messages import Localised, MissionEnd
from protocol.motion import Pose
from world.referee import inaccuracy, mistake
from world.scenario import RobotSpec

PLACES = 3
"""different relative placements that exact ranges must have been taken from: two leave several solutions"""


def claim(case: Evidence) -> Checks:
    """Whoever claimed to be localised was right, knew it as well as the mission asks for, and had a redundant
    range; the MissionEnd is the referee's."""
    for place, placed in enumerate(case.history.scenario.robots):
        tick, made = _first_claim(case, placed.id)
        if made is None:
            continue
        mission = case.history.scenario.mission
        why = mistake(made, case.history.ticks[tick].world.truth.poses[place], mission)
        yield None if why is None else Violation("claim", tick, placed.id, f"it claims a pose that is {why}")
        vague = inaccuracy(made, mission)
        yield None if vague is None else Violation("claim", tick, placed.id, f"it {vague}")
        past = case.pasts.get(placed.id)
        if past is not None and tick < len(past.steps) and past.steps[tick].command is not None:
            yield _redundant(case, placed, past, tick)
    yield from outcome(case)


def _first_claim(case: Evidence, robot: str) -> tuple[int, Localised | None]:
    """What it claimed, and when; whatever it says later, it has said that."""
    for tick, one in enumerate(case.history.ticks):
        command = one.commands.get(robot)
        if command is not None and isinstance(command.verdict, Localised):
            return tick, command.verdict
    return 0, None


def _redundant(case: Evidence, placed: RobotSpec, past: Past, tick: int) -> Violation | None:
    """It had as many ranges as a claim takes, until the last tick of which it had heard the peer's log."""
    scenario = case.history.scenario
    noise = scenario.mission.noise
    told = [told.report.through for step in past.steps[: tick + 1] for told in step.heard]
    through = min(max(told, default=-1), tick)
    mutual = _ranged(past, through)
    if noise.exact:
        places = _places(case, placed, mutual)
        return _too_few(tick, placed, "relative placements with a mutual range", places, PLACES)
    least = CHECKED if scenario.planner_name == "assured" else CHECKED_BY_LETTER
    if noise.outliers:
        least = CHECKED_WITH_OUTLIERS
    return _too_few(tick, placed, "mutual ranges", len(mutual), least)


def _too_few(tick: int, placed: RobotSpec, what: str, found: int, expected: int) -> Violation | None:
    if found >= expected:
        return None
    return Violation(
        "claim", tick, placed.id, f"it claims by {found} {what}, expected {expected} at the least"
    )


def _ranged(past: Past, through: int) -> list[int]:
    """The ticks of its mutual ranges."""
    return [
        step.observation.tick
        for step in past.steps[: through + 1]
        if any(contact.range is not None for contact in step.observation.contacts)
    ]


def _places(case: Evidence, placed: RobotSpec, ticks: Sequence[int]) -> int:
    """From how many different relative placements of the pair the ranges of those ticks were taken."""
    ids = [robot.id for robot in case.history.scenario.robots]
    one, other = ids.index(placed.id), ids.index(placed.peer)
    found: list[tuple[Pose, Pose]] = []
    for tick in ticks:
        local = case.history.ticks[tick].world.truth.local
        here = local[one], local[other]
        if all(
            any(travelled(*both) > ELSEWHERE for both in zip(here, there, strict=True)) for there in found
        ):
            found.append(here)
    return len(found)


def outcome(case: Evidence) -> Checks:
    """The MissionEnd is what the referee says, by the truth; a run may have failed before he says anything."""
    end, judgement = case.history.end, case.history.judgement
    if end is None:
        return
    expected = MissionEnd(end.tick, *astuple(judgement)) if judgement is not None else None
    if expected is not None and end != expected:
        what = f"it ends {_told(end)}, expected {_told(expected)}"
        yield Violation("claim", end.tick, None, what, between(end, expected))
    elif expected is None and end.outcome != "failed":
        yield Violation("claim", end.tick, None, f"it ends {_told(end)}, expected it to go on")
    else:
        yield None


def _told(end: MissionEnd) -> str:
    return f"{end.outcome} ({end.reason})" if end.reason else end.outcome
