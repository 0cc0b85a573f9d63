"""The settings of a run that are not part of its scenario: its name, and its speed in real time."""

from __future__ import annotations

import hashlib
import platform
import secrets
from pathlib import Path

from compose.errors import UserError
from world.scenario import Scenario

TICK_S = (5e-4, 3600.0)
"""The bounds in s of the wall time of a tick in real time."""


def run_name(scenario: Scenario, out: Path | None = None) -> str:
    """Return a unique name for a run of `scenario`.

    With `out`, the name follows from the host and that folder, so that a resumed run has its name again.
    """
    mark = secrets.token_hex(3)
    if out is not None:
        mark = hashlib.blake2s(f"{platform.node()}:{out.resolve()}".encode(), digest_size=3).hexdigest()
    return f"{scenario.name}-{mark}"


def check_rate(scenario: Scenario, rate: float | None) -> None:
    """Raise UserError if a tick at `rate` would last less or more than TICK_S permits."""
    shortest, longest = TICK_S
    if rate is not None and not shortest <= scenario.mission.period / rate <= longest:
        period = scenario.mission.period
        raise UserError(
            f"--rate: {rate:g} makes a tick of {period:g} s last {period / rate:g} s, "
            f"outside {shortest:g} to {longest:g} s"
        )
