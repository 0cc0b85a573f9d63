"""The layout of a figure: panels placed in inches, a title, and keys beside the panels.

The layout never depends on measured text sizes, so that equal figures are equal byte for byte.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from compose.figures.style import INK
from protocol.mission import Role

LINE, ROW = 0.17, 0.175
"""The heights of a title line and of a row of a key, in inches."""
CHARACTERS = 14.8
"""The number of title characters per inch."""
SMALL = 8
"""The small font size, in points."""
NO_ENCOUNTER = "the robots had no encounter (phase 3)"
NO_TRUTH = "a recording in hardware mode has no ground truth"
NO_PLACES = "in hardware mode, positions follow from claims, and not both robots made one"


ANCHORS: dict[Role, str] = {"a": "M_1", "b": "M_2"}
"""The anchors' names in the paper, for use between two `$`."""
Window = tuple[float, float, float, float]
"""A window of the plane: left, right, low and high, in m."""


class Absent(NamedTuple):
    """The reason why a figure cannot be drawn."""

    why: str


class Sheet:
    """A figure of `width` by `height` inches below its title.

    The first line of the title is wrapped and printed literally; in the others `$` encloses symbols.
    """

    def __init__(self, width: float, height: float, lines: Sequence[str]) -> None:
        wrapped = [*textwrap.wrap(plain(lines[0]), int(CHARACTERS * width)), *lines[1:]]
        self.width, self.height = width, height
        self.tall = height + 0.1 + LINE * len(wrapped)
        self.figure = Figure(figsize=(width, self.tall))
        for i, line in enumerate(wrapped):
            self.figure.text(
                0.1 / width, 1.0 - (0.13 + LINE * i) / self.tall, line, va="center", ha="left",
                fontsize=9.5 if i <= len(wrapped) - len(lines) else SMALL, color=INK,
            )  # fmt: skip

    def panel(self, left: float, bottom: float, width: float, height: float) -> Axes:
        """Add and return axes; all arguments are in inches, from the lower left corner."""
        return self.figure.add_axes(
            (left / self.width, bottom / self.tall, width / self.width, height / self.tall)
        )

    def key(self, panel: Axes, left: float, top: float, columns: int = 1) -> None:
        """Draw the legend of `panel`; `left` and `top` are in inches from the lower left corner."""
        handles, _ = panel.get_legend_handles_labels()
        self.figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(left / self.width, top / self.tall),
            ncols=columns,
            frameon=False,
            fontsize=SMALL,
            handlelength=2.4,
            labelspacing=0.45,
            columnspacing=1.2,
            borderaxespad=0.0,
        )


def circle(axes: Axes, place: tuple[float, float], radius: float, **look: Any) -> None:
    """Draw a circle of `radius` m about `place`; its entry in the key is a line."""
    label, gid = look.pop("label", None), look.pop("gid", None)
    axes.add_patch(Circle(place, radius, fill=False, gid=gid, **look))
    if label is not None:
        axes.plot([], [], label=label, **look)


def plain(text: str) -> str:
    """Return `text` with each `$` escaped, for literal printing."""
    return text.replace("$", r"\$")


def equal(axes: Axes, window: Window) -> None:
    """Set the window of `axes`, with one scale for x and y."""
    left, right, low, high = window
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    axes.set_aspect("equal", adjustable="box")
    axes.tick_params(labelsize=SMALL)


def fitted(window: Window, width: float, tallest: float) -> tuple[float, float]:
    """Return the width and height of a panel for `window`, within `width` by `tallest` inches."""
    left, right, low, high = window
    scale = min(width / (right - left), tallest / (high - low))
    return scale * (right - left), scale * (high - low)


def around(points: Sequence[tuple[float, float]], margin: float) -> Window:
    """Return the window that contains `points`; `margin` is a fraction of its larger side."""
    xs, ys = zip(*points, strict=True)
    more = margin * max(max(xs) - min(xs), max(ys) - min(ys))
    return min(xs) - more, max(xs) + more, min(ys) - more, max(ys) + more
