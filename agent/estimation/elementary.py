"""Elementary functions of arrays, and linear algebra of small matrices, with the same bits on every machine.

Those of numpy differ between its versions, its linear-algebra libraries and processors in the last bits, and
a decision may depend on them. These call the C library for each element (`elementary.c`); sums, products and
square roots are exactly rounded in numpy, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from agent.estimation.compiled import address, library
from agent.estimation.smoother import Array, Singular


def _of_each(name: str) -> Callable[[Array], Array]:
    """Return the C function `name` of each element of an array."""

    def function(x: Array) -> Array:
        x = np.ascontiguousarray(x, np.float64)
        to = np.empty(x.shape)
        getattr(library(), f"each_{name}")(x.size, address(x), address(to))
        return to

    return function


exp, log = _of_each("exp"), _of_each("log")
"""The exponential and the natural logarithm of each element."""

cos, sin, tan = _of_each("cos"), _of_each("sin"), _of_each("tan")
"""The cosine, the sine and the tangent of each element (rad)."""


def logaddexp(one: Array, other: Array) -> Array:
    """Return log(exp(one) + exp(other)) for each element of two arrays of one shape."""
    one, other = np.ascontiguousarray(one, np.float64), np.ascontiguousarray(other, np.float64)
    to = np.empty(one.shape)
    library().each_logaddexp(one.size, address(one), address(other), address(to))
    return to


def hypot(x: Array | float, y: Array | float) -> Array:
    """Return the length of each vector (x, y), whose square has to fit into a float."""
    return np.asarray(np.sqrt(np.square(x) + np.square(y)), np.float64)


def product(left: Array, right: Array) -> Array:
    """Return the matrix products of (..., p, q) and (..., q, r), in which one may have no further axes."""
    left, right = np.ascontiguousarray(left, np.float64), np.ascontiguousarray(right, np.float64)
    leading = left.shape[:-2] or right.shape[:-2]
    assert right.shape[:-2] in ((), leading)
    (p, q), r = left.shape[-2:], right.shape[-1]
    assert right.shape[-2] == q
    to = np.empty((*leading, p, r))
    with_steps = (address(left), p * q * (left.ndim > 2), address(right), q * r * (right.ndim > 2))
    library().products(math.prod(leading), p, q, r, *with_steps, address(to))
    return to


def summed(factors: Array, arrays: Array) -> Array:
    """Return the sum of `arrays`, (n, ...), each multiplied by its element of `factors`, (n,)."""
    to = product(factors[None], arrays.reshape(len(factors), math.prod(arrays.shape[1:])))
    return to.reshape(arrays.shape[1:])


def quadratic(matrix: Array, vector: Array) -> float:
    """Return vector' matrix vector, of shapes (n, n) and (n,)."""
    return dot(vector, product(matrix, vector[:, None])[:, 0])


def dot(one: Array, other: Array) -> float:
    """Return the scalar product of two vectors."""
    return float(np.add.reduce(one * other))


def solve(matrix: Array, right: Array) -> Array:
    """Return the solutions x of matrix x = right, of shapes (..., n, n) and (..., n, m). Raises Singular."""
    matrix, found = np.array(matrix, np.float64, order="C"), np.array(right, np.float64, order="C")
    count, size, columns = math.prod(matrix.shape[:-2]), matrix.shape[-1], found.shape[-1]
    assert found.shape[:-1] == matrix.shape[:-1]
    if not library().solutions(count, size, columns, address(matrix), address(found)):
        raise Singular("a matrix is singular")
    return found


def inverted(matrix: Array) -> Array:
    """Return the inverses of matrices, (..., n, n). Raises Singular."""
    return solve(matrix, np.broadcast_to(np.eye(matrix.shape[-1]), matrix.shape))


def eigh(matrix: Array) -> tuple[Array, Array]:
    """Return the eigenvalues of a symmetric matrix, ascending, and its eigenvectors as columns."""
    diagonal, vectors = np.array(matrix, np.float64, order="C"), np.empty(matrix.shape)
    library().eigen(len(diagonal), address(diagonal), address(vectors))
    values = np.diagonal(diagonal)
    order = np.argsort(values, kind="stable")
    return values[order], vectors[:, order]
