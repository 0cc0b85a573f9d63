"""Chance, keyed: what is drawn follows from (seed, sensor, robot, tick) and from nothing else.

So one more outlier shifts no other draw, and any tick can be drawn again alone.
"""

from __future__ import annotations

import hashlib
import math

_WORD = 1 << 52
"""values that a uniform number may have: its floats are exact, and none is 0 or 1"""


def uniform(seed: int, sensor: str, robot: str, tick: int) -> float:
    """In (0, 1), neither end included."""
    return _uniforms(seed, sensor, robot, tick)[0]


def gaussian(seed: int, sensor: str, robot: str, tick: int) -> float:
    """Of mean 0 and variance 1 (Box and Muller)."""
    one, other = _uniforms(seed, sensor, robot, tick)
    return math.sqrt(-2.0 * math.log(one)) * math.cos(math.tau * other)


def _uniforms(seed: int, sensor: str, robot: str, tick: int) -> tuple[float, float]:
    digest = hashlib.blake2b(f"{seed}/{sensor}/{robot}/{tick}".encode(), digest_size=16).digest()
    one, other = int.from_bytes(digest[:8], "big"), int.from_bytes(digest[8:], "big")
    return (one % _WORD + 0.5) / _WORD, (other % _WORD + 0.5) / _WORD
