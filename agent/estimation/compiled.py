"""The compiled library of the estimator, made of the C sources beside it when Tandem is installed."""

from __future__ import annotations

import ctypes
import errno
import hashlib
from functools import cache
from pathlib import Path
from typing import Any

SOURCE_FILES = tuple(
    [Path(__file__).with_name(f"{name}.c") for name in ("smoother", "elementary", "hypotheses")]
)
LIBRARY_FILE = Path(__file__).with_name("libsmoother.so")
REINSTALL = "install Tandem again (in a clone: uv sync --reinstall-package tandem-ranging)"
Pointer = ctypes.c_void_p


class NoKernel(OSError):
    """The library cannot be loaded, or is not compiled from the present sources."""


@cache
def library() -> ctypes.CDLL:
    """Return the compiled library. Raises NoKernel."""
    try:
        found = ctypes.CDLL(str(LIBRARY_FILE))
        found.source.restype = found.compiler.restype = ctypes.c_char_p
    except (OSError, AttributeError) as error:  # AttributeError: another library
        raise _no_kernel(str(error).removeprefix(f"{LIBRARY_FILE}: ")) from error
    if all(source.exists() for source in SOURCE_FILES):
        text = b"".join([source.read_bytes() for source in SOURCE_FILES])
        if found.source() != hashlib.sha256(text).hexdigest().encode():
            raise _no_kernel(f"one of {', '.join([source.name for source in SOURCE_FILES])} is another")
    for name in ("prepared", "paths", "guess", "weights_by_errors"):
        getattr(found, name).restype = None
    for name, (result, arguments) in SIGNATURES.items():
        getattr(found, name).argtypes = [TYPES[one] for one in arguments]
        getattr(found, name).restype = result
    for name in ALLOCATING:
        getattr(found, name).errcheck = _allocated
    return found


def _allocated(code: int, *_: object) -> int:
    """Return what a function of C has returned. Raises MemoryError if it got no memory."""
    if code == NO_MEMORY:
        raise MemoryError("the estimator got no memory")
    return code


TYPES = {"n": ctypes.c_longlong, "d": ctypes.c_double, "a": Pointer}
SIGNATURES = {
    **{f"each_{name}": (None, "naa") for name in ("exp", "log", "cos", "sin", "tan")},
    "each_logaddexp": (None, "naaa"),
    "products": (None, "nnnnanana"),
    "solutions": (ctypes.c_int, "nnnaa"),
    "eigen": (None, "naa"),
    "anchor_guesses": (TYPES["n"], "naaaaanaannadddna"),
    "tracked": (None, "nndaaaaaa"),
    "position_variances": (None, "ndaaaaanaa"),
    "no_detection": (TYPES["d"], "naddn"),
    "detections": (ctypes.c_int, "anaannaaadana"),
    "same_poses": (None, "naaadda"),
    "placements": (TYPES["n"], "nnaaaaaaaaaaanannaaddndddna"),
    "second_order": (None, "aaa"),
    "own_costs": (None, "annaanaaaaa"),
    "joint_costs": (ctypes.c_int, "annaannnaaaaa"),
}
"""The results and the arguments of the functions of C: numbers (n), floats (d), addresses of arrays (a)."""
ALLOCATING = ("anchor_guesses", "detections", "fitted", "gauss_newton_step", "placements")
"""The functions of C that take memory, and return NO_MEMORY if there is none."""
NO_MEMORY = -2


def _no_kernel(why: str) -> NoKernel:
    return NoKernel(errno.ENOEXEC, f"the estimator is not compiled: {why}; {REINSTALL}", str(LIBRARY_FILE))


def compiler() -> str:
    """Return the name and version of the compiler of the library. Raises NoKernel."""
    return str(library().compiler().decode()).strip()


_memory_of = (ctypes.c_char * 0).from_buffer


def address(array: Any) -> ctypes.Array[ctypes.c_char]:
    """Return the memory of a contiguous array as an argument, or of a copy: `array.ctypes` is slow."""
    try:
        return _memory_of(array)
    except TypeError:  # it is read-only, or not contiguous
        return _memory_of(array.copy())
