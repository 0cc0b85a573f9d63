"""The kernel of the estimator: `smoother.c`, which is compiled when Tandem is installed, called by ctypes.

Its functions are those of `smoother`, and equal to the bit.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
from functools import cache
from pathlib import Path

import numpy as np

from agent.estimation.smoother import Array, FitStep, Measured, Singular, Walk

KERNEL_SOURCE = Path(__file__).with_name("smoother.c")
KERNEL = Path(__file__).with_name("libsmoother.so")
REINSTALL = "install Tandem again (in a clone: uv sync --reinstall-package tandem-ranging)"
Pointer = ctypes.c_void_p


class _Measured(ctypes.Structure):
    """`Measured` of smoother.c."""

    _fields_ = [
        *[(name, ctypes.c_longlong) for name in ("robots", "ticks", "ranges", "common", "constant")],
        *[(name, ctypes.c_longlong) for name in ("anchors", "radios", "scaled", "delayed")],
        *[(name, ctypes.c_double) for name in ("period", "survey", "slow", "decay", "scale")],
        *[(name, Pointer) for name in ("v", "omega", "slip", "white", "patterns", "place", "rho", "effects")],
        *[(name, Pointer) for name in ("mean", "information", "pivot")],
        *[(name, Pointer) for name in ("begin", "first", "second", "anchor", "radio")],
    ]


class NoKernel(OSError):
    """The file of the kernel cannot be loaded, or is not compiled from the present source."""


@cache
def library() -> ctypes.CDLL:
    """Return the compiled kernel. Raises NoKernel."""
    try:
        found = ctypes.CDLL(str(KERNEL))
        found.source.restype = found.compiler.restype = ctypes.c_char_p
    except (OSError, AttributeError) as error:  # AttributeError: another library
        raise _no_kernel(str(error).removeprefix(f"{KERNEL}: ")) from error
    text = KERNEL_SOURCE.read_bytes() if KERNEL_SOURCE.exists() else None
    if text is not None and found.source() != hashlib.sha256(text).hexdigest().encode():
        raise _no_kernel(f"it is of another {KERNEL_SOURCE.name}")
    found.walked.restype = None
    found.loosened.restype = found.step.restype = ctypes.c_int
    return found


def _no_kernel(why: str) -> NoKernel:
    return NoKernel(errno.ENOEXEC, f"the estimator is not compiled: {why}; {REINSTALL}", str(KERNEL))


def compiler() -> str:
    """Return the name and version of the compiler of the kernel. Raises NoKernel."""
    return str(library().compiler().decode()).strip()


class Kernel:
    """The functions of `smoother` for the measurements of a fit, with a workspace for them."""

    def __init__(self, of: Measured) -> None:
        """Prepare the workspace."""
        self.of = of = Measured._make(
            [np.ascontiguousarray(one) if isinstance(one, np.ndarray) else one for one in of]
        )
        n, k, count = of.robots, of.ticks, len(of.rho)
        size, s, n3 = of.size, 3 * n + of.radios, 3 * n
        q = size + 2 * of.anchors
        self._measured = _Measured(
            *(n, k, count, of.common.shape[1], of.patterns.shape[1], of.anchors),
            *(of.radios, of.scaled, of.delayed),
            *(of.period, of.survey, of.slow, of.decay, of.scale),
            *[
                one.ctypes.data
                for one in (
                    *(of.v, of.omega, of.slip, of.white, of.patterns, of.place, of.rho, of.common, of.mean),
                    *(of.information, of.pivot, of.begin, of.first, of.second, of.anchor, of.radio),
                )
            ],
        )
        vectors = (count, count, count * q, count * s, s, s * q, s * s, q * q, q)
        spaces = (s, s * size, s * s, s, size, size * size, max(size, n3) ** 2, *[max(q, of.radios)] * 2)
        self._work, self._spaces = _pointers(*vectors, *spaces)

    def walked(self, poses: Array, constants: Array, white: Array) -> Walk:
        """Return the paths; see `smoother.walked`."""
        n, k, count = self.of.robots, self.of.ticks, len(self.of.rho)
        shapes = ((n, k + 1, 3), (n, k, 8), (count, 2), count, count)
        walk = Walk._make([np.empty(shape) for shape in shapes])
        library().walked(
            ctypes.byref(self._measured), *map(_at, (poses, constants, white)), _addresses(*walk)
        )
        return walk

    def loosened(self, walk: Walk, poses: Array, variance: Array) -> Array:
        """Return the variances of the ranges before any fit; see `smoother.loosened`. Raises Singular."""
        found = np.empty(len(self.of.rho))
        given = (ctypes.byref(self._measured), _addresses(*walk), _at(poses), _at(variance))
        if not library().loosened(*given, self._work, _at(found)):
            raise Singular("the errors of the odometry are too large for a float")
        return found

    def step(self, walk: Walk, poses: Array, variance: Array, ridge: float, largest: float) -> FitStep:
        """Return a Gauss-Newton step; see `smoother.step`. Raises Singular."""
        n, k, count, size = self.of.robots, self.of.ticks, len(self.of.rho), self.of.size
        shapes = (size, size, (size, size), (n, 2, k), *[count] * 5, (3 * n, 3 * n), 3)
        *found, numbers = [np.empty(shape) for shape in shapes]
        if not library().step(
            *(ctypes.byref(self._measured), _addresses(*walk), _at(poses), _at(variance)),
            *(ctypes.c_double(ridge), ctypes.c_double(largest), self._work, _addresses(*found, numbers)),
        ):
            raise Singular("the ranges do not determine all unknowns")
        return FitStep._make([*found, *numbers.tolist()])


def _at(array: Array) -> Pointer:
    """Return the address of a contiguous array."""
    return Pointer(array.ctypes.data)


def _addresses(*arrays: Array) -> ctypes.Array[Pointer]:
    return (Pointer * len(arrays))(*[one.ctypes.data for one in arrays])


def _pointers(*sizes: int) -> tuple[ctypes.Array[Pointer], Array]:
    """Return the addresses of consecutive arrays of these sizes, and the memory that contains them."""
    memory = np.empty(sum(sizes))
    begin = np.cumsum([0, *sizes[:-1]]) * memory.itemsize + memory.ctypes.data
    return (Pointer * len(sizes))(*begin.tolist()), memory
