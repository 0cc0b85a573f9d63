"""The cells of a sweep, and the seed of every trial in them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import product
from typing import Any

import msgspec

from compose.errors import Unworkable
from compose.scenario.scenario_file import ScenarioTemplate, validate
from compose.sweep.field_paths import canonical, with_value
from compose.sweep.spec import Sweep


class Cell(msgspec.Struct, frozen=True):
    """One choice of a value on each axis."""

    index: int
    place: tuple[int, ...]
    """of its value on each axis"""
    fields: dict[str, Any]
    """each varied field's value, by its path"""
    key: str
    """what the seeds of its trials depend on: its fields, but for those of paired axes"""
    table: dict[str, Any]
    """of the scenario's file"""

    @property
    def file_name(self) -> str:
        """Of its scenario."""
        return f"{self.index:03d}.toml"


class RefusedCell(msgspec.Struct, frozen=True):
    """A cell in whose setting no mission can be played."""

    reason: str


def cells(sweep: Sweep) -> Iterator[Cell]:
    """All of them, in order: the last axis varies fastest."""
    for index, place in enumerate(product(*[range(len(axis.values)) for axis in sweep.axes])):
        table = sweep.base
        fields: dict[str, Any] = {}
        unpaired: dict[str, Any] = {}
        for axis, i in zip(sweep.axes, place, strict=True):
            for field, way, value in zip(axis.fields, axis.ways, axis.values[i], strict=True):
                table = with_value(table, way, value)
                fields[field] = value
                if not axis.paired:
                    unpaired[field] = value
        yield Cell(index, place, fields, canonical(unpaired), table)


def label(sweep: Sweep, cell: Cell) -> str:
    """The cell's values, in words."""
    said = [f"{axis.name} = {axis.label(i)}" for axis, i in zip(sweep.axes, cell.place, strict=True)]
    return "; ".join(said) or "the only one"


def setting_of(sweep: Sweep, cell: Cell) -> ScenarioTemplate | RefusedCell:
    """The cell's scenario, validated. Raises BadScenario where the user is mistaken in one of its fields."""
    source = f"{sweep.source}: cell {cell.index} ({label(sweep, cell)})"
    try:
        return validate(cell.table, source)
    except Unworkable as error:
        return RefusedCell(str(error).removeprefix(f"{source}: "))


def trial_table(sweep: Sweep, cell: Cell, trial: int) -> dict[str, Any]:
    """Return the table of a trial's scenario file, complete but for starts that follow from its seed."""
    seed = trial_seed(sweep.seed, cell.key, trial)
    return {**sweep.draws.table(cell.table, seed), "seed": seed}


def trial_seed(sweep_seed: int, key: str, trial: int) -> int:
    """The seed of a trial's scenario: of 63 bits, whoever plays it and whatever else is played."""
    digest = hashlib.sha256(f"{sweep_seed}/{key}/{trial}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1
