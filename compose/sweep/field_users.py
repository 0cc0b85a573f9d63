"""The users of the fields of a scenario, from which sweeps know which fields change what is drawn.

All draws (starts, sensors, faults) follow from the seed of a trial and from fields of the world. Two cells
that differ in other fields only therefore have the same draws if their trials have the same seeds.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from itertools import chain
from typing import Any, Literal

from compose.sweep.draws import Draw
from compose.sweep.field_paths import Steps, value_at
from protocol.noise import PROFILES
from world.world_noise import RANGE_FIELDS, VELOCITY_FIELDS

User = Literal["world", "robots", "both"]
"""The user of a field: `world`, also if something is drawn from it or moves by it; `robots`, also if only the
referee or the launcher uses it; `both`: the robots, and the world unless its own noise has the field."""

FIELDS_OF_USERS: Mapping[User, Mapping[str, str]] = {
    "world": {
        "": "seed world fault anchor",
        "robot.": "id anchor anchors start peer dies",
        "group.": "robots spacing without_anchor dies",
        "team.": "robots side anchors unknown dies",
        "mission.": "sensing_range period max_speed max_turn_rate area frame diameter",
    },
    "robots": {
        "": "name max_ticks planner kill clock robot.attack group.attack team.attack",
        "mission.": "accuracy confidence safety_distance tolerates survey",
        "mission.noise.": "range_bias pair_bias range_scale slow_sigma slow_time wheel_scale gyro_bias "
        "sigma_degrees survey_error range_delay range_depth strays odometry_strays",
    },
    "both": {
        "mission.noise.": " ".join((*RANGE_FIELDS, "profile")),
        "mission.noise.actuation.": " ".join(VELOCITY_FIELDS),
        "mission.noise.odometry.": " ".join(VELOCITY_FIELDS),
    },
}
"""The names of fields by their user, and by the path of the table that has them."""

USERS: Mapping[str, User] = {
    table + name: user
    for user, tables in FIELDS_OF_USERS.items()
    for table, names in tables.items()
    for name in names.split()
}
"""The user of each field, by its path without indices; that of a table stands for all fields in it."""


def changes_draws(
    way: Steps, base: Mapping[str, Any], varied: Collection[Steps], draws: Collection[Draw]
) -> bool:
    """Return whether another value of the field at `way` changes what is drawn, or how the world answers.

    `base` is the table of the scenario, `varied` are the paths of all fields that the sweep varies, and
    `draws` the fields that each trial draws, which may be scaled by others.
    """
    if any(overlap(way, scale) for draw in draws for scale in (*draw.times, *draw.over)):
        return True
    path = tuple([step for step in way if isinstance(step, str)])
    users = {field: user for field, user in USERS.items() if overlap(path, tuple(field.split(".")))}
    return any(
        user == "world" or (user == "both" and not _own_noise(field, base, varied))
        for field, user in users.items()
    )


def _own_noise(field: str, base: Mapping[str, Any], varied: Collection[Steps]) -> bool:
    """Return whether the world has noise of its own in place of `field` of the mission, in all cells."""
    for own in _in_place_of(field):
        try:
            given = value_at(base, own)
        except (KeyError, IndexError, TypeError):
            return False
        if given is None or any(way != own and overlap(way, own) for way in varied):
            return False
    return True


def _in_place_of(field: str) -> Iterator[Steps]:
    """Yield the paths of the fields of `[world.noise]` that the world would take from `field`."""
    name = field.removeprefix("mission.noise.")
    if name == "profile":
        given = set(chain.from_iterable(PROFILES.values()))
        yield from [("world", "noise", one) for one in RANGE_FIELDS if one in given]
    else:
        yield "world", "noise", *name.split(".")


def overlap(one: Steps, other: Steps) -> bool:
    """Return whether one of the two paths leads to the other."""
    shorter = min(len(one), len(other))
    return one[:shorter] == other[:shorter]
