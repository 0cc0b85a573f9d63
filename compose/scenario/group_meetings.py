"""The meetings of a group of robots: who visits whom, and the bound of the time until all are localised."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import permutations
from typing import NamedTuple

import msgspec

from compose.errors import Unworkable
from compose.launch import planner_loader
from compose.scenario.group_plan import PlannedVisit, group_plan
from compose.scenario.scenario_tables import PlannerTable, RobotTable
from protocol.messages import Appointment
from protocol.mission import Mission, Role
from protocol.orbits import Rendezvous, meeting_ticks, pair_ticks, search_ticks, visiting
from world.faults import Fault, exchange_ticks
from world.scenario import PlannedConfirmation, PlannedCoverage, PlannedMeeting

NEIGHBOURS = 3
"""The number of nearest anchors among which a robot's first peer is chosen, in a large group."""

MOST_TURNED = 0.15
"""The largest rotation in rad by which a gyro of one sigma may mislead a robot until the end of the plan.

The search for hypotheses takes the measured path for nearly right. With 0.003 rad/s, the default of a pair,
1 of 47 claims of groups of 4 was wrong: its visitor had driven for 130 s.
"""

RETRIES = 2
"""The least number of pairs that try again, in turn. With three robots, they are all other pairs."""

VISITS_SLOWER = 2.0
"""The time for the visits after them, in units of the planned one: robots are not where they were planned."""

ALLOWED_SIDES = 3
"""The number of sides of its search across its way that the bound of a visit under noise allows for.

They reach robots 4.75 R to either side. These are 3.8 sigmas of a heading that is just accurate enough to
leave with, so one visit in 7 000 takes longer.
"""

LARGE = 12
"""The number of robots from which on a group is large."""


class FirstMeeting(NamedTuple):
    """The first meeting of a robot."""

    peer: str
    role: Role
    rendezvous: Rendezvous


class GroupMeetings(NamedTuple):
    """The meetings of a group."""

    meetings: tuple[PlannedMeeting, ...]
    """All meetings, in the order in which they end."""
    first: dict[str, FirstMeeting]
    """The first meeting of each robot."""
    bound: float
    """The bound in s of the time at which all robots are localised."""
    retries: tuple[Appointment, ...]
    """The meetings with which the group tries again if a first meeting has failed."""
    latest: float
    """The bound in s of the time at which the last of these has localised all robots that can be."""
    least_bound: float
    """A lower bound in s of the `bound` of any plan."""
    planned_sweep: PlannedCoverage | None = None
    """The search for robots without an anchor; None if all have one."""
    confirmation: PlannedConfirmation | None = None
    """The meetings that confirm poses; None if robots claim the pose that they know."""


def group_meetings(
    robots: Sequence[RobotTable],
    mission: Mission,
    planner: PlannerTable,
    faults: Sequence[Fault] = (),
    *,
    tolerates: int = 0,
) -> GroupMeetings:
    """Return the meetings of `robots`, which have anchors, planned for the shortest bound.

    `tolerates` of them may report false data: some pair of the plan is without them.

    Who meets whom does not depend on the `faults` of the radio, but the bounds do. Raises Unworkable if the
    planner is not made for groups, and UserError if it cannot be loaded.
    """
    if not planner_loader.is_for_groups(planner.name, helps=tolerates > 0):
        instead = "confirm no poses" if tolerates else "meet in pairs: set robot.peer"
        raise Unworkable(f"planner.name: robots with the planner {planner.name} {instead}")
    anchors = [robot.anchor for robot in robots if robot.anchor is not None]
    ids = [robot.id for robot in robots]
    nearest = mission.orienting_distance
    near = _neighbours(anchors, nearest)
    if not any(near):
        raise Unworkable(
            f"robot.anchor: no two anchors are {nearest:.3g} m apart, and with mission.noise, robots with "
            "nearer ones cannot determine their headings"
        )

    def rendezvous(i: int, j: int) -> Rendezvous:
        return planner_loader.orbits(
            planner.name, planner.options, mission, math.dist(anchors[i], anchors[j])
        )

    def pair_time(i: int, j: int) -> float:
        if math.dist(anchors[i], anchors[j]) < nearest or (len(robots) >= LARGE and j not in near[i]):
            return math.inf
        return pair_ticks(mission, rendezvous(i, j)) * mission.period

    meeting = meeting_ticks(mission) * mission.period
    plan = group_plan(anchors, pair_time, mission.max_speed, meeting, nearest)
    check_gyros(mission, plan.bound, "of the plan", ", or let the robots meet in pairs")
    extra = exchange_ticks(faults)
    meetings = _delayed(plan.meetings, mission, (extra[0] * mission.period, extra[1] * mission.period))
    bound = meetings[-1].ends
    planned = tuple([PlannedMeeting(ids[one.visitor], ids[one.visited], one.ends) for one in meetings])
    first: dict[str, FirstMeeting] = {}
    for one in plan.meetings:
        a, b = ids[one.visitor], ids[one.visited]
        if a in first:
            orbits = visiting(mission, math.dist(anchors[one.visitor], anchors[one.visited]))
        else:
            orbits = rendezvous(one.visitor, one.visited)
            first[a] = FirstMeeting(b, "a", orbits)
        first[b] = FirstMeeting(a, "b", orbits)
    seeds = [(one.visitor, one.visited) for one in plan.meetings if one.first]
    spread = bound - min(one.ends for one in meetings if one.first)
    begins, retries = bound + VISITS_SLOWER * spread, []
    for i, j in _retried(seeds, len(robots), pair_time, tolerates):
        lasts = pair_time(i, j) + extra[0] * mission.period
        retries.append(Appointment(ids[i], ids[j], rendezvous(i, j), begins, lasts))
        begins += lasts + VISITS_SLOWER * spread
    return GroupMeetings(planned, first, bound, tuple(retries), begins, plan.least_bound)


def _delayed(
    meetings: Sequence[PlannedVisit], mission: Mission, delays: tuple[float, float]
) -> list[PlannedVisit]:
    """Return `meetings` with the bounds that allow for lost and late reports, and for searches under noise.

    `delays` are those of each meeting, and of the first one of each robot besides, in s.
    """
    of_each, of_first = delays
    search = search_ticks(mission, ALLOWED_SIDES) * mission.period
    later: dict[int, float] = {}
    found = []
    for one in meetings:
        late = (of_first if one.first else later[one.visitor] + search) + of_each
        later[one.visitor] = later[one.visited] = late
        found.append(msgspec.structs.replace(one, ends=one.ends + late))
    return sorted(found, key=lambda one: one.ends)


def check_gyros(mission: Mission, seconds: float, when: str, instead: str = "") -> None:
    """Raise Unworkable if a bias of the gyros turns a robot too far within the `seconds` without a fix."""
    turned = mission.noise.priors.gyro_bias * seconds
    if turned > MOST_TURNED:
        raise Unworkable(
            f"mission.noise.gyro_bias: within the {seconds:.0f} s {when}, a bias of "
            f"{mission.noise.priors.gyro_bias:g} rad/s turns a robot by {turned:.2g} rad, more than "
            f"{MOST_TURNED:g}: calibrate the gyros to {rounded_down(MOST_TURNED / seconds):g} rad/s{instead}"
        )


def rounded_down(value: float) -> float:
    """Return the positive `value` rounded down to two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / unit) * unit


def _retried(
    seeds: Sequence[tuple[int, int]], robots: int, pair_time: Callable[[int, int], float], tolerates: int
) -> list[tuple[int, int]]:
    """Return the pairs that try again in their order: robots that have been in few pairs, then quick pairs.

    If one robot is the reason why a first pair has failed, one of the next two pairs is without it. There are
    more than two if `tolerates` robots could be in all pairs, the first ones included.
    """
    uses = [sum([robot in pair for pair in seeds]) for robot in range(robots)]
    tried = {frozenset(pair) for pair in seeds}
    timed = [(pair_time(a, b), a, b) for a, b in permutations(range(robots), 2)]
    possible = [one for one in timed if one[0] < math.inf]
    found: list[tuple[int, int]] = []
    while len(found) < RETRIES or len(tried) <= sum(sorted(uses, reverse=True)[:tolerates]):
        left = [(uses[a] + uses[b], time, a, b) for time, a, b in possible if frozenset((a, b)) not in tried]
        if not left:
            break
        _, _, a, b = min(left)
        found.append((a, b))
        tried.add(frozenset((a, b)))
        uses[a] += 1
        uses[b] += 1
    return found


def _neighbours(anchors: Sequence[tuple[float, float]], nearest: float) -> list[set[int]]:
    """Return the NEIGHBOURS nearest anchors of each anchor, of those at least `nearest` m from it."""
    found = []
    for i, one in enumerate(anchors):
        apart = {j: math.dist(one, other) for j, other in enumerate(anchors) if j != i}
        far = [j for j in apart if apart[j] >= nearest]
        found.append(set(sorted(far, key=apart.__getitem__)[:NEIGHBOURS]))
    return found
