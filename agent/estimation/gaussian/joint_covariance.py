"""The covariance of all ranges of n robots from white errors, and products with its inverse.

The ranges of a robot to anchors depend on its own odometry alone. They are therefore eliminated for each
robot by itself, and what is left has the size of the ranges between robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.odometry_noise import Array, Places
from agent.estimation.gaussian.range_covariance import inverse_of


class OwnBlock(NamedTuple):
    """The ranges of one robot to anchors, eliminated."""

    rows: slice
    """The rows of its ranges to anchors."""
    inverse: Array
    """The inverse of their covariance (m^2); shape (A, A)."""
    mutual: Places
    """The places of its ranges to robots among those between robots; shape (M,)."""
    gain: Array
    """`inverse` times the covariance of both; shape (A, M)."""


class JointCovariance(NamedTuple):
    """The inverse of the covariance of all ranges (m^2), in blocks."""

    blocks: tuple[OwnBlock, ...]
    mutual: slice
    """The rows of the ranges between robots."""
    inverse: Array
    """The inverse covariance of the ranges between robots, given those to anchors."""
    log_determinant: float

    def solve(self, columns: Array) -> Array:
        """Return `columns`, shape (N, k), multiplied by the inverse covariance."""
        left = columns[self.mutual].copy()
        for block in self.blocks:
            left[block.mutual] -= block.gain.T @ columns[block.rows]
        solved = np.empty_like(columns)
        solved[self.mutual] = of_mutual = self.inverse @ left
        for block in self.blocks:
            own = block.inverse @ columns[block.rows]
            solved[block.rows] = own - block.gain @ of_mutual[block.mutual]
        return solved

    @property
    def precisions(self) -> Array:
        """The diagonal of the inverse covariance; shape (N,)."""
        found = np.empty(self.mutual.stop)
        found[self.mutual] = np.diagonal(self.inverse)
        for rows, inverse, mutual, gain in self.blocks:
            of_gain = np.add.reduce((gain @ self.inverse[np.ix_(mutual, mutual)]) * gain, 1)
            found[rows] = np.diagonal(inverse) + of_gain
        return found


def joint_covariance(
    own: Sequence[Array], rows: Sequence[tuple[slice, Places]], mutual: Array
) -> JointCovariance:
    """Return the inverse covariance of all ranges, from the covariances of each robot's ranges.

    `own` has the covariance (m^2) of all ranges of each robot, first those to anchors, with their own
    errors, and then those to robots, without. `rows` has the rows of the former, and the places of the latter
    among those between robots. `mutual` is the covariance of the own errors of these.
    """
    blocks, volume = [], 0.0
    begin = rows[-1][0].stop if rows else 0
    left = mutual.copy()
    for covariance, (of_anchors, places) in zip(own, rows, strict=True):
        count = of_anchors.stop - of_anchors.start
        corner, cross = covariance[:count, :count], covariance[:count, count:]
        inverse = inverse_of(corner)
        gain = inverse @ cross
        left[np.ix_(places, places)] += covariance[count:, count:] - cross.T @ gain
        volume += float(np.linalg.slogdet(corner)[1])
        blocks.append(OwnBlock(of_anchors, inverse, places, gain))
    volume += float(np.linalg.slogdet(left)[1])
    return JointCovariance(tuple(blocks), slice(begin, begin + len(mutual)), inverse_of(left), volume)
