"""Pictures of a record: `pair` and `story` are what there is to tell, `style` and `sheet` what all share.

`album` has them all, by the names below.
"""

PICTURES = ("trajectory", "phase-1", "plan", "encounter", "ranges", "errors", "robot")
"""in the order of the paper's Figs. 3 and 4, then over time"""
FORMATS = ("svg", "pdf", "png")
