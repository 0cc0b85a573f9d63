"""The common style of all figures: fonts, colours, lines and markers, and saving."""

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
"""The colours of a pair's robots by role, blue and red as in the paper. MARKS distinguish them in grey."""
MARKS: dict[Role, dict[str, Any]] = {
    "a": {"marker": "o", "markerfacecolor": COLOURS["a"], "markeredgecolor": COLOURS["a"]},
    "b": {"marker": "^", "markerfacecolor": "white", "markeredgecolor": COLOURS["b"]},
}
"""The markers of a pair's robots by role: filled circles and open triangles."""
DASHES: dict[Role, Any] = {"a": (0, (6, 2)), "b": (0, (2, 1.4))}
"""The line styles by role of a robot's lines other than paths."""
INK, PALE, PALER = "#1a1a1a", "0.45", "0.75"
"""The colours of lines that belong to neither robot, in decreasing importance."""
SHADE = "#f3e6bd"
"""The background colour of ticks in contact."""
DPI = 160
"""The resolution of PNG files, in dots per inch."""
PLACES = 6
"""The number of decimal places of panel positions, which are fractions of the figure's size."""

_DATES: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}


def look(symbols: bool = False) -> AbstractContextManager[None]:
    """Return the matplotlib settings for drawing and saving figures.

    The fixed hash salt makes equal figures equal byte for byte. Fonts are embedded as TrueType (42), because
    publishers reject Type 3, matplotlib's default. Text is printed literally, or, with `symbols`, text
    between two `$` is set as mathematics.
    """
    return mpl.rc_context(
        {"svg.hashsalt": "tandem", "pdf.fonttype": 42, "font.size": 9, "text.parse_math": symbols}
    )


def save(figure: Figure, path: Path, formats: Sequence[str] = FORMATS) -> tuple[Path, ...]:
    """Save `figure` as `path` with each of `formats` as its extension, without dates; return the paths.

    Raises OSError.
    """
    _settle(figure)
    written = [path.with_name(f"{path.name}.{ending}") for ending in formats]
    for ending, place in zip(formats, written, strict=True):
        with files.draft(place) as drawn:
            figure.savefig(drawn, format=ending, dpi=DPI, metadata=_DATES[ending])
    return tuple(written)


def _settle(figure: Figure) -> None:
    """Fix the panels' positions from a constrained layout, rounded to PLACES.

    The last bits of a constrained layout vary between processes, so unrounded files would differ.
    """
    if figure.get_layout_engine() is None:
        return
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        corners = axes.get_position(original=True).get_points()
        axes.set_position(Bbox(corners.round(PLACES)), "original")
