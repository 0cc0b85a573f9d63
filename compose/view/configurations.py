"""The configurations of a pair: the poses of both robots that belong together, and its last manoeuvre."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from compose.launch.planner_loader import is_shipped, planner_class
from compose.recording.run_setup import RunSetup
from compose.view.pair_data import PairData
from compose.view.run_data import TickData
from protocol.messages import Command, Estimate
from protocol.motion import ORIGIN, Pose, compose, inverse, travelled

FITTING_M = 1e-3
"""The largest difference in m between an exact range and the distance of two poses of one configuration."""
MOST_CONFIGURATIONS = 60
"""The largest number of configurations; with more, there are none.

Robots hold far fewer. The manoeuvres are compared by each pair of configurations: with thousands in a damaged
recording, or from a hostile publisher, memory would run out.
"""
SHOWN_EVERY = 12
"""Every twelfth turn rate of eq. (8) is shown."""


class Reachable(msgspec.Struct, frozen=True):
    """A turn rate of the last manoeuvre in rad/s, and its end point relative to the pose before it.

    x is ahead and y to the left, in m.
    """

    omega: float
    x: float
    y: float
    separation_m2: float
    """J of eq. (8): the smallest difference of the predicted squared ranges of two configurations, in m^2."""


class ComparedManoeuvre(msgspec.Struct, frozen=True):
    """The last manoeuvre that a robot has chosen in this tick, and a selection of those that it compared."""

    robot: str
    separation_m2: float
    """J of eq. (8) in m^2 for the chosen manoeuvre."""
    reachable: tuple[Reachable, ...]
    """End points with the chosen speed, in the order of their turn rates."""


class Configurations(msgspec.Struct, frozen=True, omit_defaults=True):
    """The possible configurations of a pair: the i-th poses of both robots in the world belong together."""

    robots: tuple[str, str]
    """The robots of role a and b."""
    count: int
    manoeuvre: ComparedManoeuvre | None = None


def configurations(setup: RunSetup, before: TickData | None, now: TickData) -> Iterator[Configurations]:
    """Yield the configurations of each pair whose robots hold the same ones, at most MOST_CONFIGURATIONS."""
    for robots in setup.pairs():
        pair = PairData(robots, setup, before, now)
        poses = _joined(pair)
        if poses:
            manoeuvre = _manoeuvre(pair, setup, poses) if len(poses) > 1 else None
            yield Configurations((pair.ids[0], pair.ids[1]), len(poses), manoeuvre)


def _joined(pair: PairData) -> list[tuple[Pose, Pose]]:
    """Return the poses of a and b in each configuration; empty if the robots do not hold the same ones.

    With noise, the robots hold the same configurations if these have the same probabilities. Exact poses of a
    and b belong together if their distance is the range of this tick, or that of the tick before if the
    robots held as many poses then.
    """
    both = [pair.held(robot) for robot in pair.ids]
    earlier, held = [_world(before) for before, _ in both], [_world(now) for _, now in both]
    a, b = held
    if not 0 < len(a) == len(b) <= MOST_CONFIGURATIONS:
        return []
    if not pair.exact:
        joined = _same([now for _, now in both]) or (len(a) == 1 and _same([before for before, _ in both]))
        # a robot that drives back into its peer's range under noise does not estimate again until it is there
        unchanged = [robot for robot, was, now in zip(pair.ids, earlier, held, strict=True) if was == now]
        joined = joined and not any(map(pair.drove, unchanged))
    else:
        as_many = [len(poses) for poses in earlier] == [len(a), len(b)]
        joined = _fit(pair, pair.now, held) or (as_many and _fit(pair, pair.before, earlier))
    return list(zip(a, b, strict=True)) if joined else []


def _world(held: Estimate | None) -> tuple[Pose, ...]:
    return held.world if held is not None else ()


def _same(held: list[Estimate | None]) -> bool:
    """Return whether noisy estimates have several probabilities, and the same ones."""
    found = {one.probabilities if one is not None and one.world else () for one in held}
    return len(found) == 1 and len(next(iter(found))) > 1


def _fit(pair: PairData, data: TickData | None, held: list[tuple[Pose, ...]]) -> bool:
    contact = pair.contact(data)
    if contact is None or contact.range is None:
        return False
    return all(abs(travelled(p, q) - contact.range) < FITTING_M for p, q in zip(*held, strict=True))


def _manoeuvre(pair: PairData, setup: RunSetup, poses: list[tuple[Pose, Pose]]) -> ComparedManoeuvre | None:
    """Return the last manoeuvre that a robot of the pair has begun, compared as its planner compares it."""
    for robot in pair.ids:
        command = pair.commands(robot)[1]
        if command is not None and pair.begins(robot, "last-manoeuvre"):
            return _compared(robot, command, setup, poses, robot == pair.ids[0])
    return None


def _compared(
    robot: str, command: Command, setup: RunSetup, poses: list[tuple[Pose, Pose]], moves_a: bool
) -> ComparedManoeuvre | None:
    from agent.estimation.closed_forms import Placement  # noqa: PLC0415  # numpy, for few ticks only
    from agent.planning.phase3_last_manoeuvre import Question, compared  # noqa: PLC0415

    name = setup.planner_name
    manoeuvres = planner_class(name).MANOEUVRES if is_shipped(name) else None
    if manoeuvres is None:
        return None
    relative = [compose(inverse(b), a) for a, b in poses]
    places = tuple([Placement(one.heading, one.x, one.y) for one in relative])
    ways = compared(Question("a" if moves_a else "b", ORIGIN, ORIGIN, places), setup.mission, manoeuvres)
    row = int(abs(ways.reach.v[:, 0] - command.v).argmin())
    column = int(abs(ways.reach.omega - command.omega).argmin())
    turns = ways.reach.omega[::SHOWN_EVERY].tolist()
    shown = [values[row, ::SHOWN_EVERY].tolist() for values in (ways.reach.x, ways.reach.y, ways.gap)]
    return ComparedManoeuvre(robot, float(ways.gap[row, column]), tuple(map(Reachable, turns, *shown)))
