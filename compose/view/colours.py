"""The colours and line styles of drawings: the hue is the robot, the line style the phase.

The page has its own copy in `compose/view/web/page/style.css`; a test compares the two.
"""

from __future__ import annotations

from typing import Any

from protocol.mission import Role

COLOURS: dict[Role | None, str] = {"a": "#0b62a4", "b": "#c4451c", None: "#7f7f7f"}
"""The colours of a pair's robots by role, blue and red as in the paper; grey without one."""
DASHES: dict[int, tuple[float, ...]] = {1: (1.0, 1.6), 2: (4.0, 1.6), 3: ()}
"""The dashes of a path by phase, in multiples of the line width: dotted, dashed, solid."""


def line_style(phase: int) -> Any:
    """Return the line style of a path in `phase`, as Matplotlib takes it."""
    return (0, DASHES[phase]) if DASHES[phase] else "-"


def rgb(role: Role | None) -> tuple[float, float, float]:
    """Return the colour of a robot as red, green and blue, each from 0 to 1."""
    red, green, blue = bytes.fromhex(COLOURS[role][1:])
    return red / 255.0, green / 255.0, blue / 255.0
