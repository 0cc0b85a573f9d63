"""The covariance of the errors of N ranges, and products with its inverse.

Constant errors, such as the bias of a radio or the scale of a wheel, are few: they have low rank. White
errors of ranges are independent. Therefore the inverse is computed with the Woodbury identity, and only white
odometry noise and slow errors of ranges make a matrix of shape (N, N).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.odometry_noise import Array


class RangeCovariance(NamedTuple):
    """The covariance D + C C', with the white part D and the effects C of constant errors."""

    white: Array
    """D (m^2): its diagonal, shape (N,); or D + C C', shape (N, N), with odometry noise or slow errors."""
    columns: Array
    """C (m); shape (N, m). It has no columns if `white` contains them."""
    inverse: Array
    """The inverse of `white`, in the same shape."""
    weighted: Array
    """D^-1 C; shape (N, m)."""
    core: Array
    """(I + C' D^-1 C)^-1; shape (m, m)."""

    def solve(self, columns: Array) -> Array:
        """Return `columns`, shape (N, k), multiplied by the inverse covariance."""
        if self.white.ndim == 2:
            return np.asarray(self.inverse @ columns, np.float64)
        solved: Array = self.inverse[:, None] * columns
        if self.columns.shape[1]:
            solved -= self.weighted @ (self.core @ (self.weighted.T @ columns))
        return solved

    @property
    def precisions(self) -> Array:
        """The diagonal of the inverse covariance; shape (N,)."""
        if self.white.ndim == 2:
            return np.diagonal(self.inverse)
        explained: Array = np.sum((self.weighted @ self.core) * self.weighted, 1)
        return self.inverse - explained

    @property
    def log_determinant(self) -> float:
        """The logarithm of the determinant."""
        if self.white.ndim == 2:
            return float(np.linalg.slogdet(self.white)[1])
        volume = float(np.sum(np.log(self.white)))
        return volume - float(np.linalg.slogdet(self.core)[1]) if self.columns.shape[1] else volume


def range_covariance(variance: Array, columns: Array, dense: Array | None) -> RangeCovariance:
    """Return the covariance of ranges with the variances of their own errors, in m^2.

    `columns` are the effects (m) of constant errors, and `dense` is the covariance (m^2) from white odometry
    noise and slow errors; None if there is neither.
    """
    if dense is not None:
        whole = dense + columns @ columns.T
        whole.flat[:: len(whole) + 1] += variance + GRAIN * float(np.max(np.diagonal(whole)))
        return RangeCovariance(whole, columns[:, :0], inverse_of(whole), columns[:, :0], columns[:0, :0])
    inverse = 1.0 / variance
    weighted = inverse[:, None] * columns
    core = columns.T @ weighted
    core.flat[:: len(core) + 1] += 1.0
    return RangeCovariance(variance, columns, inverse, weighted, inverse_of(core))


GRAIN = 1e-12
"""The least variance of a range, as a fraction of the largest variance from odometry noise.

With less, the covariance would be singular in floating point.
"""


def inverse_of(matrix: Array) -> Array:
    """Return the inverse of a matrix, or of each matrix in a stack."""
    return np.asarray(np.linalg.inv(matrix), np.float64)
