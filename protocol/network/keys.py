"""The tree of Zenoh key expressions, one function per key, and the access rules for each key.

`run` and the robot ids are single chunks of a key. All received keys are read by `parse`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from inspect import signature
from types import MappingProxyType
from typing import Literal, NamedTuple

from protocol.units import MAX_ROBOT_ID, NAME

KEY_ROOT = "tandem"


def truth(run: str) -> str:
    """Return the key on which the world sends true poses to viewers."""
    return f"{KEY_ROOT}/{run}/world/truth"


def config(run: str, robot: str) -> str:
    """Return the key of the world's queryable for that robot's RobotConfig; the world declares it for "*"."""
    return f"{KEY_ROOT}/{run}/world/config/{robot}"


def observation(run: str, robot: str) -> str:
    """Return the key on which the world sends each Observation to that robot, and MissionEnd after the last.

    The world then sends the robot's FinalReport back, once it is in the recording. In hardware mode, a driver
    that waits for other robots sends a TickStart of the tick that cannot begin yet.
    """
    return f"{KEY_ROOT}/{run}/robot/{robot}/observation"


def command(run: str, robot: str) -> str:
    """Return the key on which that robot sends Commands, and a FinalReport at the end, to the world."""
    return f"{KEY_ROOT}/{run}/robot/{robot}/command"


def report(run: str, robot: str, peer: str) -> str:
    """Return the key on which that robot sends Reports to its peer while they are in contact."""
    return f"{KEY_ROOT}/{run}/robot/{robot}/to/{peer}"


def tick_start(run: str, robot: str) -> str:
    """Return the key on which a robot's driver sends the start of a tick to its peer's, in hardware mode."""
    return f"{KEY_ROOT}/{run}/robot/{robot}/tick-start"


def estimate(run: str, robot: str) -> str:
    """Return the key on which that robot sends its Estimate to viewers."""
    return f"{KEY_ROOT}/{run}/robot/{robot}/estimate"


def world_alive(run: str) -> str:
    """Return the key of the world's liveliness token; a run of "*" matches all runs."""
    return f"{KEY_ROOT}/{run}/alive/world"


def robot_alive(run: str, robot: str) -> str:
    """Return the key of a robot's liveliness token; a robot of "*" matches all robots of the run."""
    return f"{KEY_ROOT}/{run}/alive/robot/{robot}"


class Rule(NamedTuple):
    """The access rule of a key: which participants may do what with it.

    A participant is "world", "viewer", "robots" (any robot), or the name of a parameter of the key's
    function, which stands for the robot that the key names there.
    """

    way: Literal["put", "answer", "show"]
    """The operation: put frames, answer queries, or declare a liveliness token."""
    by: str
    """The participant that may do it."""
    to: tuple[str, ...]
    """The participants that may subscribe, query, or look for the token."""


KEY_RULES: Mapping[Callable[..., str], Rule] = MappingProxyType(
    {
        truth: Rule("put", "world", ("viewer",)),
        config: Rule("answer", "world", ("robot", "viewer")),
        observation: Rule("put", "world", ("robot", "viewer")),
        command: Rule("put", "robot", ("world", "viewer")),
        report: Rule("put", "robot", ("peer", "viewer")),
        tick_start: Rule("put", "world", ("world",)),
        estimate: Rule("put", "robot", ("world", "viewer")),
        world_alive: Rule("show", "world", ("robots", "viewer")),
        robot_alive: Rule("show", "robot", ("robot", "world", "viewer")),
    }
)
"""The rule of every key. Routers block all other operations of robots and viewers."""


class Key(NamedTuple):
    """The parsed key of a received message."""

    kind: Callable[..., str] | None
    """The function above that returns such keys; None for UNKNOWN_KEY."""
    run: str
    robot: str = ""
    """The robot of the key; for a Report, its sender."""
    peer: str = ""
    """The receiver of a Report; empty for other keys."""


UNKNOWN_KEY = Key(None, "")
"""The key of messages that did not come over the network."""

_LONGEST = 256
"""The maximum number of characters of a key that is parsed."""
_NAME = re.compile(NAME)
_PATTERNS = {
    kind: re.compile(kind(**{name: f"(?P<{name}>[^/]+)" for name in signature(kind).parameters}))
    for kind in KEY_RULES
}


def parse(key: str) -> Key | None:
    """Return the parsed `key`; None if it is not one of the keys above, or is a wildcard.

    Any participant can use any key expression, and a message on a wildcard reaches the subscribers of
    all keys that it matches.
    """
    return _parsed(key) if len(key) <= _LONGEST else None


@lru_cache(maxsize=1024)
def _parsed(key: str) -> Key | None:
    for kind, pattern in _PATTERNS.items():
        if (match := pattern.fullmatch(key)) is not None:
            named = match.groupdict()
            robots = [named[name] for name in named if name != "run"]
            if all(map(_NAME.search, named.values())) and all(len(one) <= MAX_ROBOT_ID for one in robots):
                return Key(kind, **named)
    return None
