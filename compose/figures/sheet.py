"""The layout of a figure: a title, panels and keys placed in inches from the top, and a height that follows.

Sizes of texts are measured in the fonts that Matplotlib ships and rounded up, so that equal figures are equal
byte for byte.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox

from compose.figures.style import DECIMALS, INK, PAGE, SCREEN, TEXT, Medium
from protocol.mission import Role

EDGE, GAP = 0.06, 0.12
"""The margin at the edges of a figure, and the gap between a panel and its key, in inches."""
LEFT, FOOT, HEAD, WORDS = 0.48, 0.36, 0.06, 0.155
"""The space left of a panel for its axis, below it, above it, and per line of a text, in inches."""
HANDLE, SPACE, BETWEEN = 2.2, 0.5, 1.0
"""The lengths of a key's handles and of the gaps after handles and between columns, in font sizes."""
KEY_BESIDE = 0.6
"""The least fraction of the width that a plane has if its key is beside it."""
ROW = 0.165
"""The height of a row of a key, in inches."""
PANELS, ACROSS = 6, 3
"""The maximum number of panels of a series, in total and in a row."""
HINTED = 1.03
"""The largest ratio of the widths of a text at two resolutions, which differ by its hinting."""
TEXT_DPI = SCREEN.dpi
"""The resolution at which texts are measured, in dots per inch."""
NO_ENCOUNTER = "the robots had no encounter (phase 3)"
NO_TRUTH = "a recording in hardware mode has no ground truth"
NO_PLACES = "in hardware mode, positions follow from claims, and not both robots made one"
ANCHORS: dict[Role, str] = {"a": "M_1", "b": "M_2"}
"""The anchors' names in the paper, for use between two `$`."""
AXIS_STEPS = (1, 2, 5, 10)
"""The steps between two ticks of an axis, times a power of 10 m. Numbers such as -7.5 do not fit in LEFT."""
LABEL = {"facecolor": "white", "alpha": 0.75, "pad": 0.6, "lw": 0}
"""The background of a text within a panel."""
Window = tuple[float, float, float, float]
"""A window of the plane: left, right, low and high, in m."""
Moment = TypeVar("Moment")
_TITLE_WORD = re.compile(r"(?:\\\$|\$[^$]*\$|[^\s$])+")
"""A word of a title; spaces between two `$` do not end it."""


class Absent(NamedTuple):
    """The reason why a figure cannot be drawn."""

    why: str


class Sheet:
    """A figure that is filled from the top, `top` inches of it so far.

    The first line of the title is printed literally; in the others `$` encloses symbols.
    """

    def __init__(self, medium: Medium, narrow: bool, title: Sequence[str]) -> None:
        self.width = medium.narrow if narrow else PAGE
        self.figure = Figure(figsize=(self.width, 1.0))
        self.top = EDGE
        self._panels: list[tuple[Axes, tuple[float, float, float, float]]] = []
        self._keys: list[tuple[Legend, float, float]] = []
        self._lines: list[tuple[str, float]] = []
        if medium.titled:
            for line in [plain(title[0]), *title[1:]]:
                for part in wrapped(_TITLE_WORD.findall(line), self.width - 2 * EDGE, " "):
                    self._lines.append((part, self.top))
                    self.top += WORDS
            self.top += EDGE

    @property
    def room(self) -> float:
        """The width of a panel that takes the whole width, in inches."""
        return self.width - LEFT - 3 * EDGE

    def panel(self) -> Axes:
        """Add and return axes, which are yet to be placed."""
        return self.figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def place(self, axes: Axes, left: float, top: float, width: float, height: float) -> None:
        """Place axes; all arguments are in inches, from the upper left corner."""
        self._panels.append((axes, (left, top, width, height)))

    def key(self, panel: Axes, left: float, top: float, width: float, **look: Any) -> float:
        """Draw the legend of `panel` with as many columns as fit in `width` inches; return its height."""
        handles, labels = panel.get_legend_handles_labels()
        if not handles:
            return 0.0
        rows = next((n for n in range(1, len(labels)) if _width(labels, n) <= width), len(labels))
        columns = math.ceil(len(labels) / rows)
        key = self.figure.legend(
            handles,
            labels,
            loc="upper left",
            ncols=columns,
            frameon=False,
            handlelength=HANDLE,
            handletextpad=SPACE,
            columnspacing=BETWEEN,
            labelspacing=0.4,
            borderaxespad=0.0,
            borderpad=0.0,
            alignment="left",
            **look,
        )
        self._keys.append((key, left, top))
        return (rows + ("title" in look)) * ROW

    def plane(self, axes: Axes, window: Window, tallest: float) -> None:
        """Place a plane that shows `window`, with its key beside it if there is room, and below it else."""
        _, labels = axes.get_legend_handles_labels()
        beside = _width(labels, len(labels)) + GAP
        if (left := self.room - beside) < KEY_BESIDE * self.room:
            left = self.room
        width, height = fitted(window, left, tallest)
        top = self.top + HEAD
        self.place(axes, LEFT, top, width, height)
        named(axes, window)
        self.top = top + height + FOOT
        if left == self.room:
            self.key_below(axes)
        else:
            self.top = max(self.top, top + self.key(axes, LEFT + width + GAP, top, 0.0))

    def key_below(self, axes: Axes) -> None:
        """Draw the legend of `axes` below what is placed already, from edge to edge if narrow."""
        left = LEFT if self.width == PAGE else EDGE
        self.top += GAP / 2
        self.top += self.key(axes, left, self.top, self.width - left - EDGE)

    def series(self, panels: Sequence[Axes], captions: Sequence[Sequence[str]], window: Window) -> None:
        """Place panels that show `window` to one scale, each below its caption, in rows of up to ACROSS.

        A caption is a sequence of parts, which are wrapped.
        """
        columns = min(ACROSS, len(panels))
        width = (self.room - (columns - 1) * LEFT) / columns
        width, height = fitted(window, min(width, 0.42 * PAGE), math.inf)
        texts = [wrapped([f"{part}," for part in parts[:-1]] + [parts[-1]], width + 0.7 * LEFT, " ")
                 for parts in captions]  # fmt: skip
        for first in range(0, len(panels), columns):
            row = range(first, min(first + columns, len(panels)))
            self.top += HEAD + WORDS * max(len(texts[i]) for i in row)
            for column, i in enumerate(row):
                self.place(panels[i], LEFT + column * (width + LEFT), self.top, width, height)
                panels[i].set_title("\n".join(texts[i]), loc="left", pad=3, linespacing=1.15, x=-0.1)
                named(panels[i], window, low=column == 0)
            self.top += height + FOOT
        self.key_below(panels[-1])

    def finished(self) -> Figure:
        """Return the figure, with everything in its place."""
        wide, tall = self.width, math.ceil(100.0 * (self.top + EDGE)) / 100.0
        self.figure.set_size_inches(wide, tall)
        for axes, (left, top, width, height) in self._panels:
            corners = (left / wide, 1.0 - (top + height) / tall), ((left + width) / wide, 1.0 - top / tall)
            axes.set_position(Bbox(np.round(corners, DECIMALS)))
        for key, left, top in self._keys:
            key.set_bbox_to_anchor((left / wide, 1.0 - top / tall), transform=self.figure.transFigure)
        for text, top in self._lines:
            self.figure.text(EDGE / wide, 1.0 - (top + WORDS / 2) / tall, text, va="center", color=INK)
        return self.figure


def measured(text: str) -> float:
    """Return the width of a line of text in the font of `look`, in inches, rounded up to 0.01."""
    return _measured(text, rcParams["font.family"][0])


@cache
def _measured(text: str, family: str) -> float:
    font, symbols = FontProperties(family=family, size=TEXT), text.replace(r"\$", "").count("$") > 0
    size = _renderer().get_text_width_height_descent(text, font, symbols)  # type: ignore[no-untyped-call]
    return math.ceil(100.0 * float(size[0]) / TEXT_DPI) / 100.0


@cache
def _renderer() -> RendererAgg:
    return RendererAgg(1, 1, TEXT_DPI)  # type: ignore[no-untyped-call]


def wrapped(words: Iterable[str], width: float, between: str) -> list[str]:
    """Return lines of `words` that are at most `width` inches wide, unless a single word is wider."""
    lines: list[str] = []
    for word in words:
        if lines and measured(longer := f"{lines[-1]}{between}{word}") <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _width(labels: Sequence[str], rows: int) -> float:
    """Return the width of a key with at most `rows` rows, in inches.

    Matplotlib fills its columns one after the other, the first ones with a row more than the last ones.
    """
    columns = math.ceil(len(labels) / rows)
    rows, longer = divmod(len(labels), columns)
    wide, start = 0.0, 0
    for column in range(columns):
        end = start + rows + (column < longer)
        wide += max(map(measured, labels[start:end]), default=0.0)
        start = end
    return HINTED * wide + (columns * (HANDLE + SPACE) + (columns - 1) * BETWEEN) * TEXT / 72.0


def circle(axes: Axes, place: tuple[float, float], radius: float, **look: Any) -> None:
    """Draw a circle of `radius` m about `place`; its entry in the key is a line."""
    label, gid = look.pop("label", None), look.pop("gid", None)
    axes.add_patch(Circle(place, radius, fill=False, gid=gid, **look))
    if label is not None:
        axes.plot([], [], label=label, **look)


def plain(text: str) -> str:
    """Return `text` with each `$` escaped, for literal printing."""
    return text.replace("$", r"\$")


def named(axes: Axes, window: Window, *, low: bool = True) -> None:
    """Set the window of `axes` with one scale for x and y, and name the axes; y only if `low`."""
    axes.set_xlim(*window[:2])
    axes.set_ylim(*window[2:])
    axes.set_aspect("equal", adjustable="box")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator("auto", steps=AXIS_STEPS))
    axes.set_xlabel("x [m]")
    if low:
        axes.set_ylabel("y [m]")


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


def square(points: Sequence[tuple[float, float]], margin: float, least: float) -> Window:
    """Return the square window that contains `points` and is at least `least` m wide.

    `margin` is a fraction of the larger side of the points' bounding box.
    """
    left, right, low, high = around(points, margin)
    half = 0.5 * max(right - left, high - low, least)
    x, y = (left + right) / 2, (low + high) / 2
    return x - half, x + half, y - half, y + half


def some(moments: list[Moment]) -> list[Moment]:
    """Return at most PANELS moments: the first, the last, and evenly spaced others."""
    if len(moments) <= PANELS:
        return moments
    return [moments[round(i * (len(moments) - 1) / (PANELS - 1))] for i in range(PANELS)]
