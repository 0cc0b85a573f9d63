"""What all pictures share: fonts, colours, and how they are saved."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from protocol.mission import Role

COLOURS: dict[Role, str] = {"a": "#0b62a4", "b": "#c4451c"}
"""of a pair's robots; told apart without colour by their lightness"""
DPI = 160


def look() -> AbstractContextManager[None]:
    """Matplotlib's settings, within which pictures are drawn and saved.

    With that salt the same picture is the same bytes; text is as it stands, `$` and `_` included.
    """
    return mpl.rc_context({"svg.hashsalt": "tandem", "font.size": 9, "text.parse_math": False})


def save(figure: Figure, path: Path) -> tuple[Path, Path]:
    """As SVG and as PNG, `path` with these endings; both carry no date. Raises OSError."""
    svg, png = path.with_suffix(".svg"), path.with_suffix(".png")
    figure.savefig(svg, metadata={"Date": None})
    figure.savefig(png, dpi=DPI)
    return svg, png
