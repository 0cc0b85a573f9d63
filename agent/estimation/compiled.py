"""The compiled library of the estimator, made of the C sources beside it when Tandem is installed."""

from __future__ import annotations

import ctypes
import errno
import hashlib
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SOURCE_FILES = tuple([Path(__file__).with_name(name) for name in ("smoother.c", "elementary.c")])
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
            raise _no_kernel(f"it is of another {' or '.join([source.name for source in SOURCE_FILES])}")
    for name in ("walked", "guess", "weights_by_errors"):
        getattr(found, name).restype = None
    for name, numbers_and_arrays in ELEMENTARY.items():
        getattr(found, name).argtypes = [NUMBER if one == "n" else Pointer for one in numbers_and_arrays]
        getattr(found, name).restype = ctypes.c_int if name == "solutions" else None
    return found


NUMBER = ctypes.c_longlong
ELEMENTARY = {
    **dict.fromkeys([f"each_{name}" for name in ("exp", "log", "cos", "sin", "tan", "arccos")], "naa"),
    **dict.fromkeys(["each_arctan2", "each_logaddexp"], "naaa"),
    "products": "nnnnanana",
    "solutions": "nnnaa",
    "eigen": "naa",
}
"""The arguments of the functions of elementary.c: numbers (n) and addresses of arrays (a)."""


def _no_kernel(why: str) -> NoKernel:
    return NoKernel(errno.ENOEXEC, f"the estimator is not compiled: {why}; {REINSTALL}", str(LIBRARY_FILE))


def compiler() -> str:
    """Return the name and version of the compiler of the library. Raises NoKernel."""
    return str(library().compiler().decode()).strip()


def address(array: NDArray[np.float64]) -> Pointer:
    """Return the address of a contiguous array."""
    return Pointer(array.ctypes.data)
