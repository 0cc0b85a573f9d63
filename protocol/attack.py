"""What a robot is told to say that is not so: for experiments with peers that lie."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Kind = Literal["scale", "rotate", "shift", "radius", "heading", "reframe"]
"""`scale`, `rotate`, `shift`: of what it drove. `radius`, `heading`: of where it says it began, relative to
its anchor; the ranges that it tells go with the radius. `reframe`: of all, about its anchor."""

OF_THE_START: frozenset[Kind] = frozenset(("radius", "heading", "reframe"))

Part = Literal["phase-1", "orbit", "encounter", "all"]
"""of its log, by phase; the last three kinds are of the beginning, and so of all"""


class Attack(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A robot that drives, measures and plans honestly, and tells its peer something else."""

    kind: Kind
    size: Annotated[float, Meta(ge=-1e4, le=1e4)]
    """`scale`: times what it drove, so 1 is the truth; `shift`, `radius`: m more; the others: rad more"""
    part: Part = "all"
