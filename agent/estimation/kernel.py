"""The kernel of the estimator: `smoother.c`, which is compiled when Tandem is installed, called by ctypes.

Its functions are those of `smoother` and `gauss_newton`, and equal to the bit.
"""

from __future__ import annotations

import ctypes
import math
from itertools import accumulate, pairwise

import numpy as np

from agent.estimation.compiled import Pointer, address, library
from agent.estimation.gauss_newton import Convergence, Fitted, Point
from agent.estimation.gaussian.odometry_noise import Places
from agent.estimation.gaussian.range_weights import Weighing
from agent.estimation.smoother import Array, FitStep, Measured, Singular, Walk


class _Measured(ctypes.Structure):
    """`Measured` of smoother.c."""

    _fields_ = [
        *[(name, ctypes.c_longlong) for name in ("robots", "ticks", "ranges", "common", "constant")],
        *[(name, ctypes.c_longlong) for name in ("anchors", "radios", "scaled", "delayed", "strays")],
        *[(name, ctypes.c_double) for name in ("period", "survey", "slow", "decay", "scale")],
        *[(name, Pointer) for name in ("v", "omega", "slip", "white", "stray", "patterns", "place", "rho")],
        *[(name, Pointer) for name in ("effects", "mean", "information", "pivot")],
        *[(name, Pointer) for name in ("begin", "first", "second", "anchor", "radio")],
    ]


class _Weighing(ctypes.Structure):
    """`Weighing` of smoother.c."""

    _fields_ = [
        *[(name, ctypes.c_double) for name in ("longest", "inlier", "outlier", "stray", "least", "most")],
        *[(name, ctypes.c_double) for name in ("degrees", "astray", "astray_ratio")],
        *[(name, ctypes.c_longlong) for name in ("free", "robust", "noisy")],
        *[(name, Pointer) for name in ("sigma", "holding", "by_radio")],
    ]


class _Convergence(ctypes.Structure):
    """`Convergence` of smoother.c."""

    _fields_ = [("steps", ctypes.c_longlong), ("shortest", ctypes.c_double), ("decrease", ctypes.c_double)]


class Kernel:
    """The functions of `smoother` and `gauss_newton` for the measurements of a fit, with a workspace."""

    def __init__(self, of: Measured, by: Weighing) -> None:
        """Prepare the workspace."""
        self.of = of = Measured._make(
            [np.ascontiguousarray(one) if isinstance(one, np.ndarray) else one for one in of]
        )
        self.by = by  # the kernel has the addresses of its arrays
        n, k, count, c, m = of.robots, of.ticks, len(of.rho), of.common.shape[1], of.patterns.shape[1]
        size, s, n3 = of.size, 3 * n + of.radios, 3 * n
        q = size + 2 * of.anchors
        arrays = (
            *(of.v, of.omega, of.slip, of.white, of.stray, of.patterns, of.place, of.rho, of.common),
            *(of.mean, of.information, of.pivot, of.begin, of.first, of.second, of.anchor, of.radio),
        )
        self._memory = [address(one) for one in (*arrays, by.sigma, by.holding, by.by_radio)]
        at = [ctypes.addressof(one) for one in self._memory]
        self._measured = ctypes.byref(
            _Measured(
                *(n, k, count, c, m, of.anchors, of.radios, of.scaled, of.delayed, of.strays),
                *(of.period, of.survey, of.slow, of.decay, of.scale),
                *at[: len(arrays)],
            )
        )
        self._weighing = ctypes.byref(
            _Weighing(
                *(by.longest, by.inlier, by.outlier, by.stray, by.least, by.most, by.degrees),
                *(by.astray, by.astray_ratio, by.free, by.robust, by.noisy),
                *at[len(arrays) :],
            )
        )
        self._of_walk = ((n, k + 1, 3), (n, k, 8), (count, 2), count, count)
        ticks, of_ranges = k * of.strays, (count, count, count, count, count)
        self._of_step = (size, size, (size, size), (n, 2, k), *of_ranges, (n3, n3), (n, ticks, 5), 4)
        of_point = (n3, c, (n, m), (n, 2, k), count, count, *self._of_walk, count, 1)
        self._fitted = _Layout(*of_point, *of_point, *self._of_step, count, count, (n, ticks), 6)
        vectors = (count, count, count * q, count * s, s, s * q, s * s, q * q, q)
        spaces = (s, s * size, s * s, s, size, size * size, max(size, n3) ** 2, *[max(q, of.radios)] * 2)
        weights = (*[count] * 4, n3, n * ticks, 2 * n * ticks)
        self._work, self._space = _Layout(*vectors, *spaces, *weights).space()

    def __reduce__(self) -> tuple[type[Kernel], tuple[Measured, Weighing]]:
        """Return how to build the kernel again from a copy, which has memory of its own."""
        return Kernel, (self.of, self.by)

    def walked(self, poses: Array, constants: Array, white: Array) -> Walk:
        """Return the paths; see `smoother.walked`."""
        at, arrays = _Layout(*self._of_walk).new()
        library().walked(self._measured, *map(address, (poses, constants, white, at)))
        return Walk._make(arrays)

    def step(self, walk: Walk, poses: Array, variance: Array, ridge: float, largest: float) -> FitStep:
        """Return a Gauss-Newton step; see `smoother.step`. Raises Singular."""
        at, arrays = _Layout(*self._of_step).new()
        memory = [address(one) for one in walk]
        of_walk = address(np.array([ctypes.addressof(one) for one in memory]))
        if not library().gauss_newton_step(
            *(self._measured, of_walk, address(poses), address(variance)),
            *(ctypes.c_double(ridge), ctypes.c_double(largest), address(self._work), address(at)),
        ):
            raise Singular("the ranges do not determine all unknowns")
        return _step_of(arrays)

    def guess(self, poses: Array) -> Array:
        """Return pivots in the robots' frames and headings; see `gauss_newton.guess`."""
        found = np.empty(3 * self.of.robots)
        library().guess(self._measured, address(np.ascontiguousarray(poses)), address(found))
        return found

    def weights_by_errors(self, errors: Array, sigma: Array) -> Array:
        """Return the probability that each range is an inlier; see `range_weights.weights_by_errors`."""
        found, ratios = np.empty((2, len(errors)))
        given = (
            ctypes.c_longlong(len(errors)),
            address(errors),
            address(sigma),
            address(ratios),
            address(found),
        )
        library().weights_by_errors(self._weighing, *given)
        return found

    def fitted(
        self, poses: Array, constant: Array, white: Array, weights: Array | None, until: Convergence
    ) -> Fitted:
        """Return the fit that begins at these start poses and errors; see `gauss_newton.fitted`.

        Raises Singular.
        """
        at, arrays = self._begun(poses, constant, white, weights)
        end, weighed = ctypes.byref(_Convergence(*until)), ctypes.c_int(weights is not None)
        if not library().fitted(
            self._measured, self._weighing, end, weighed, address(self._work), address(at)
        ):
            raise Singular("the ranges do not determine all unknowns, or an error is too large for a float")
        return _fitted_of(arrays)

    def held(self, poses: Array, constant: Array, white: Array, weights: Array, steps: int) -> Fitted:
        """Return the fit in which a range holds a coordinate; see `gauss_newton.held`. Raises Singular."""
        at, arrays = self._begun(poses, constant, white, weights)
        number = ctypes.c_longlong(steps)
        if not library().held(self._measured, self._weighing, number, address(self._work), address(at)):
            raise Singular("the ranges do not determine all unknowns, or an error is too large for a float")
        return _fitted_of(arrays)

    def _begun(
        self, poses: Array, constant: Array, white: Array, weights: Array | None
    ) -> tuple[Places, list[Array]]:
        """Return the memory of a fit that begins at these start poses and errors."""
        at, arrays = self._fitted.new()
        of_poses, common, of_constant, of_white, slow, of_slow = arrays[:6]
        of_poses[...], of_constant[...], of_white[...] = poses, constant, white
        common[...] = slow[...] = of_slow[...] = 0.0
        if weights is not None:
            arrays[-4][...] = weights
        return at, arrays


POINT = len(Walk._fields) + 8
"""The number of arrays of a point."""


def _point_of(arrays: list[Array]) -> Point:
    """Return the point with these arrays."""
    (*errors, own, prior_cost), walk = [*arrays[:6], *arrays[-2:]], Walk._make(arrays[6:-2])
    return Point._make([*errors, walk, own, float(prior_cost[0])])


def _step_of(arrays: list[Array]) -> FitStep:
    """Return the step with these arrays, of which the last one contains its numbers."""
    return FitStep._make([*arrays[:-1], *arrays[-1].tolist()])


def _fitted_of(arrays: list[Array]) -> Fitted:
    """Return the fit with these arrays."""
    last_step, level, inliers, outliers, model, final = arrays[-1].tolist()
    points = arrays[:POINT], arrays[POINT : 2 * POINT]
    step, (weights, variance, sound, _) = _step_of(arrays[2 * POINT : -4]), arrays[-4:]
    at = _point_of(points[int(model)])
    after = at if final == model else _point_of(points[int(final)])
    return Fitted(at, after, step, weights, variance, sound, last_step, level, int(inliers), outliers)


class _Layout:
    """Consecutive arrays in one piece of memory."""

    def __init__(self, *shapes: tuple[int, ...] | int) -> None:
        self._shapes = shapes
        self._ends = [0, *accumulate([one if isinstance(one, int) else math.prod(one) for one in shapes])]
        self._bytes = np.array(self._ends[:-1]) * np.dtype(np.float64).itemsize

    def new(self) -> tuple[Places, list[Array]]:
        """Return the addresses of new arrays, and the arrays."""
        at, memory = self.space()
        parts = zip([memory[slice(*each)] for each in pairwise(self._ends)], self._shapes, strict=True)
        return at, [one if isinstance(shape, int) else one.reshape(shape) for one, shape in parts]

    def space(self) -> tuple[Places, Array]:
        """Return the addresses of new arrays, and their memory."""
        memory = np.empty(self._ends[-1])
        return self._bytes + ctypes.addressof(address(memory)), memory
