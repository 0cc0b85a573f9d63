"""Figures of a recording.

`pair` holds the data of all of them, `style` and `sheet` define the common layout, and `catalogue` lists all
figures by kind.
"""

PICTURES = (
    "meetings",
    "trajectory",
    "phases",
    "geometry",
    "phase-1",
    "plan",
    "encounter",
    "ranges",
    "errors",
    "robot",
)
"""The kinds of figures: that of a group, those of Figs. 3 and 4 of the paper, then those over time."""
FIGURE_FORMATS = ("svg", "pdf", "png")
