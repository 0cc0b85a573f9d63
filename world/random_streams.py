"""Random numbers, each a function of its key (seed, sensor, robot, tick).

Without a shared sequence, an additional outlier changes no other random number, and each tick can be
recomputed on its own.
"""

from __future__ import annotations

import hashlib
import math

_WORD = 1 << 52
"""The number of values of a uniform number. All of them are exact floats, and none is 0 or 1."""


def uniform(seed: int, sensor: str, robot: str, tick: int) -> float:
    """Return a uniformly distributed number in the open interval (0, 1)."""
    return _uniforms(seed, sensor, robot, tick)[0]


def gaussian(seed: int, sensor: str, robot: str, tick: int) -> float:
    """Return a Gaussian number with mean 0 and variance 1, by the Box-Muller transform."""
    one, other = _uniforms(seed, sensor, robot, tick)
    return math.sqrt(-2.0 * math.log(one)) * math.cos(math.tau * other)


def _uniforms(seed: int, sensor: str, robot: str, tick: int) -> tuple[float, float]:
    digest = hashlib.blake2b(f"{seed}/{sensor}/{robot}/{tick}".encode(), digest_size=16).digest()
    one, other = int.from_bytes(digest[:8], "big"), int.from_bytes(digest[8:], "big")
    return (one % _WORD + 0.5) / _WORD, (other % _WORD + 0.5) / _WORD
