"""A picture's paper: panels placed in inches, a title, keys beside the panels.

Nothing is fitted to the size of a text, so the same picture is the same bytes.
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
"""inches: of a line of the title, and of a row of a key"""
CHARACTERS = 14.8
"""of the title, to an inch"""
SMALL = 8
NO_ENCOUNTER = "the two did not meet in phase 3"
NO_TRUTH = "without a world nobody knows where the two truly were"
NO_PLACES = "without a world there are only claims of where the two were, and not both claims are on record"


ANCHORS: dict[Role, str] = {"a": "M_1", "b": "M_2"}
"""the paper's names, to stand between two `$`"""
Window = tuple[float, float, float, float]
"""of the plane, in m: left, right, low, high"""


class Absent(NamedTuple):
    """A picture that does not apply."""

    why: str


class Sheet:
    """A figure of `width` by `height` inches below its title.

    The first line of that is as long as it likes, and stands as it is written; in others `$` enclose symbols.
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
        """In inches from the lower left corner."""
        return self.figure.add_axes(
            (left / self.width, bottom / self.tall, width / self.width, height / self.tall)
        )

    def key(self, panel: Axes, left: float, top: float, columns: int = 1) -> None:
        """What the signs in `panel` mean; `left` and `top` in inches from the lower left corner."""
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
    """Of `radius` about `place`; in a key it is a line."""
    label, gid = look.pop("label", None), look.pop("gid", None)
    axes.add_patch(Circle(place, radius, fill=False, gid=gid, **look))
    if label is not None:
        axes.plot([], [], label=label, **look)


def plain(text: str) -> str:
    """`text` as it stands, where what is between two `$` would be set as symbols."""
    return text.replace("$", r"\$")


def equal(axes: Axes, window: Window) -> None:
    """To one scale."""
    left, right, low, high = window
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    axes.set_aspect("equal", adjustable="box")
    axes.tick_params(labelsize=SMALL)


def fitted(window: Window, width: float, tallest: float) -> tuple[float, float]:
    """Width and height in inches of a panel that shows `window` to one scale."""
    left, right, low, high = window
    scale = min(width / (right - left), tallest / (high - low))
    return scale * (right - left), scale * (high - low)


def around(points: Sequence[tuple[float, float]], margin: float) -> Window:
    """The window that holds `points`; `margin` is a part of its larger side."""
    xs, ys = zip(*points, strict=True)
    more = margin * max(max(xs) - min(xs), max(ys) - min(ys))
    return min(xs) - more, max(xs) + more, min(ys) - more, max(ys) + more
