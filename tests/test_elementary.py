"""Elementary functions and linear algebra of the estimator have the same bits on every machine."""

from __future__ import annotations

import ast
import math
import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import agent
from agent.estimation import elementary
from agent.estimation.smoother import Array, Singular

Matrix = list[list[float]]
NUMPY_ALONE = {
    *("linalg", "exp", "log", "log1p", "expm1", "log10", "log2", "power", "logaddexp", "hypot", "sinc"),
    *("cos", "sin", "tan", "arccos", "arcsin", "arctan", "arctan2", "tanh"),
    *("dot", "vdot", "inner", "matmul", "tensordot", "einsum", "convolve", "polyfit"),
}
"""The functions of numpy whose last bits differ between its versions, libraries or processors."""
TEXTS = {"smoother.py", "gauss_newton.py"}
"""The modules that no mission calls: the texts of the kernel."""

numbers = st.floats(-1e3, 1e3, allow_subnormal=False)
matrices = st.integers(1, 6).flatmap(
    lambda n: st.lists(st.lists(st.floats(-10.0, 10.0), min_size=n, max_size=n), min_size=n, max_size=n)
)


def test_the_estimator_and_active_sensing_call_no_function_of_numpy_whose_bits_differ() -> None:
    folder = Path(agent.__file__).parent
    modules = [*folder.glob("estimation/**/*.py"), *folder.glob("planning/*.py")]
    exact = {"separation.py", "phase3_last_manoeuvre.py"}  # of exact sensors, which the kernel does not serve
    found = [
        f"{module.name}: {ast.unparse(node)}"
        for module in modules
        if module.name not in TEXTS | exact
        for node in ast.walk(ast.parse(module.read_text()))
        if _differs(node)
    ]
    assert len(modules) > 60
    assert found == []


def _differs(node: ast.AST) -> bool:
    match node:
        case ast.BinOp(op=ast.MatMult()):
            return True
        case ast.Attribute(value=ast.Name("np"), attr=name):
            return name in NUMPY_ALONE
        case _:
            return False


@given(st.lists(numbers, min_size=1, max_size=9))
def test_each_function_is_that_of_the_c_library(values: list[float]) -> None:
    x = np.array(values)
    for name in ("exp", "cos", "sin", "tan"):
        of_each = [getattr(math, name)(min(value, 700.0)) for value in values]
        assert getattr(elementary, name)(np.minimum(x, 700.0)).tolist() == of_each
    assert elementary.log(np.abs(x) + 1.0).tolist() == [math.log(abs(value) + 1.0) for value in values]
    both = elementary.logaddexp(x, x[::-1])
    assert np.allclose(both, np.logaddexp(x, x[::-1]), rtol=1e-14)


@given(matrices, st.integers(1, 3), st.integers(0, 10**6))
def test_a_product_sums_in_the_order_of_the_columns(rows: Matrix, columns: int, seed: int) -> None:
    left = np.array(rows)
    right = np.random.default_rng(seed).normal(size=(2, len(rows), columns))
    found = elementary.product(left, right)
    for one, product in zip(right, found, strict=True):
        for a, row in enumerate(rows):
            for c in range(columns):
                total = 0.0
                for factor, other in zip(row, one[:, c].tolist(), strict=True):
                    total += factor * other
                assert product[a, c] == total
    assert np.array_equal(elementary.product(right.mT, left.T), found.mT)
    assert elementary.quadratic(left, left[0]) == pytest.approx(float(left[0] @ left @ left[0]))


@given(matrices)
def test_a_solution_is_that_of_exact_fractions(rows: Matrix) -> None:
    matrix, right = np.array(rows) + 40.0 * np.eye(len(rows)), np.arange(1.0, len(rows) + 1.0)[:, None]
    found = elementary.solve(matrix, right)
    exact = _solved([[Fraction(value) for value in row] for row in matrix.tolist()], right[:, 0].tolist())
    assert found[:, 0].tolist() == pytest.approx([float(value) for value in exact], rel=1e-10, abs=1e-12)
    several = elementary.solve(np.stack((matrix, matrix.T)), np.stack((right, right)))
    assert np.array_equal(several[0], found)
    assert np.allclose(elementary.inverted(matrix) @ matrix, np.eye(len(rows)), atol=1e-10)


def _solved(rows: list[list[Fraction]], right: list[float]) -> list[Fraction]:
    """Return the exact solution by Gauss-Jordan elimination."""
    augmented = [[*row, Fraction(value)] for row, value in zip(rows, right, strict=True)]
    for a in range(len(rows)):
        pivot = next(b for b in range(a, len(rows)) if augmented[b][a])
        augmented[a], augmented[pivot] = augmented[pivot], augmented[a]
        augmented[a] = [value / augmented[a][a] for value in augmented[a]]
        for b in range(len(rows)):
            if b != a:
                factor = augmented[b][a]
                augmented[b] = [x - factor * y for x, y in zip(augmented[b], augmented[a], strict=True)]
    return [row[-1] for row in augmented]


@pytest.mark.parametrize("matrix", [np.zeros((2, 2)), np.ones((3, 3)), np.array([[math.nan]])])
def test_a_singular_matrix_has_no_solution(matrix: Array) -> None:
    with pytest.raises(Singular):
        elementary.solve(matrix, np.ones((len(matrix), 1)))


@given(matrices)
def test_eigenvectors_make_the_matrix_again_and_are_orthogonal(rows: Matrix) -> None:
    matrix = np.array(rows) + np.array(rows).T
    values, vectors = elementary.eigh(matrix)
    size = max(float(np.max(np.abs(matrix))), 1e-12)
    assert np.allclose(vectors * values @ vectors.T, matrix, atol=1e-12 * size)
    assert np.allclose(vectors.T @ vectors, np.eye(len(rows)), atol=1e-12)
    assert np.all(np.diff(values) >= 0.0)
    assert np.allclose(values, np.linalg.eigvalsh(matrix), atol=1e-12 * size)


DECISIONS = """
import tandem
from tests.expected.playing import decisions
print(*[decisions(tandem.run("noisy", seed=seed).model) for seed in range(1, 5)])
"""


@pytest.mark.long
def test_noisy_missions_are_the_same_to_the_bit_with_the_linear_algebra_of_another_processor() -> None:
    def decided(**changed: str) -> str:
        command = [sys.executable, "-c", DECISIONS]
        ended = subprocess.run(
            command, env={**os.environ, **changed}, capture_output=True, text=True, check=True, timeout=120
        )
        return ended.stdout

    here = decided()
    assert len(here.split()) == 4
    assert decided(OPENBLAS_CORETYPE="Prescott") == here
    assert decided(NPY_DISABLE_CPU_FEATURES="X86_V4 X86_V3 AVX512_SKX AVX2 FMA3") == here
