"""A few moments of a mission, a panel each, in rows; below them a key."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from compose.figures.sheet import ROW, SMALL, Sheet, Window, around, equal, fitted

LEFT, GAP, KEY = 0.68, 0.42, 0.28
"""inches: left of panels, between panels, and of the key below them on one line"""
HEAD, FOOT, ROOM = 0.36, 0.42, 0.03
"""inches: above a panel, for what is said of it; below it, for its axis; and between rows"""
COLUMNS, PANELS = 3, 6
"""panels in a row, and in all at the most"""
SIGNS = 6
"""in the key: side by side below a whole row of panels, else on two lines"""
Moment = TypeVar("Moment")


def some(moments: list[Moment]) -> list[Moment]:
    """As many as have room: the first and the last, and others as evenly as can be."""
    if len(moments) <= PANELS:
        return moments
    return [moments[round(i * (len(moments) - 1) / (PANELS - 1))] for i in range(PANELS)]


def square(points: Sequence[tuple[float, float]], margin: float, least: float) -> Window:
    """The square window that holds `points`, `least` m wide; `margin` is a part of their larger side."""
    left, right, low, high = around(points, margin)
    half = 0.5 * max(right - left, high - low, least)
    x, y = (left + right) / 2, (low + high) / 2
    return x - half, x + half, y - half, y + half


class Series:
    """Room for `count` panels that show `window` to one scale, `width` inches wide at the most."""

    def __init__(self, count: int, window: Window, width: float, narrowest: float, lines: Sequence[str]):
        """`narrowest` is the least width of the whole, in inches; `lines` are its title (see `Sheet`)."""
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
        """All of it."""
        return self._sheet.figure

    def panel(self, place: int, title: str) -> Axes:
        """The panel at `place`, from 0 on."""
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
        """What the signs in `panel` mean."""
        self._sheet.key(panel, LEFT, self._key - 0.05, columns=self._signs)
