"""The kernel of the estimator: `smoother.c`, which is compiled when Tandem is installed, called by ctypes.

Its functions are those of `smoother` and `gauss_newton`, and equal to the bit.
"""

from __future__ import annotations

import ctypes

import numpy as np

from agent.estimation.compiled import Pointer, address, library
from agent.estimation.gauss_newton import Convergence, Fitted, Point
from agent.estimation.gaussian.range_weights import Weighing
from agent.estimation.smoother import NO_DEPTH, Array, Deep, FitStep, Measured, Singular, Walk


class _Measured(ctypes.Structure):
    """`Measured` of smoother.c."""

    _fields_ = [
        *[(name, ctypes.c_longlong) for name in ("robots", "ticks", "ranges", "common", "constant")],
        *[(name, ctypes.c_longlong) for name in ("anchors", "radios", "scaled", "delayed", "deep", "strays")],
        *[(name, ctypes.c_double) for name in ("period", "survey", "slow", "decay", "scale")],
        *[(name, Pointer) for name in ("v", "omega", "slip", "white", "stray", "patterns", "place", "rho")],
        *[(name, Pointer) for name in ("effects", "mean", "information", "pivot")],
        *[(name, Pointer) for name in ("begin", "first", "second", "observer", "anchor", "radio")],
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
    """The functions of `smoother` and `gauss_newton` for the measurements of a fit."""

    def __init__(self, of: Measured, by: Weighing) -> None:
        """Give the kernel the measurements, of which it has a copy."""
        self.of, self.by = of, by
        n, k, count, c, m = of.robots, of.ticks, len(of.rho), of.common.shape[1], of.patterns.shape[1]
        floats = (
            *(of.v, of.omega, of.slip, of.white, of.stray, of.patterns, of.place, of.rho, of.common),
            *(of.mean, of.information, of.pivot, by.sigma),
        )
        numbers = (of.begin, of.first, of.second, of.observer, of.anchor, of.radio, by.holding, by.by_radio)
        self._floats, self._numbers = np.concatenate([one.ravel() for one in floats]), np.concatenate(numbers)
        measured = _Measured(
            *(n, k, count, c, m, of.anchors, of.radios, of.scaled, of.delayed, of.deep, of.strays),
            *(of.period, of.survey, of.slow, of.decay, of.scale),
        )
        weighing = _Weighing(
            *(by.longest, by.inlier, by.outlier, by.stray, by.least, by.most, by.degrees),
            *(by.astray, by.astray_ratio, by.free, by.robust, by.noisy),
        )
        self._measured, self._weighing = ctypes.byref(measured), ctypes.byref(weighing)
        ends = np.empty(2 * POINT_ARRAYS + STEP_ARRAYS + 4, np.intp)
        memory = map(address, (self._floats, self._numbers, ends))
        library().prepared(self._measured, self._weighing, *memory)
        self._ends = [0, *ends.tolist()]
        size, ticks = of.size, k * of.strays
        point = ((2, (n, m)), (3, (n, 2, k)), (WALK, (n, k + 1, 3)), (7, (n, k, 8)), (8, (count, 2)))
        step = ((2, (size, size)), (3, (n, 2, k)), (9, (3 * n, 3 * n)), (10, (n, ticks, 5)), (14, (n, ticks)))
        of_points = [(i + begin, shape) for begin in (0, POINT_ARRAYS) for i, shape in point]
        self._shapes = dict[int, tuple[int, ...]](
            of_points + [(i + 2 * POINT_ARRAYS, shape) for i, shape in step]
        )

    def __reduce__(self) -> tuple[type[Kernel], tuple[Measured, Weighing]]:
        """Return how to build the kernel again from a copy, which has memory of its own."""
        return Kernel, (self.of, self.by)

    def walked(self, poses: Array, constants: Array, white: Array, deep: Deep = NO_DEPTH) -> Walk:
        """Return the paths; see `smoother.walked`."""
        arrays, memory = self._part(WALK, WALK + len(Walk._fields))
        given = map(address, (poses, constants, white, np.array(deep, np.float64), memory))
        library().paths(self._measured, *given)
        return Walk._make(arrays)

    def step(self, walk: Walk, poses: Array, variance: Array, ridge: float, largest: float) -> FitStep:
        """Return a Gauss-Newton step; see `smoother.step`. Raises Singular."""
        arrays, memory = self._part(2 * POINT_ARRAYS, 2 * POINT_ARRAYS + STEP_ARRAYS)
        from_walk = np.concatenate([one.ravel() for one in walk])
        if not library().gauss_newton_step(
            *(self._measured, address(from_walk), address(poses), address(variance)),
            *(ctypes.c_double(ridge), ctypes.c_double(largest), address(memory)),
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
        ends, memory = self._ends, np.empty(self._ends[-1])
        memory[: ends[WALK]] = 0.0
        memory[: ends[1]], memory[ends[2] : ends[3]] = poses, constant.ravel()
        memory[ends[3] : ends[4]] = white.ravel()
        if weights is not None:
            memory[ends[-5] : ends[-4]] = weights
        end = ctypes.byref(_Convergence(*until))
        if not library().fitted(
            self._measured, self._weighing, end, ctypes.c_int(weights is not None), address(memory)
        ):
            raise Singular("the ranges do not determine all unknowns, or an error is too large for a float")
        last_step, level, inliers, outliers, model, final = memory[ends[-2] :].tolist()
        at = self._point(memory, int(model))
        after = at if final == model else self._point(memory, int(final))
        *of_step, weights, variance, sound, _ = self._arrays(memory, 2 * POINT_ARRAYS, len(ends) - 1)
        of_fit = (weights, variance, sound, last_step, level, int(inliers), outliers)
        return Fitted(at, after, _step_of(of_step), *of_fit)

    def held(self, poses: Array, constant: Array, white: Array, weights: Array, steps: int) -> Fitted:
        """Return the fit in which a range holds a coordinate; see `gauss_newton.held`. Raises Singular."""
        return self.fitted(poses, constant, white, weights, Convergence(steps, HOLDING))

    def _point(self, memory: Array, number: int) -> Point:
        """Return the first or the second point of a fit."""
        arrays = self._arrays(memory, number * POINT_ARRAYS, (number + 1) * POINT_ARRAYS)
        *walk, own, prior_cost = arrays[WALK:]
        return Point._make([*arrays[:WALK], Walk._make(walk), own, float(prior_cost[0])])

    def _part(self, begin: int, end: int) -> tuple[list[Array], Array]:
        """Return new arrays, those from `begin` to `end` of a fit, and their memory."""
        memory = np.empty(self._ends[end] - self._ends[begin])
        return self._arrays(memory, begin, end, self._ends[begin]), memory

    def _arrays(self, memory: Array, begin: int, end: int, before: int = 0) -> list[Array]:
        """Return the arrays from `begin` to `end` of a fit, whose first elements `memory` may lack."""
        ends = self._ends
        found = [memory[ends[i] - before : ends[i + 1] - before] for i in range(begin, end)]
        for i, shape in self._shapes.items():
            if begin <= i < end:
                found[i - begin] = found[i - begin].reshape(shape)
        return found


WALK = 6
"""The place of the walk among the arrays of a point."""

POINT_ARRAYS = WALK + len(Walk._fields) + 2
"""The number of arrays of a point."""

STEP_ARRAYS = FitStep._fields.index("shocks") + 2
"""The number of arrays of a step, of which the last one contains its numbers."""

HOLDING = -1.0
"""The `Convergence.shortest` of a fit in which a range holds a coordinate."""


def _step_of(arrays: list[Array]) -> FitStep:
    """Return the step with these arrays."""
    return FitStep._make([*arrays[:-1], *arrays[-1].tolist()])
