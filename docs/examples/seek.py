"""A controller of one's own in the simulator: robot a seeks its anchor by the ranges alone."""

from __future__ import annotations

import tandem


def main() -> None:
    """Drive a ahead as long as its range to the anchor falls, and turn it when the range grows."""
    world = tandem.World("noisy")
    before = range_to_anchor = world.observe()["a"].anchor_range
    while range_to_anchor is not None and range_to_anchor > 0.3 and world.outcome is None:
        closer = before is None or range_to_anchor <= before
        world = world.step({"a": (0.25, 0.0) if closer else (0.1, 0.5)})
        before, range_to_anchor = range_to_anchor, world.observe()["a"].anchor_range
        print(f"{world.tick:3}  range {range_to_anchor} m  true pose {world.truth['a']}")


if __name__ == "__main__":
    main()
