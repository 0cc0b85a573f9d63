"""The Python API: run missions and sweeps, read recordings and estimate poses; data are numpy arrays.

>>> import tandem
>>> run = tandem.run("paper-1")
>>> run.outcome, run.ticks
('localised', 48)
>>> run.truth["x"].shape  # one row per tick and robot
(98,)

Errors in arguments are `UserError`; their text is the line that the command `tandem` prints. Nothing is
imported before it is used.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as in typing, which takes time to import
if TYPE_CHECKING:
    from typing import Any

    from compose.audit.findings import Findings as Findings
    from compose.audit.findings import Violation as Violation
    from compose.errors import BadFault as BadFault
    from compose.errors import BadKill as BadKill
    from compose.errors import BadScenario as BadScenario
    from compose.errors import BadSpec as BadSpec
    from compose.errors import NoSuchField as NoSuchField
    from compose.errors import NotToml as NotToml
    from compose.errors import Unworkable as Unworkable
    from compose.errors import UserError as UserError
    from compose.launch.supervisor import ChildFailed as ChildFailed
    from tandem.clash import ModuleClash as ModuleClash
    from tandem.columns import Table as Table
    from tandem.estimates import PoseEstimates as PoseEstimates
    from tandem.estimates import estimate as estimate
    from tandem.missions import run as run
    from tandem.results import Run as Run
    from tandem.results import open_recording
    from tandem.scenarios import Scenario as Scenario
    from tandem.sweeps import SweepIncomplete as SweepIncomplete
    from tandem.sweeps import SweepResults as SweepResults
    from tandem.sweeps import arena as arena
    from tandem.sweeps import sweep as sweep
    from tandem.worlds import World as World
    from tandem.worlds import parallel_env as parallel_env

    open = open_recording  # noqa: A001  # used as tandem.open

_PLACES = {
    "run": "tandem.missions:run",
    "open": "tandem.results:open_recording",
    "sweep": "tandem.sweeps:sweep",
    "arena": "tandem.sweeps:arena",
    "estimate": "tandem.estimates:estimate",
    "PoseEstimates": "tandem.estimates:PoseEstimates",
    "Run": "tandem.results:Run",
    "Scenario": "tandem.scenarios:Scenario",
    "SweepIncomplete": "tandem.sweeps:SweepIncomplete",
    "SweepResults": "tandem.sweeps:SweepResults",
    "Table": "tandem.columns:Table",
    "World": "tandem.worlds:World",
    "parallel_env": "tandem.worlds:parallel_env",
    "Findings": "compose.audit.findings:Findings",
    "Violation": "compose.audit.findings:Violation",
    "ModuleClash": "tandem.clash:ModuleClash",
    "ChildFailed": "compose.launch.supervisor:ChildFailed",
    **{
        error: f"compose.errors:{error}"
        for error in (
            "BadFault",
            "BadKill",
            "BadScenario",
            "BadSpec",
            "NoSuchField",
            "NotToml",
            "Unworkable",
            "UserError",
        )
    },
}
"""The module and the name there of each public name that is imported when it is first used."""
__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    """Import and return a public name. Raises ModuleClash, and AttributeError if there is no such name."""
    if name not in _PLACES:
        raise AttributeError(f"module 'tandem' has no attribute '{name}'")
    from importlib import import_module  # noqa: PLC0415  # `tandem --help` starts without it

    from tandem.clash import check  # noqa: PLC0415

    check()
    module, _, there = _PLACES[name].partition(":")
    value = getattr(import_module(module), there)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
