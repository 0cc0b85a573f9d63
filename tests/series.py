"""Series of test cases: the first few run by default, the rest with `pytest -m long`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def series(cases: Iterable[Any], short: int = 1) -> list[Any]:
    """Return `cases` for `parametrize` or `params` of a fixture, all but the first `short` marked as long."""
    listed = list(cases)
    return listed[:short] + [pytest.param(case, marks=pytest.mark.long) for case in listed[short:]]
