"""The key-expression tree, one function a key, and who may do what. `run` and robot ids are single chunks.

`parse` is the one reader of keys that arrive.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from inspect import signature
from types import MappingProxyType
from typing import Literal, NamedTuple

from protocol.units import MAX_ROBOT_ID, NAME

ROOT = "tandem"


def truth(run: str) -> str:
    """World to viewers: true poses."""
    return f"{ROOT}/{run}/world/truth"


def briefing(run: str, robot: str) -> str:
    """Queryable at the world: what that robot needs to start. The world answers under "*"."""
    return f"{ROOT}/{run}/world/briefing/{robot}"


def sense(run: str, robot: str) -> str:
    """World to that robot: Sense; End when it is over; then its own Farewell, which is on record."""
    return f"{ROOT}/{run}/robot/{robot}/sense"


def drive(run: str, robot: str) -> str:
    """That robot to the world: Drive, and Farewell when it is over."""
    return f"{ROOT}/{run}/robot/{robot}/drive"


def report(run: str, robot: str, peer: str) -> str:
    """That robot to its peer, only in contact."""
    return f"{ROOT}/{run}/robot/{robot}/to/{peer}"


def beat(run: str, robot: str) -> str:
    """Without a world, from that robot's driver to its peer's: a tick has begun."""
    return f"{ROOT}/{run}/robot/{robot}/beat"


def estimate(run: str, robot: str) -> str:
    """That robot to viewers: what it holds possible."""
    return f"{ROOT}/{run}/robot/{robot}/estimate"


def world_alive(run: str) -> str:
    """Liveliness token of the world; "*" for those of all runs."""
    return f"{ROOT}/{run}/alive/world"


def robot_alive(run: str, robot: str) -> str:
    """Liveliness token of a robot; "*" for those of all robots of the run."""
    return f"{ROOT}/{run}/alive/robot/{robot}"


class Rule(NamedTuple):
    """Who may do what under a key.

    They are "world", "viewer", "robots" (any), or a parameter of the key's function: the robot that it names.
    """

    way: Literal["put", "answer", "show"]
    """what is done: frames are put, questions answered, a liveliness token is shown"""
    by: str
    """who does it"""
    to: tuple[str, ...]
    """who hears it, asks, or looks for it"""


RULES: Mapping[Callable[..., str], Rule] = MappingProxyType(
    {
        truth: Rule("put", "world", ("viewer",)),
        briefing: Rule("answer", "world", ("robot", "viewer")),
        sense: Rule("put", "world", ("robot", "viewer")),
        drive: Rule("put", "robot", ("world", "viewer")),
        report: Rule("put", "robot", ("peer", "viewer")),
        beat: Rule("put", "world", ("world",)),
        estimate: Rule("put", "robot", ("viewer",)),
        world_alive: Rule("show", "world", ("robots", "viewer")),
        robot_alive: Rule("show", "robot", ("robot", "world", "viewer")),
    }
)
"""of every key; what no rule allows a robot or a viewer, no router lets pass"""


class Key(NamedTuple):
    """A key under which something arrived."""

    kind: Callable[..., str] | None
    """the function above that makes such keys"""
    run: str
    robot: str = ""
    """the robot whose drive, estimate or liveliness it is, and whose report; the peer is not it"""
    peer: str = ""


NOWHERE = Key(None, "")
"""the key of what did not come over the network"""

_LONGEST = 256
"""characters of a key that is looked at"""
_NAME = re.compile(NAME)
_PATTERNS = {
    kind: re.compile(kind(**{name: f"(?P<{name}>[^/]+)" for name in signature(kind).parameters}))
    for kind in RULES
}


def parse(key: str) -> Key | None:
    """Return what `key` names, or None if it is not one of the keys above, or is a wildcard.

    Anybody may put, ask or show a token under any key expression, and a wildcard reaches whoever listens to
    one of the keys that it covers.
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
