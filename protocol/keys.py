"""The key-expression tree, one function a key. `run` and robot ids are single chunks."""

from __future__ import annotations

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


def estimate(run: str, robot: str) -> str:
    """That robot to viewers: what it holds possible."""
    return f"{ROOT}/{run}/robot/{robot}/estimate"


def world_alive(run: str) -> str:
    """Liveliness token of the world; "*" for those of all runs."""
    return f"{ROOT}/{run}/alive/world"


def robot_alive(run: str, robot: str) -> str:
    """Liveliness token of a robot; "*" for those of all robots of the run."""
    return f"{ROOT}/{run}/alive/robot/{robot}"


def run_of(key: str) -> str:
    """The run that `key` belongs to."""
    return key.split("/")[1]


def robot_of(key: str) -> str:
    """The robot whose drive, estimate or liveliness `key` is, and whose report; the peer is not it."""
    chunks = key.split("/")
    return chunks[4] if chunks[2] == "alive" else chunks[3]
