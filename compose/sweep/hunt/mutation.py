"""The inputs of a hunt, which are scenario files as tables, and how one is made of another.

Every function of MUTATIONS returns a changed copy of a table, or None if it has nothing to change. Ticks are
drawn near the moments of the earlier run: those in which a robot began another task, met or claimed.
"""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from typing import Any, get_args

import msgspec

from compose.launch.planner_loader import PLANNER_NAMES
from compose.scenario.fault_syntax import EVERYWHERE
from compose.scenario.kills import DRAWN_VALUE, KILL_POINTS, WORLD
from compose.scenario.scenario_file import scenario_table
from compose.sweep import spec
from compose.sweep.cells import cells
from compose.sweep.draws import Draws, Heading, Place, StartsTable
from protocol import attack

Table = dict[str, Any]
"""The content of a scenario file."""

ALIKE = (("a", "A"), ("r1", "R1"), ("r1", "r10"), ("a", "aa"), ("a-b", "a_b"), ("0", "00"), ("World", "w"))
"""Names of two robots that something which compares them wrongly may confuse."""
RANGE_SIGMAS = (0.001, 0.01, 0.05, 0.1)
"""The sigmas in m of ranges that are drawn."""
GYRO_BIASES = (0.0, 0.0002)
"""The sigmas in rad/s of gyro biases that are drawn: groups need calibrated gyros."""
MOST_FAULTS, MOST_KILLS = 5, 16
"""The numbers of faults and of kills beyond which none is added."""
CELLS_OF_SWEEP = 6
"""The number of cells of each shipped sweep, evenly spread, from which the corpus begins."""


class Clues(msgspec.Struct, frozen=True):
    """The places of an earlier run at which to change its input."""

    robots: tuple[str, ...]
    ticks: int = 50
    """The number of ticks."""
    moments: tuple[int, ...] = ()
    """The ticks in which something changed."""

    def tick(self, draw: random.Random) -> int:
        """Return a tick near a moment, or any."""
        if self.moments and draw.random() < 0.7:
            return max(0, draw.choice(self.moments) + draw.choice((-1, 0, 0, 1)))
        return draw.randrange(self.ticks + 1)


def seeds(source: str) -> list[Table]:
    """Return the inputs with which the hunt begins: `source`, then cells of the shipped sweeps of it.

    Those of few robots come first, since they take less time. Exact and noisy sensors take turns.
    """
    found = [scenario_table(source)]
    for name in spec.shipped():
        sweep = spec.load(name)
        if sweep.base.get("name") == source:
            every = list(cells(sweep))
            found += [copy.deepcopy(dict(one.table)) for one in every[:: -(-len(every) // CELLS_OF_SWEEP)]]
    small = sorted(found[1:], key=lambda one: one["group"]["robots"] if "group" in one else 0)
    turn = {False: count(), True: count()}
    return [found[0], *sorted(small, key=lambda one: next(turn[is_noisy(one)]))]


def robots_of(table: Mapping[str, Any]) -> list[str]:
    """Return the ids of the robots of the input."""
    drawn = table.get("group") or table.get("team") or {"robots": 0}
    return [one["id"] for one in table.get("robot", [])] or [f"r{i + 1}" for i in range(drawn["robots"])]


def of_its_robots(table: Table) -> Table:
    """Return `table` without the clocks, faults and kills of robots that it does not have."""
    there, found = {*robots_of(table), WORLD, EVERYWHERE, DRAWN_VALUE}, {**table}
    for name in [one for one in LISTS if one in table]:
        found[name] = [row for row in table[name] if there.issuperset(_named(row))]
    return found


def _named(row: Mapping[str, Any]) -> list[str]:
    """Return the robots that a row of LISTS names."""
    who = row.get("who", row.get("link", EVERYWHERE))
    return who if isinstance(who, list) else re.split(r"\s*<?->\s*", who.strip())


def is_noisy(table: Mapping[str, Any]) -> bool:
    """Return whether the robots of the input are told that their sensors have noise."""
    return any(table["mission"].get("noise", {}).values())


def mutated(
    table: Mapping[str, Any], known: Clues, draw: random.Random, changes: Mapping[Change, float] | None = None
) -> Table:
    """Return `table` with one to three of `changes`, by default of MUTATIONS.

    In half of the cases noisy sensors draw other noise, too: the same noise mostly gives the same again.
    """
    found, weights = copy.deepcopy(dict(table)), changes or MUTATIONS
    if is_noisy(found) and draw.random() < 0.5:
        found["seed"] = draw.getrandbits(31)
    for _ in range(draw.choice((1, 1, 2, 3))):
        changed = None
        while changed is None:  # a change that has nothing to change would run the same input again
            [change] = draw.choices(list(weights), list(weights.values()))
            changed = change(copy.deepcopy(found), known, draw)
        found = changed
    return of_its_robots(found)


def _seed(table: Table, _known: Clues, draw: random.Random) -> Table:
    return {**table, "seed": draw.getrandbits(31)}


def _start(table: Table, _known: Clues, draw: random.Random) -> Table | None:
    """Draw the start of a robot, special places and headings included."""
    robots = table.get("robot", [])
    if not robots or any("anchor" not in one for one in robots):
        return None
    kinds = StartsTable((draw.choice(get_args(Place)),), (draw.choice(get_args(Heading)),))
    drawn = Draws(starts=kinds).table(table, draw.getrandbits(31))["robot"]
    chosen = draw.randrange(len(robots))
    for i, robot in enumerate(robots):
        if i == chosen or draw.random() < 0.5:
            robot["start"] = drawn[i]["start"]
    return table


def _fault(table: Table, known: Clues, draw: random.Random) -> Table | None:
    """Add a fault of the radio, mostly of a few ticks."""
    if len(table.get("fault", [])) >= MOST_FAULTS:
        return None
    one, other = draw.sample(known.robots, 2) if len(known.robots) > 1 else (known.robots * 2)[:2]
    fault: Table = {"link": draw.choice((f"{one}->{other}", f"{one}<->{other}", "*"))}
    low = draw.randrange(8)
    fault |= draw.choice(
        [
            {"loss": draw.choice((0.2, 0.5, 0.9))},
            {"burst_start": 0.2, "burst_end": 0.2},
            {"delay": [low, low + draw.randrange(12)]},
            {"duplicate": 0.7, "delay": [0, low]},
            {"reorder": 0.5},
            {"corrupt": 0.4},
            {"reports_per_tick": draw.choice((0.3, 0.7))},
            {"partition": True},
        ]
    )
    if "partition" in fault or draw.random() < 0.6:
        first, kind = known.tick(draw), draw.choice(("ticks", "contact_ticks"))
        first = min(first, draw.randrange(20)) if kind == "contact_ticks" else first
        fault[kind] = [first, first + draw.choice((1, 2, 5, 10, 30))]
    table.setdefault("fault", []).append(fault)
    return table


def kills_added(table: Table, known: Clues, draw: random.Random) -> Table | None:
    """Add kills of processes, or kill one at the same point of many ticks.

    Sensors that are exact allow many: what a killed process replays is short.
    """
    most = MOST_FAULTS if is_noisy(table) else MOST_KILLS
    if draw.random() < IN_TURN_SHARE:
        first = max(0, min(known.tick(draw), known.ticks - most))
        one = {"who": draw.choice([*known.robots, WORLD]), "point": draw.choice(KILL_POINTS)}
        return {**table, "kill": [{**one, "tick": first + i} for i in range(most)]}
    if len(table.get("kill", [])) >= most:
        return None
    for _ in range(min(most - len(table.get("kill", [])), draw.choice((1, 2, 5, most)))):
        who: Any = draw.choice([*known.robots, WORLD])
        kill = {"who": who, "tick": known.tick(draw), "point": draw.choice(KILL_POINTS)}
        if draw.random() < 0.3:
            kill["after"] = draw.choice((0.5, 1.5, 4.0))
        table.setdefault("kill", []).append(kill)
    return table


def _clock(table: Table, known: Clues, draw: random.Random) -> Table:
    """Give a process another clock. A mission takes about 1 s in lockstep, and 60 s in hardware mode.

    In half of the cases, faults and kills are left out: only then it also runs in hardware mode.
    """
    if draw.random() < 0.5:
        table = {name: part for name, part in table.items() if name not in ("fault", "kill")}
    last = draw.choice((1.0, 60.0))
    jumps = [[last * draw.random(), draw.choice((-10.0, 0.5, 10.0))] for _ in range(draw.randrange(4))]
    error: Table = {"offset": draw.choice((-1.0, 0.0, 1.0)), "drift": draw.choice((-100.0, 100.0))}
    who: Any = draw.choice([*known.robots, WORLD])
    others = [one for one in table.get("clock", []) if one["who"] != who]
    return {**table, "clock": [*others, {"who": who, "jumps": jumps} | error]}


def _attack(table: Table, _known: Clues, draw: random.Random) -> Table | None:
    """Let a robot report false data."""
    kind = draw.choice(get_args(attack.Kind))
    part = "all" if kind in attack.OF_THE_START else draw.choice(get_args(attack.Part))
    size = draw.choice((0.01, 0.1, 0.3, 1.0)) if kind != "scale" else draw.choice((0.5, 0.99, 1.01))
    false = {"kind": kind, "size": size, "part": part}
    return _given(table, draw, "attack", false, [one for one in table.get("robot", []) if "anchor" in one])


def _given(table: Table, draw: random.Random, field: str, value: Any, robots: list[Table]) -> Table | None:
    """Give a `field` to the group of the input, or to one of `robots`; None if there are none."""
    if "group" not in table and not robots:
        return None
    (table["group"] if "group" in table else draw.choice(robots))[field] = value
    return table


def _link(table: Table, known: Clues, draw: random.Random) -> Table | None:
    """Attack the ranges of one link, for which sensors must have noise."""
    if not is_noisy(table):
        return None
    one, other = draw.sample(known.robots, 2) if len(known.robots) > 1 else (known.robots * 2)[:2]
    mutual = f"mutual/{one}" if len(known.robots) == 2 else f"mutual/{one}-{other}"
    options: Table = {"link": draw.choice((mutual, mutual, f"anchor/{one}")), "begins": known.tick(draw)}
    options |= draw.choice(({"by": draw.choice(LENGTHENED)}, {"relay": 3.0}, {"jam": True}))
    if draw.random() < 0.5:
        options["ends"] = options["begins"] + draw.choice((1, 10, 60))
    table["world"] = {**table.get("world", {}), "range": {"model": "attacked", "options": options}}
    return table


LENGTHENED = (-1.0, -0.3, 0.3, 1.0)
"""The lengths in m by which an attack makes ranges longer."""


def _death(table: Table, known: Clues, draw: random.Random) -> Table | None:
    """Let a robot of a group die."""
    robots = table.get("robot", [])
    return _given(table, draw, "dies", known.tick(draw), robots if len(robots) > 2 else [])


def _noise(table: Table, _known: Clues, draw: random.Random) -> Table:
    """Give all sensors other noise, which the robots are told."""
    sigma = draw.choice(RANGE_SIGMAS)
    noise: Table = {"anchor_sigma": sigma, "mutual_sigma": sigma, "gyro_bias": draw.choice(GYRO_BIASES)}
    if draw.random() < 0.5:
        noise |= {"outliers": draw.choice((0.05, 0.2)), "drop_outs": draw.choice((0.0, 0.2))}
    if draw.random() < 0.5:
        noise |= {name: {"v": 0.001, "omega": 0.001} for name in ("actuation", "odometry")}
    table["mission"] |= {"noise": noise, "accuracy": max(0.1, 2.0 * sigma)}
    return table


def _names(table: Table, _known: Clues, draw: random.Random) -> Table | None:
    """Give the robots other names."""
    robots = table.get("robot", [])
    if len(robots) < 2:
        return None
    given = [one["id"] for one in robots]
    others = [f"x{i}" for i in range(len(robots) - 2)]
    names = dict(zip(given, draw.sample([*draw.choice(ALIKE), *others], len(given)), strict=True))
    for robot in robots:
        robot |= {name: names[robot[name]] for name in ("id", "peer") if name in robot}
    for row in [*table.get("kill", []), *table.get("clock", [])]:
        who = row.get("who", DRAWN_VALUE)
        row["who"] = [names.get(one, one) for one in who] if isinstance(who, list) else names.get(who, who)
    table["fault"] = [one for one in table.get("fault", []) if one.get("link", "*") == "*"]
    return table


def _setting(table: Table, _known: Clues, draw: random.Random) -> Table | None:
    """Change a number or a name in a table that the input has: one of SETTINGS, or by one of FACTORS."""
    path = draw.choice([*SETTINGS, *SCALED])
    part, _, name = path.partition(".")
    if part not in table and part != "planner":
        return None
    inner = table.setdefault(part, {})
    inner[name] = draw.choice(SETTINGS[path]) if path in SETTINGS else inner[name] * draw.choice(FACTORS)
    return table


SETTINGS: Mapping[str, Sequence[Any]] = {
    "planner.name": PLANNER_NAMES,
    "mission.safety_distance": (0.0, 0.3, 0.8),
    "mission.tolerates": (0, 1),
    "group.robots": (3, 3, 4, 5),
    "group.without_anchor": (0, 1),
}
"""The values from which fields are drawn."""
SCALED = (
    "mission.period", "mission.max_speed", "mission.max_turn_rate", "mission.sensing_range", "group.spacing",
)  # fmt: skip
"""The lengths, speeds and times that are multiplied."""
FACTORS = (0.3, 0.7, 0.9, 1.1, 1.5, 3.0)
"""The factors of lengths, speeds and times."""


def _anchor(table: Table, _known: Clues, draw: random.Random) -> Table | None:
    """Move an anchor; its robot then starts anywhere in its range."""
    anchored = [one for one in table.get("robot", []) if "anchor" in one]
    if not anchored:
        return None
    one, factor = draw.choice(anchored), draw.choice(FACTORS)
    x, y = one["anchor"]
    one["anchor"] = [x * factor, y * factor + draw.choice((0.0, 0.0, 2.0))]
    one.pop("start", None)
    return table


def _less(table: Table, _known: Clues, draw: random.Random) -> Table | None:
    """Leave out some of the faults, kills and clocks."""
    lists = [name for name in LISTS if table.get(name)]
    if not lists:
        return None
    name = draw.choice(lists)
    return {**table, name: draw.sample(table[name], draw.randrange(len(table[name])))}


IN_TURN_SHARE = 0.3
"""The share of kills that are those of one process at one point of consecutive ticks."""


Change = Callable[[Table, Clues, random.Random], Table | None]

MUTATIONS: Mapping[Change, float] = {
    _seed: 2.0,
    _start: 2.0,
    _fault: 3.0,
    kills_added: 3.0,
    _clock: 1.0,
    _attack: 1.0,
    _link: 0.5,
    _death: 0.7,
    _noise: 0.4,
    _names: 0.7,
    _setting: 1.5,
    _anchor: 0.5,
    _less: 1.5,
}
"""The changes of an input, and how often each is drawn."""
WITHIN_BOUNDS: Mapping[Change, float] = {_seed: 1.0, _start: 1.0, _setting: 1.5, _anchor: 1.0}
"""The changes after which computed bounds still hold, and how often each is drawn to come nearer to one."""


def simpler(table: Table, source: Table) -> Iterator[Table]:
    """Yield `table` with one of its differences from `source` undone, at any depth, the largest first.

    Faults and kills come first: they are left out as a whole, then by halves, and then by parts of those.
    """
    for key in sorted(table.keys() | source.keys(), key=lambda name: (name not in LISTS, name)):
        one, other = table.get(key), source.get(key)
        if one == other:
            continue
        if key in LISTS:
            yield from [{**table, key: rows} for rows in _fewer(list(one or ()))]
            continue
        without = {name: part for name, part in table.items() if name != key}
        yield {**without, key: other} if key in source else without
        if isinstance(one, dict):
            yield from [{**table, key: part} for part in simpler(one, other or {})]
        elif isinstance(one, list):
            others = other if isinstance(other, list) and len(other) == len(one) else [{}] * len(one)
            yield from [{**table, key: rows} for rows in _nearer(one, others)]


def _fewer(rows: list[Any]) -> Iterator[list[Any]]:
    """Yield `rows` without all, without each half and so on, and then without one field of one of them."""
    size = len(rows)
    while size:
        yield from [[*rows[:i], *rows[i + size :]] for i in range(0, len(rows), size)]
        size //= 2
    yield from _nearer(rows, [{}] * len(rows))


def _nearer(rows: Sequence[Any], others: Sequence[Any]) -> Iterator[list[Any]]:
    """Yield `rows` with one difference of a row from that of `others` undone."""
    for i, (row, other) in enumerate(zip(rows, others, strict=True)):
        if isinstance(row, dict) and isinstance(other, dict):
            yield from [[*rows[:i], less, *rows[i + 1 :]] for less in simpler(row, other)]


LISTS = ("clock", "fault", "kill")
"""The lists of a scenario file whose rows are in no order."""


def fault_lines(table: Mapping[str, Any], source: Mapping[str, Any]) -> int:
    """Return the number of faults, kills, attacks, deaths and other fields by which `table` differs."""
    one, other = dict(_fields(table)), dict(_fields(source))
    return sum([one.get(key) != other.get(key) for key in one.keys() | other.keys()])


def _fields(table: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the names of all fields of `table` with their values; a row of LISTS is one."""
    for name, part in table.items():
        if name in LISTS:
            yield from [((name, repr(row)), True) for row in part]
        elif isinstance(part, list):
            rows = [(str(i), row) for i, row in enumerate(part)]  # another id is one change
            yield from [((name, i, field), value) for i, row in rows for field, value in row.items()]
        elif isinstance(part, dict):
            yield from [((name, field), value) for field, value in part.items()]
        elif name not in ("name", "seed"):
            yield (name,), part
