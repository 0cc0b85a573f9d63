# ruff: noqa: ARG002
"""Range and radio models of a user."""

from __future__ import annotations

import sys

from tandem.models import RadioModel, Radios, RangeModel, Transmission


class Late(RadioModel[int]):
    """Every third report of a link is lost, and the others are late by a tick."""

    def __init__(self, every: int = 3) -> None:
        if every < 2:
            raise ValueError("every is at least 2")
        self.every = every

    def start(self) -> int:
        return 0

    def sent(self, state: int | None, transmission: Transmission) -> tuple[int, int | None]:
        count = (state or 0) + 1
        return count, None if count % self.every == 0 else 1


class Long(RangeModel):
    """Ranges are too long by one part in a thousand, and some are not measured."""

    def measured(self, radios: Radios, rho: float) -> float | None:
        return None if radios.uniform("missing") < 0.1 else 1.001 * rho


class Failing(RadioModel[int]):
    """It raises an error with the first report."""

    def sent(self, state: int | None, transmission: Transmission) -> tuple[int, int | None]:
        raise KeyError("first")


class Exiting(RangeModel):
    """It ends the process with the first range."""

    def measured(self, radios: Radios, rho: float) -> float | None:
        sys.exit(4)
