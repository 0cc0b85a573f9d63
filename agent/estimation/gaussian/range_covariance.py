"""The covariance of the errors of N ranges, and products with its inverse.

Constant errors, such as the bias of a radio or the scale of a wheel, are few: they have low rank. White
errors of ranges are independent. Therefore the inverse is computed with the Woodbury identity, and only white
odometry noise and slow errors of ranges make a matrix of shape (N, N). Where ranges are much more accurate
than a prior, the identity cancels with a normal matrix; it is then used with a QR decomposition.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agent.estimation.gaussian.odometry_noise import Array


class RangeCovariance(NamedTuple):
    """The covariance D + C C', with the white part D and the effects C of constant errors.

    All arrays may have further axes in front, of covariances that are computed at once.
    """

    white: Array
    """D (m^2): its diagonal, shape (..., N); or D + C C', shape (..., N, N), if D is not diagonal."""
    columns: Array
    """C (m); shape (..., N, m). It has no columns if `white` contains them."""
    inverse: Array
    """The inverse of `white`, in the same shape."""
    left: Array
    """The first factor of what C subtracts from `inverse`; shape (..., N, m)."""
    right: Array
    """The second factor. The inverse covariance is `inverse` - `left` `right`'."""
    normal: Array
    """The matrix I + C' D^-1 C; shape (..., m, m)."""

    @property
    def _dense(self) -> bool:
        return self.white.ndim == self.columns.ndim

    def solve(self, columns: Array) -> Array:
        """Return `columns`, shape (..., N, k), multiplied by the inverse covariance."""
        if self._dense:
            explained = np.diagonal(self.white, axis1=-2, axis2=-1) * self.precisions
            if explained.size and explained.max() > MOST_EXPLAINED:
                return np.asarray(np.linalg.solve(self.white, columns), np.float64)
            return np.asarray(self.inverse @ columns, np.float64)
        solved: Array = self.inverse[..., None] * columns
        if self.columns.shape[-1]:
            solved -= self.left @ (self.right.mT @ columns)
        return solved

    @property
    def precisions(self) -> Array:
        """The diagonal of the inverse covariance; shape (..., N)."""
        if self._dense:
            return np.diagonal(self.inverse, axis1=-2, axis2=-1)
        explained: Array = np.add.reduce(self.left * self.right, -1)
        return self.inverse - explained

    @property
    def log_determinant(self) -> Array:
        """The logarithm of the determinant; shape (...)."""
        if self._dense:
            return np.asarray(np.linalg.slogdet(self.white)[1], np.float64)
        volume: Array = np.sum(np.log(self.white), -1)
        return volume + np.asarray(np.linalg.slogdet(self.normal)[1], np.float64)


def range_covariance(variance: Array, columns: Array, dense: Array | None) -> RangeCovariance:
    """Return the covariance of ranges with the variances of their own errors, in m^2; shape (..., N).

    `columns` are the effects (m) of constant errors, and `dense` is the covariance (m^2) from white odometry
    noise and slow errors; None if there is neither.
    """
    if dense is not None:
        whole = dense + columns @ columns.mT
        diagonal = np.einsum("...ii->...i", whole)
        diagonal += variance + GRAIN * diagonal.max(-1, keepdims=True)
        empty = columns[..., :0]
        return RangeCovariance(whole, empty, inverse_of(whole), empty, empty, empty[..., :0, :])
    inverse = 1.0 / variance
    right = inverse[..., None] * columns
    normal = columns.mT @ right
    diagonal = np.einsum("...ii->...i", normal)
    diagonal += 1.0
    if diagonal.size and diagonal.max() > MOST_INFORMATION:
        left = right = _decomposed(inverse, columns)
    else:
        left = right @ inverse_of(normal)
    return RangeCovariance(variance, columns, inverse, left, right, normal)


def _decomposed(inverse: Array, columns: Array) -> Array:
    """Return D^-1/2 Q, with the QR decomposition of [D^-1/2 C; I] and the first N rows of Q."""
    white = np.sqrt(inverse)[..., None]
    n, m = columns.shape[-2:]
    stacked = np.empty((*columns.shape[:-2], n + m, m))
    stacked[..., :n, :], stacked[..., n:, :] = white * columns, np.eye(m)
    return np.asarray(white * np.linalg.qr(stacked)[0][..., :n, :], np.float64)


MOST_INFORMATION = 1e6
"""The information on a constant error, in units of its prior, above which the identity is used with QR.

The normal matrix loses as many digits as this has, and QR takes longer.
"""


MOST_EXPLAINED = 1e8
"""The variance of a range, in units of what the others leave of it, above which products are solved for.

Products with the inverse lose as many digits as this has, and solving takes longer. With exact ranges and
odometry noise of 1 %, the variance of a claim, which is a difference of such products, was wrong by up to
3e-6 m^2, and could be negative. A sigma of 0.001 m leads to this value if odometry is off by 10 m.
"""

GRAIN = 1e-12
"""The least variance of a range, as a fraction of the largest variance from odometry noise.

With less, the covariance would be singular in floating point.
"""


def inverse_of(matrix: Array) -> Array:
    """Return the inverse of a matrix, or of each matrix in a stack."""
    return np.asarray(np.linalg.inv(matrix), np.float64)
