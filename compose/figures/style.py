"""The common style of all figures: the media they are drawn for, fonts, colours and markers, and saving."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib import _mathtext
from matplotlib.figure import Figure

from compose.figures import FIGURE_FORMATS
from compose.view.colours import COLOURS
from protocol import files
from protocol.mission import Role

ROLE_MARKERS: dict[Role, dict[str, Any]] = {
    "a": {"marker": "o", "markerfacecolor": COLOURS["a"], "markeredgecolor": COLOURS["a"]},
    "b": {"marker": "^", "markerfacecolor": "white", "markeredgecolor": COLOURS["b"]},
}
"""The markers of a pair's robots by role: filled circles and open triangles, which differ in grey."""
INK, PALE, PALER = "#1a1a1a", "0.45", "0.75"
"""The colours of lines that belong to neither robot, in decreasing importance."""
SHADE = "#f3e6bd"
"""The background colour of ticks in contact."""
TEXT = 8.0
"""The font size of all text, in points."""
SMALLEST_FONT = 6.0
"""The font size of subscripts and superscripts, in points."""
COLUMN, PAGE = 3.5, 7.16
"""The widths of one column and of two columns of a paper (IEEE), in inches."""

_DATES: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}

# Matplotlib has no setting for the size of subscripts, which its 0.7 would make 5.6 points.
_mathtext.SHRINK_FACTOR = SMALLEST_FONT / TEXT
# fontTools warns of the dates in the STIX fonts when it embeds them.
logging.getLogger("fontTools").setLevel(logging.ERROR)


class Medium(NamedTuple):
    """The size, resolution and fonts of figures for one use."""

    titled: bool
    """True if figures have a title."""
    narrow: float
    """The width of a figure that fits one column, in inches."""
    dpi: int
    """The resolution of PNG files, in dots per inch."""
    settings: dict[Any, Any]
    """The fonts, as settings of Matplotlib."""
    keyed: bool = True
    """True if figures have legends; without them, the label of a figure has their content."""


_SIZES = dict.fromkeys(
    (
        "font.size", "axes.labelsize", "axes.titlesize", "xtick.labelsize", "ytick.labelsize",
        "legend.fontsize", "legend.title_fontsize",
    ),
    TEXT,
)  # fmt: skip
_FINE = {"axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "axes.labelpad": 2.0}

SCREEN = Medium(True, PAGE, 160, {**_SIZES, **_FINE, "mathtext.fontset": "stix"})
"""Figures to look at: titled, all of one width."""
PAPER = Medium(
    False, COLUMN, 300, {**_SIZES, **_FINE, "font.family": "STIXGeneral", "mathtext.fontset": "stix"}
)
"""Figures to put in a paper, whose captions are their titles: COLUMN or PAGE wide, in a Times typeface."""
SWEEP_MEDIUM = Medium(False, PAGE, 160, {"font.size": 9, "text.parse_math": False})
"""Figures of sweeps, whose labels are text of sweep files and hence printed literally."""


@contextmanager
def look(medium: Medium) -> Iterator[None]:
    """Use the matplotlib settings for drawing and saving figures for `medium`, and no others.

    Matplotlib reads a file `matplotlibrc` in the working directory. That may be a stranger's folder, and the
    file can start LaTeX. With the fixed hash salt, and without a date, a figure that is drawn again differs
    little. Fonts are embedded as TrueType (42), because publishers reject Type 3, matplotlib's default.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        with mpl.rc_context(
            {
                "svg.hashsalt": "tandem",
                "pdf.fonttype": 42,
                "ps.fonttype": 42,
                "text.parse_math": True,
                **medium.settings,
            }
        ):
            yield


def save(
    figure: Figure, path: Path, formats: Sequence[str] = FIGURE_FORMATS, dpi: int = SWEEP_MEDIUM.dpi
) -> tuple[Path, ...]:
    """Save `figure` as `path` with each of `formats` as its extension, without dates; return the paths.

    Raises OSError.
    """
    written = [path.with_name(f"{path.name}.{ending}") for ending in formats]
    for ending, place in zip(formats, written, strict=True):
        with files.draft(place) as drawn:
            figure.savefig(drawn, format=ending, dpi=dpi, metadata=_DATES[ending])
    return tuple(written)
