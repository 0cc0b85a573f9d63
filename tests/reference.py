"""The values of an independent implementation: Section IV at every tick, eq. (7), phase 1."""

from __future__ import annotations

from pathlib import Path

import msgspec

Triple = tuple[float, float, float]
Pair = tuple[float, float]


class Simulation(msgspec.Struct, frozen=True):
    """One of Section IV's, at every tick."""

    sa: Triple
    sb: Triple
    poses_a: list[Triple]
    poses_b: list[Triple]
    u_a: list[Pair]
    u_b: list[Pair]
    range_a: list[float | None]
    range_b: list[float | None]
    mutual: list[float | None]
    k_meet: int
    k_second: int
    k_last: int
    candidates: list[tuple[float, Pair]]
    """every solution of eq. (7)"""
    J: float
    w2: float
    d_i: list[float]
    """of the candidates that silence has left"""
    chosen: tuple[float, Pair]


class Solution(msgspec.Struct, frozen=True):
    """A placement of <a(M1)> in <b(M2)>."""

    phi: float
    T: Pair


class Equation7(msgspec.Struct, frozen=True):
    """A case of eq. (7), with all its solutions."""

    D: float
    p1b: Pair
    p1a: Pair
    p2a: Pair
    rho1: float
    rho2: float
    truth: Solution
    solutions: list[Solution]


class Phase1(msgspec.Struct, frozen=True):
    """A robot alone with its anchor, which is at the origin."""

    start: Triple
    rho0: float
    branch: str
    alpha_signed: float
    mu: float
    k_end: int
    r_end: float
    ranges: list[float | None]
    u: list[Pair]


class Reference(msgspec.Struct, frozen=True):
    """The whole file."""

    sims: list[Simulation]
    eq7: list[Equation7]
    phase1: list[Phase1]


REFERENCE = msgspec.json.decode(
    (Path(__file__).parent / "data" / "reference_values.json").read_bytes(), type=Reference
)
