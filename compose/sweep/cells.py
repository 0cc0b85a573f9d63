"""The cells of a sweep, and the seeds and scenarios of their trials."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import msgspec

from compose.errors import Unworkable
from compose.scenario.scenario_file import ScenarioTemplate, validate
from compose.sweep.field_paths import canonical, with_value
from compose.sweep.spec import Axis, Sweep


class Cell(msgspec.Struct, frozen=True):
    """One combination of values, one from each axis."""

    index: int
    """index of the cell within the sweep"""
    place: tuple[int, ...]
    """index of its value on each axis"""
    fields: dict[str, Any]
    """values of the varied fields, by their paths; None if a field is as in the base scenario"""
    key: str
    """canonical JSON text of the fields of unpaired axes, on which the seeds of its trials depend"""
    table: dict[str, Any]
    """parsed table of its scenario file"""

    def on_axes(self, axes: Sequence[Axis]) -> list[Any]:
        """Return its values in the columns of `axes`: the label, if an axis has some, and those of fields."""
        return [value for axis, i in zip(axes, self.place, strict=True) for value in axis.row(i)]

    @property
    def file_name(self) -> str:
        """The name of its scenario file."""
        return f"{self.index:03d}.toml"


def cells(sweep: Sweep) -> Iterator[Cell]:
    """Yield the cells of `sweep` in order; the last axis varies fastest."""
    places = product(*[range(len(axis.values)) for axis in sweep.axes])
    return (_cell(sweep, index, place) for index, place in enumerate(places))


def cell_at(sweep: Sweep, index: int) -> Cell | None:
    """Return the cell of `sweep` with that index, without those before it; None if there is none."""
    place: list[int] = []
    rest = index
    for axis in reversed(sweep.axes):
        if not axis.values:
            return None
        rest, i = divmod(rest, len(axis.values))
        place.insert(0, i)
    return _cell(sweep, index, tuple(place)) if rest == 0 else None


def _cell(sweep: Sweep, index: int, place: tuple[int, ...]) -> Cell:
    table = sweep.base
    fields: dict[str, Any] = {}
    unpaired: dict[str, Any] = {}
    for axis, i in zip(sweep.axes, place, strict=True):
        fields |= zip(axis.fields, axis.values[i], strict=True)
        for field, way, value in zip(axis.fields, axis.ways, axis.values[i], strict=True):
            if value is not None:
                table = with_value(table, way, value)
                if not axis.paired:
                    unpaired[field] = value
    return Cell(index, place, fields, canonical(unpaired), table)


def label(sweep: Sweep, cell: Cell) -> str:
    """Return the names and values of the axes at this cell, for people to read."""
    values = [f"{axis.name} = {axis.label(i)}" for axis, i in zip(sweep.axes, cell.place, strict=True)]
    return "; ".join(values) or "the only cell"


def setting_of(sweep: Sweep, cell: Cell) -> ScenarioTemplate:
    """Return the validated scenario of the cell.

    Raises Unworkable, whose text is the reason alone, if it is infeasible, and BadScenario if it is invalid.
    """
    source = f"{sweep.source}: cell {cell.index} ({label(sweep, cell)})"
    try:
        return validate(cell.table, source)
    except Unworkable as error:
        raise Unworkable(str(error).removeprefix(f"{source}: ")) from None


def trial_table(sweep: Sweep, cell: Cell, trial: int) -> dict[str, Any]:
    """Return the table of a trial's scenario file, with its seed and draws.

    Starts that the scenario leaves open are not in it; they follow from the seed.
    """
    seed = trial_seed(sweep.seed, cell.key, trial)
    return {**sweep.draws.table(cell.table, seed), "seed": seed}


def trial_seed(sweep_seed: int, key: str, trial: int) -> int:
    """Return the 63-bit seed of a trial's scenario. It depends on the arguments only."""
    digest = hashlib.sha256(f"{sweep_seed}/{key}/{trial}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1
