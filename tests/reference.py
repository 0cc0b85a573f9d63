"""Reference values of an independent implementation: the simulations of Section IV, eq. (7), and phase 1."""

from __future__ import annotations

from pathlib import Path

import msgspec

Triple = tuple[float, float, float]
Pair = tuple[float, float]


class Simulation(msgspec.Struct, frozen=True):
    """A simulation of Section IV, with its values at every tick."""

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
    """all solutions of eq. (7)"""
    J: float
    w2: float
    d_i: list[float]
    """distances d_i of eq. (8) for the solutions that are consistent with no detection, in m"""
    chosen: tuple[float, Pair]


class Solution(msgspec.Struct, frozen=True):
    """A placement of the frame <a(M1)> in <b(M2)>."""

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
    """Phase 1 of a robot whose anchor is at the origin."""

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
    """The contents of `data/reference_values.json`."""

    sims: list[Simulation]
    eq7: list[Equation7]
    phase1: list[Phase1]


REFERENCE = msgspec.json.decode(
    (Path(__file__).parent / "data" / "reference_values.json").read_bytes(), type=Reference
)
