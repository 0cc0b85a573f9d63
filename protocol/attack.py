"""False data injection: an attacker that reports false data about itself to its peer, for experiments."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Kind = Literal["scale", "rotate", "shift", "radius", "heading", "reframe"]
"""The kind of false data.

- `scale`: the reported forward velocities are multiplied by the size.
- `rotate`: the reported path is rotated by the size, and back at the end of the part.
- `shift`: the first reported manoeuvre is longer by the size.
- `radius`, `heading`: the reported start is changed, relative to the attacker's anchor. With `radius`, the
  reported ranges are changed by the same amount.
- `reframe`: the reported start is rotated about the attacker's anchor, and with it the whole path.
"""
OF_THE_START: frozenset[Kind] = frozenset(("radius", "heading", "reframe"))
"""The kinds that change the reported start. They need `part = "all"`."""

Part = Literal["phase-1", "orbit", "encounter", "all"]
"""The part of the attacker's motion log that is changed, by phase. OF_THE_START needs `all`."""


class Attack(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An attack of a robot that moves, measures and plans as usual, but sends false Reports."""

    kind: Kind
    """The kind of false data."""
    size: Annotated[float, Meta(ge=-1e4, le=1e4)]
    """The size of the change: a factor for `scale` (1 changes nothing), an offset in m for `shift` and
    `radius`, an angle in rad for the other kinds."""
    part: Part = "all"
    """The part of the motion log that is changed."""
