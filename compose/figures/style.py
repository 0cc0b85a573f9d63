"""What all pictures share: fonts, colours, lines and markers, and how they are saved."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from compose.figures import FORMATS
from protocol import files
from protocol.mission import Role

COLOURS: dict[Role, str] = {"a": "#0b62a4", "b": "#c4451c"}
"""of a pair's robots, as in the paper: blue and red; in grey their markers tell them apart"""
MARKS: dict[Role, dict[str, Any]] = {
    "a": {"marker": "o", "markerfacecolor": COLOURS["a"], "markeredgecolor": COLOURS["a"]},
    "b": {"marker": "^", "markerfacecolor": "white", "markeredgecolor": COLOURS["b"]},
}
"""filled circles, and open triangles"""
DASHES: dict[Role, Any] = {"a": (0, (6, 2)), "b": (0, (2, 1.4))}
"""of what belongs to a robot and is no path"""
INK, PALE, PALER = "#1a1a1a", "0.45", "0.75"
"""what belongs to neither robot, by how much it matters"""
SHADE = "#f3e6bd"
"""of time in contact"""
DPI = 160
PLACES = 6
"""digits of a place on the paper, as a share of its width or height"""

_DATES: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}


def look(symbols: bool = False) -> AbstractContextManager[None]:
    """Matplotlib's settings, within which pictures are drawn and saved.

    With that salt the same picture is the same bytes. Fonts are embedded as TrueType (42): publishers refuse
    Type 3, matplotlib's default. Text is as it stands, `$` and `_` included; or, with `symbols`, what is
    between two `$` is set as the paper sets it.
    """
    return mpl.rc_context(
        {"svg.hashsalt": "tandem", "pdf.fonttype": 42, "font.size": 9, "text.parse_math": symbols}
    )


def save(figure: Figure, path: Path, formats: Sequence[str] = FORMATS) -> tuple[Path, ...]:
    """In each of `formats`, `path` with that ending; none carries a date. Raises OSError."""
    _settle(figure)
    written = [path.with_name(f"{path.name}.{ending}") for ending in formats]
    for ending, place in zip(formats, written, strict=True):
        with files.draft(place) as drawn:
            figure.savefig(drawn, format=ending, dpi=DPI, metadata=_DATES[ending])
    return tuple(written)


def _settle(figure: Figure) -> None:
    """Panels stay where a constrained layout has them, to PLACES: the last bits depend on where in memory."""
    if figure.get_layout_engine() is None:
        return
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        corners = axes.get_position(original=True).get_points()
        axes.set_position(Bbox(corners.round(PLACES)), "original")
