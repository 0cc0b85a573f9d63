"""The covariance of the errors of N ranges, and products with its inverse.

Constant errors, such as the bias of a radio or the scale of a wheel, are few: they have low rank. White
errors of ranges are independent. Therefore the inverse is computed with the Woodbury identity, and only white
odometry noise and slow errors of ranges make a matrix of shape (N, N). The identity is used with a QR
decomposition: with a normal matrix it cancels where ranges are much more accurate than a prior.
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
    weighted: Array
    """D^-1/2 Q, with the QR decomposition of [D^-1/2 C; I] and the first N rows of Q; shape (..., N, m)."""
    root: Array
    """The factor R of it: R' R = I + C' D^-1 C; shape (..., m, m)."""

    @property
    def _dense(self) -> bool:
        return self.white.ndim == self.columns.ndim

    def solve(self, columns: Array) -> Array:
        """Return `columns`, shape (..., N, k), multiplied by the inverse covariance."""
        if self._dense:
            return np.asarray(self.inverse @ columns, np.float64)
        solved: Array = self.inverse[..., None] * columns
        if self.columns.shape[-1]:
            solved -= self.weighted @ (np.swapaxes(self.weighted, -1, -2) @ columns)
        return solved

    @property
    def precisions(self) -> Array:
        """The diagonal of the inverse covariance; shape (..., N)."""
        if self._dense:
            return np.diagonal(self.inverse, axis1=-2, axis2=-1)
        explained: Array = np.add.reduce(np.square(self.weighted), -1)
        return self.inverse - explained

    @property
    def log_determinant(self) -> Array:
        """The logarithm of the determinant; shape (...)."""
        if self._dense:
            return np.asarray(np.linalg.slogdet(self.white)[1], np.float64)
        volume: Array = np.sum(np.log(self.white), -1)
        diagonal = np.diagonal(self.root, axis1=-2, axis2=-1)
        volume += 2.0 * np.sum(np.log(np.abs(diagonal)), -1)
        return volume


def range_covariance(variance: Array, columns: Array, dense: Array | None) -> RangeCovariance:
    """Return the covariance of ranges with the variances of their own errors, in m^2; shape (..., N).

    `columns` are the effects (m) of constant errors, and `dense` is the covariance (m^2) from white odometry
    noise and slow errors; None if there is neither.
    """
    if dense is not None:
        whole = dense + columns @ np.swapaxes(columns, -1, -2)
        diagonal = np.einsum("...ii->...i", whole)
        diagonal += variance + GRAIN * diagonal.max(-1, keepdims=True)
        empty = columns[..., :0]
        return RangeCovariance(whole, empty, inverse_of(whole), empty, empty[..., :0, :])
    inverse = 1.0 / variance
    white = np.sqrt(inverse)[..., None]
    n, m = columns.shape[-2:]
    stacked = np.empty((*columns.shape[:-2], n + m, m))
    stacked[..., :n, :], stacked[..., n:, :] = white * columns, np.eye(m)
    q, root = np.linalg.qr(stacked)
    return RangeCovariance(variance, columns, inverse, white * q[..., :n, :], root)


GRAIN = 1e-12
"""The least variance of a range, as a fraction of the largest variance from odometry noise.

With less, the covariance would be singular in floating point.
"""


def inverse_of(matrix: Array) -> Array:
    """Return the inverse of a matrix, or of each matrix in a stack."""
    return np.asarray(np.linalg.inv(matrix), np.float64)
