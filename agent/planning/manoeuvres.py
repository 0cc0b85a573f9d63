"""The manoeuvres that a planner compares when it plans phases 1 and 3."""

from __future__ import annotations

import msgspec


class Manoeuvres(msgspec.Struct, frozen=True):
    """The directions and speeds among which a planner chooses."""

    directions: tuple[float, ...]
    """The signs of v in phase 1: 1 forward, -1 backward."""
    sides: tuple[float, ...]
    """The signs of omega_1 in eq. (4): 1 to the left, -1 to the right."""
    last_speeds: tuple[float, ...] | None
    """The values of v_2 in eq. (8), in units of A_0 / T_s; None for v_max alone."""
    fewest_out_of_range: bool
    """True if only last manoeuvres count that leave the fewest placements out of range.

    No detection selects those placements.
    """

    @property
    def backward(self) -> bool:
        """Return whether the robot also drives backward."""
        return -1.0 in self.directions
