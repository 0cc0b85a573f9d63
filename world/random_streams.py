"""Random numbers, each a function of its key (seed, sensor, robot, tick).

Without a shared sequence, an additional outlier changes no other random number, and each tick can be
recomputed on its own.
"""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache

_UNIFORM_VALUES = 1 << 52
"""The number of values of a uniform number. All of them are exact floats, and none is 0 or 1."""


def uniform(seed: int, sensor: str, robot: str, tick: int) -> float:
    """Return a uniformly distributed number in the open interval (0, 1)."""
    return _uniforms(seed, sensor, robot, tick)[0]


def gaussian(seed: int, sensor: str, robot: str, tick: int) -> float:
    """Return a Gaussian number with mean 0 and variance 1, by the Box-Muller transform."""
    one, other = _uniforms(seed, sensor, robot, tick)
    return math.sqrt(-2.0 * math.log(one)) * math.cos(math.tau * other)


def correlated(seed: int, sensor: str, robot: str, tick: int, correlation: float) -> float:
    """Return the value at `tick` of a stationary AR(1) process with mean 0 and variance 1.

    The process is the sum of the Gaussian numbers of this and of earlier ticks, with weights that fall by
    `correlation` a tick. Ticks whose weights are below NEGLIGIBLE_CORRELATION are left out.
    """
    length = math.ceil(math.log(NEGLIGIBLE_CORRELATION) / math.log(correlation))
    total = 0.0
    for age in range(length - 1, -1, -1):
        total = correlation * total + _remembered(seed, sensor, robot, tick - age)
    return total * math.sqrt((1.0 - correlation**2) / (1.0 - correlation ** (2 * length)))


def random_walk(seed: int, sensor: str, robot: str, tick: int) -> float:
    """Return the sum of `tick` independent Gaussian numbers with mean 0 and variance 1: a random walk.

    It is computed by halving intervals (Levy's construction of Brownian motion) with a number of draws that
    is logarithmic in `tick`.
    """
    begin, end, at_begin, at_end = 0, 1, 0.0, gaussian(seed, sensor, robot, 1)
    while end < tick:
        begin, at_begin = end, at_end
        at_end += math.sqrt(end) * gaussian(seed, sensor, robot, 2 * end)
        end *= 2
    while begin < tick < end:
        middle, deviation = (begin + end) // 2, 0.5 * math.sqrt(end - begin)
        between = 0.5 * (at_begin + at_end) + deviation * gaussian(seed, f"{sensor}-middle", robot, middle)
        if tick < middle:
            end, at_end = middle, between
        else:
            begin, at_begin = middle, between
    return at_begin if tick == begin else at_end


NEGLIGIBLE_CORRELATION = 1e-5
"""The weight in `correlated` below which a tick is left out."""


@lru_cache(maxsize=1 << 14)
def _remembered(seed: int, sensor: str, robot: str, tick: int) -> float:
    return gaussian(seed, sensor, robot, tick)


def _uniforms(seed: int, sensor: str, robot: str, tick: int) -> tuple[float, float]:
    digest = hashlib.blake2b(f"{seed}/{sensor}/{robot}/{tick}".encode(), digest_size=16).digest()
    one, other = int.from_bytes(digest[:8], "big"), int.from_bytes(digest[8:], "big")
    return (one % _UNIFORM_VALUES + 0.5) / _UNIFORM_VALUES, (other % _UNIFORM_VALUES + 0.5) / _UNIFORM_VALUES
