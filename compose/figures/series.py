"""A series of panels in rows, one per moment of a mission, with a key below them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.sheet import ROW, SMALL, Sheet, Window, around, equal, fitted

LEFT, GAP, KEY = 0.68, 0.42, 0.28
"""The left margin, the gap between panels, and the height of a key with one row, in inches."""
HEAD, FOOT, ROOM = 0.36, 0.42, 0.03
"""The space above a panel for its title, below it for its axis, and between rows, in inches."""
COLUMNS, PANELS = 3, 6
"""The maximum number of panels in a row and in total."""
SIGNS = 6
"""The number of entries in the key, in one row below a full row of panels and in two rows otherwise."""
Moment = TypeVar("Moment")


def some(moments: list[Moment]) -> list[Moment]:
    """Return at most PANELS moments: the first, the last, and evenly spaced others."""
    if len(moments) <= PANELS:
        return moments
    return [moments[round(i * (len(moments) - 1) / (PANELS - 1))] for i in range(PANELS)]


def square(points: Sequence[tuple[float, float]], margin: float, least: float) -> Window:
    """Return the square window that contains `points` and is at least `least` m wide.

    `margin` is a fraction of the larger side of the points' bounding box.
    """
    left, right, low, high = around(points, margin)
    half = 0.5 * max(right - left, high - low, least)
    x, y = (left + right) / 2, (low + high) / 2
    return x - half, x + half, y - half, y + half


class Series:
    """A figure with `count` panels that show `window` to one scale."""

    def __init__(self, count: int, window: Window, width: float, narrowest: float, lines: Sequence[str]):
        """Create the figure.

        `width` is the maximum width of a panel and `narrowest` the minimum width of the figure, in inches;
        `lines` are its title (see `Sheet`).
        """
        self._window = window
        self._width, self._height = fitted(window, width, math.inf)
        self._columns, self._rows = min(COLUMNS, count), math.ceil(count / COLUMNS)
        self._signs = SIGNS if self._columns == COLUMNS else SIGNS // 2
        self._key = KEY + ROW * (SIGNS / self._signs - 1)
        self._row = self._height + HEAD + FOOT + ROOM
        wide = LEFT + self._columns * (self._width + GAP)
        self._sheet = Sheet(max(wide, narrowest), self._rows * self._row + self._key, lines)

    @property
    def figure(self) -> Figure:
        """The whole figure."""
        return self._sheet.figure

    def panel(self, place: int, title: str) -> Axes:
        """Add and return the panel at index `place`, row by row, starting at 0."""
        row, column = divmod(place, self._columns)
        left = LEFT + column * (self._width + GAP)
        bottom = self._key + FOOT + (self._rows - 1 - row) * self._row
        axes = self._sheet.panel(left, bottom, self._width, self._height)
        equal(axes, self._window)
        axes.set_title(title, fontsize=SMALL, loc="left", pad=3, linespacing=1.15)
        axes.set_xlabel("$x$ [m]", fontsize=SMALL)
        if column == 0:
            axes.set_ylabel("$y$ [m]", fontsize=SMALL)
        return axes

    def key(self, panel: Axes) -> None:
        """Draw the legend of `panel` below all panels."""
        self._sheet.key(panel, LEFT, self._key - 0.05, columns=self._signs)
