"""The layout of a figure: a title, panels in a mosaic, and keys, by Matplotlib's constrained layout."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from textwrap import wrap
from typing import Any, NamedTuple, TypeVar

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import rgb_to_hsv, to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.text import Annotation
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox, blended_transform_factory
from matplotlib.typing import ColorType

from compose.figures.style import INK, PAGE, TEXT, Medium
from protocol.mission import Role
from protocol.motion import Pose, compose

PAD = 0.04
"""The distance in inches between panels, and of all from the edges of a figure."""
TITLE = 110
"""The maximum number of characters of a line of a title, which fit in the width PAGE."""
UNPRINTED = re.compile(r"\\[a-z,]+|[$_{}]")
"""The characters of a symbol in a title that are not printed, or as one other character."""
PANELS, ACROSS = 6, 3
"""The maximum number of panels of a series, in total and in a row."""
LONE = 3.0
"""The maximum height of the panel of a series with one panel, in inches."""
KEY_WIDTH = 0.85
"""The fraction of a cell's width, with its axis labels, that a key in it may take."""
PLANE_INTERVALS = 6
"""The maximum number of intervals between the labelled ticks of an axis of the plane."""
NO_ENCOUNTER = "the robots had no encounter (phase 3)"
NO_TRUTH = "a recording in hardware mode has no ground truth"
NO_PLACES = "in hardware mode, positions follow from claims, and not both robots made one"
ANCHORS: dict[Role, str] = {"a": "M_1", "b": "M_2"}
"""The anchors' names in the paper, for use between two `$`."""
LABEL = {"facecolor": "white", "alpha": 0.75, "pad": 0.6, "lw": 0}
"""The background of a text within a panel."""
GAPS, DIRECTIONS = (4.0, 9.0, 14.0), 16
"""The distances in points from a point to its label, and the number of directions, that are compared."""
LINES = {"-": "solid", "--": "dashed", "-.": "dash-dotted", ":": "dotted"}
MARKERS = {
    "o": "circles",
    "^": "triangles",
    "s": "squares",
    "*": "stars",
    "x": "crosses",
    "+": "crosses",
    ".": "dots",
}
"""The words for the lines and the markers of figures."""
HUE_NAMES = {
    "red": 0.0,
    "orange": 0.09,
    "yellow": 0.15,
    "green": 0.36,
    "blue": 0.58,
    "purple": 0.76,
    "magenta": 0.88,
}
"""The hues of colours with a name, as parts of a turn."""
LEAST_SATURATION, DARK = 0.15, 0.2
"""The saturation from which on a colour has a hue, and the value up to which one without is black."""
DOT = 1.0
"""The longest dash that is a dot, in line widths."""
Window = tuple[float, float, float, float]
"""A window of the plane: left, right, low and high, in m."""
Moment = TypeVar("Moment")


class Absent(NamedTuple):
    """The reason why a figure cannot be drawn."""

    why: str


class Sheet:
    """A figure whose panels are the cells of a mosaic, and whose height follows from theirs.

    Each row of the mosaic has a cell that spans no other row. The first line of the title is printed
    literally; in the others `$` encloses symbols.
    """

    def __init__(
        self,
        medium: Medium,
        narrow: bool,
        title: Sequence[str],
        mosaic: Sequence[Sequence[str]] = (("plane",), ("key",)),
        widths: Sequence[float] | None = None,
    ) -> None:
        self.width = medium.narrow if narrow else PAGE
        self._keyed, self._caption = medium.keyed, list(title)
        self._engine = ConstrainedLayoutEngine(w_pad=PAD, h_pad=PAD, wspace=0.0, hspace=0.0)
        height = max(6.0, 0.5 * len(mosaic))  # labels alone must fit: without room, there is no layout
        self.figure = Figure(figsize=(self.width, height), layout=self._engine)
        if medium.titled:
            lines = [
                part
                for line in (plain(title[0]), *title[1:])
                for part in wrap(line, TITLE + len("".join(UNPRINTED.findall(line))))
            ]
            self.figure.suptitle("\n".join(lines), x=PAD / self.width, ha="left", size=TEXT, color=INK)
        self.panels: dict[str, Axes] = self.figure.subplot_mosaic(
            [list(row) for row in mosaic], width_ratios=widths, empty_sentinel=""
        )
        self._mosaic = mosaic
        self._widths = list(widths or [1.0] * len(mosaic[0]))
        self._heights: dict[str, Callable[[], float]] = {}
        self._planes: list[Axes] = []
        self._labels: list[tuple[Annotation, float]] = []

    def tall(self, name: str, height: float) -> Axes:
        """Return the panel `name`, which is `height` inches high."""
        self._heights[name] = lambda: height
        return self.panels[name]

    def plane(self, name: str, window: Window, tallest: float = math.inf, *, low: bool = True) -> None:
        """Let the panel `name` show `window`, at most `tallest` inches high; name its y axis if `low`."""
        axes = self.panels[name]
        left, right, bottom, top = window
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(PLANE_INTERVALS, steps=(1, 2, 5, 10)))
        axes.set_xlabel("x [m]")
        if low:
            axes.set_ylabel("y [m]")
        ratio = (top - bottom) / (right - left)
        self._planes.append(axes)
        self._heights[name] = lambda: min(tallest, ratio * self.width * _place(axes).width)

    def label(self, text: str, at: tuple[float, float], radius: float = 0.0, **look: Any) -> None:
        """Write `text` beside a point of the panel "plane", outside of `radius` m."""
        look = {"ha": "center", "va": "center", "zorder": 7, "bbox": LABEL, **look}
        drawn = self.panels["plane"].annotate(text, at, xytext=(0, 0), textcoords="offset points", **look)
        self._labels.append((drawn, radius))

    def _place_labels(self) -> None:
        """Move each label, in order, to where the fewest lines and labels are in its way."""
        axes, points = self.panels["plane"], self.figure.dpi / 72.0
        axes.apply_aspect()
        artists: list[Line2D | Patch] = [*axes.lines, *axes.patches]
        drawn = [one.get_transform().transform_path(one.get_path()) for one in artists]
        extents = [path.get_extents() for path in drawn]
        frame, placed = axes.bbox.padded(-points), list[Bbox]()
        for text, radius in self._labels:
            extent, least = text.get_window_extent(), math.inf
            away = math.dist(*axes.transData.transform([text.xy, (text.xy[0] + radius, text.xy[1])]))
            area = extent.padded(away + GAPS[-1] * points + extent.width)
            paths = [path for path, box in zip(drawn, extents, strict=True) if area.overlaps(box)]
            for gap, turn in product(GAPS, range(DIRECTIONS)):
                angle = 0.5 * math.pi + 2.0 * math.pi * turn / DIRECTIONS
                right = (away + gap * points + 0.5 * extent.width) * math.cos(angle)
                up = (away + gap * points + 0.5 * extent.height) * math.sin(angle)
                box = extent.translated(right, up)
                blocked = box.count_overlaps(placed) + (frame.count_contains(box.corners()) < 4)
                crossed = sum([path.intersects_bbox(box.padded(points), filled=False) for path in paths])
                crossed += len(drawn) * blocked
                if crossed < least:
                    least, best = crossed, box
                    text.set_position((right / points, up / points))
                if not crossed:
                    break
            placed.append(best)

    def key(self, panel: Axes, name: str = "key", **look: Any) -> None:
        """Draw the legend of `panel` in the cell `name`, with as many columns as fit.

        It begins below or beside the panel, but at the edge of a figure of one column.
        """
        cell, edge = self.panels[name], self.width < PAGE
        cell.set_axis_off()
        handles, labels = panel.get_legend_handles_labels()
        if not self._keyed:
            self._caption += [
                f"{said(handle)}: {label}" for handle, label in zip(handles, labels, strict=True)
            ]
            self._heights[name] = lambda: 0.0
            return
        row = next(row for row in self._mosaic if name in row)
        share = [width for width, one in zip(self._widths, row, strict=True) if one == name]
        room = self.width - 2 * PAD if edge else KEY_WIDTH * self.width * sum(share) / sum(self._widths)
        places = self.figure.transFigure if edge else cell.transAxes
        columns = 1
        for _ in range(2):  # first in one column, whose width says how many fit
            key = cell.legend(
                handles, labels, ncols=columns, loc="upper left", frameon=False, borderaxespad=0.0,
                borderpad=0.0, handlelength=2.2, handletextpad=0.5, columnspacing=1.0, labelspacing=0.4,
                alignment="left", bbox_to_anchor=(PAD / self.width if edge else 0.0, 1.0),
                bbox_transform=blended_transform_factory(places, cell.transAxes), **look,
            )  # fmt: skip
            key.set_in_layout(not edge)
            extent = key.get_window_extent()
            columns = max(1, min(len(labels), int(room * self.figure.dpi / max(extent.width, 1.0))))
        height = extent.height / self.figure.dpi if labels else 0.0
        self._heights[name] = lambda: height

    def finished(self) -> Figure:
        """Return the figure, as high as its rows of panels need."""
        self._engine.execute(self.figure)  # the width of a plane, and with it its height, needs its labels
        tall = self.figure.get_figheight()
        rows = [[name for name in dict.fromkeys(row) if name in self._heights] for row in self._mosaic]
        wanted = [max([self._heights[name]() for name in row]) for row in rows]
        grid = self.panels[rows[0][0]].get_gridspec()
        assert grid is not None
        grid.set_height_ratios([max(height, 1e-3) for height in wanted])
        spare = sum([tall * _place(self.panels[row[0]]).height for row in rows]) - sum(wanted)
        self.figure.set_figheight(tall - spare)
        for axes in self._planes:  # only now, since labels of a plane within its cell would take no space
            axes.set_aspect("equal", adjustable="box", anchor="NW")
        self._engine.execute(self.figure)
        self.figure.set_layout_engine("none")
        if self._labels:
            self._place_labels()
        self.figure.set_label("\n".join(self._caption))
        return self.figure


def series(
    medium: Medium, title: Sequence[str], captions: Sequence[str], window: Window
) -> tuple[Sheet, list[Axes]]:
    """Return a sheet with a panel below each caption, in rows of up to ACROSS, that all show `window`."""
    count, columns = len(captions), min(ACROSS, len(captions))
    rows = [
        [str(i) if i < count else "" for i in range(first, first + columns)]
        for first in range(0, count, columns)
    ]
    sheet = Sheet(medium, count == 1, title, [*rows, ["key"] * columns])
    for i, caption in enumerate(captions):
        sheet.plane(str(i), window, LONE if count == 1 else math.inf, low=i % columns == 0)
        sheet.panels[str(i)].set_title(caption, loc="left", pad=3)
    return sheet, [sheet.panels[str(i)] for i in range(count)]


def said(handle: Artist) -> str:
    """Return how a line or its markers look, in words, as for the caption of a figure without a legend."""
    if not isinstance(handle, Line2D):
        return "shaded"
    style, marker = handle.get_linestyle(), str(handle.get_marker())
    _, dashes = vars(handle).get("_unscaled_dash_pattern") or (0, None)  # the style of any dashes is "--"
    dotted = style == "--" and dashes is not None and len(dashes) == 2 and dashes[0] <= DOT
    words = [] if style == "None" else [f"{'dotted' if dotted else LINES.get(str(style), 'dashed')} line"]
    colour = handle.get_color()
    if marker != "None":
        colour = colour if words else handle.get_markerfacecolor()
        words.append(MARKERS.get(marker, "markers"))
    return f"{hue(colour)} {' with '.join(words)}".strip()


def hue(colour: ColorType) -> str:
    """Return the name of the hue of `colour`: grey, or one of HUE_NAMES."""
    if isinstance(colour, str) and colour == "none":
        return "open"
    at, saturation, value = rgb_to_hsv(to_rgb(colour))
    if saturation < LEAST_SATURATION:
        return "black" if value < DARK else "white" if value > 1.0 - DARK else "grey"
    return min(HUE_NAMES, key=lambda name: abs((HUE_NAMES[name] - at + 0.5) % 1.0 - 0.5))


def _place(axes: Axes) -> Bbox:
    """Return the cell of `axes`, in fractions of the figure's size."""
    return axes.get_position(original=True)


def circle(axes: Axes, place: tuple[float, float], radius: float, **look: Any) -> None:
    """Draw a circle of `radius` m about `place`; its entry in the key is a line."""
    label, gid = look.pop("label", None), look.pop("gid", None)
    axes.add_patch(Circle(place, radius, fill=False, gid=gid, **look))
    if label is not None:
        entry(axes, label, **look)


def trace(axes: Axes, poses: Iterable[Pose], *style: str, **look: Any) -> None:
    """Draw a line, or the markers of `style`, through the positions of `poses`."""
    x, y = zip(*[(pose.x, pose.y) for pose in poses], strict=True)
    axes.plot(x, y, *style, **look)


def entry(axes: Axes, label: str, *style: str, **look: Any) -> None:
    """Add an entry to the key of `axes`, of what is drawn without one."""
    axes.plot([], [], *style, label=label, **look)


def heading(axes: Axes, pose: Pose, length: float, colour: str, zorder: float = 4.5) -> None:
    """Draw an arrow of `length` m along the heading of `pose`."""
    looks = {"arrowstyle": "-|>", "color": colour, "lw": 1.1, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8}
    tip = compose(pose, Pose(length, 0.0, 0.0))
    axes.annotate("", (tip.x, tip.y), (pose.x, pose.y), arrowprops=looks, zorder=zorder)


def plain(text: str) -> str:
    """Return `text` with each `$` escaped, for literal printing."""
    return text.replace("$", r"\$")


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
