"""A drawing of dots and lines in Braille characters, of which each has 2 x 4 dots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise

from rich.text import Text

from compose.view.outlines import Box

Point = tuple[float, float]
DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""The bit of each dot in a character, by row and column, as Unicode has them."""
BLANK = 0x2800
"""The character without dots."""


class Drawing:
    """A drawing of `columns` x `rows` characters, on which the y axis points up and both scales are equal."""

    def __init__(self, columns: int, rows: int, shown: Box) -> None:
        """The drawing contains at least the box `shown`."""
        self._columns, self._rows = columns, rows
        self._scale = min((2 * columns - 1) / shown.width, (4 * rows - 1) / shown.height)
        self._left = shown.x - (columns - 0.5) / self._scale
        self._top = shown.y + (2 * rows - 0.5) / self._scale
        self._bits: dict[tuple[int, int], int] = {}
        self._styles: dict[tuple[int, int], str] = {}
        self._letters: dict[tuple[int, int], str] = {}

    def _at(self, point: Point) -> tuple[int, int] | None:
        """Return the column and row of the dot at a point; None outside the drawing."""
        x, y = (point[0] - self._left) * self._scale, (self._top - point[1]) * self._scale
        inside = 0.0 <= x < 2 * self._columns and 0.0 <= y < 4 * self._rows
        return (int(x), int(y)) if inside else None

    def dots(self, points: Iterable[Point], style: str) -> None:
        """Draw single dots."""
        for point in points:
            if (at := self._at(point)) is not None:
                cell = at[0] // 2, at[1] // 4
                self._bits[cell] = self._bits.get(cell, 0) | DOTS[at[1] % 4][at[0] % 2]
                self._styles[cell] = style

    def line(self, points: Sequence[Point], style: str, gap: int = 1) -> None:
        """Draw a line through points, of which only every `gap`-th dot is drawn."""
        for (x, y), (to_x, to_y) in pairwise(points):
            length = math.hypot(to_x - x, to_y - y) * self._scale
            steps = max(1, math.ceil(min(length, 4.0 * (self._columns + 2 * self._rows)) / gap))
            self.dots([(x + (to_x - x) * i / steps, y + (to_y - y) * i / steps) for i in range(steps)], style)

    def letter(self, point: Point, letter: str, style: str) -> None:
        """Write a character over the dots at a point."""
        if (at := self._at(point)) is not None:
            cell = at[0] // 2, at[1] // 4
            self._letters[cell], self._styles[cell] = letter, style

    def text(self) -> Text:
        """Return the drawing as lines of text."""
        made = Text()
        for row in range(self._rows):
            for column in range(self._columns):
                cell = column, row
                dots = chr(BLANK + self._bits[cell]) if cell in self._bits else " "
                made.append(self._letters.get(cell, dots), self._styles.get(cell))
            made.append("\n" if row < self._rows - 1 else "")
        return made
