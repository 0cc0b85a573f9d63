"""A sweep's TOML file -> a validated sweep, or one line that names the file and the field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from compose.errors import BadSpec, NoSuchField, NotToml
from compose.scenario import scenario_file
from compose.scenario.toml_file import field_first, read_text, table_in
from compose.sweep.draws import Draw, Draws, DrawTable, StartsTable
from compose.sweep.field_paths import Steps, canonical, jsonable, steps, value_at, with_value
from protocol.units import NAME

MAX_TRIALS = 10**7
"""per cell"""
MAX_CELLS = 10_000
TRIAL_TIMEOUT_S = 60.0
Label = Annotated[str, Meta(min_length=1, max_length=60)]


class AxisTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[axis]]: one `field` and its values; or `name` and `fields`, which vary together."""

    values: Annotated[list[Any], Meta(min_length=1)]
    field: str | None = None
    fields: Annotated[list[str], Meta(min_length=1)] | None = None
    name: Annotated[str, Meta(pattern=NAME, max_length=48)] | None = None
    labels: list[Label] | None = None
    """what to call each value in tables and figures"""
    paired: bool = False
    """left out of the trials' seeds: all its values face the same draws"""


class SpecFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a sweep's file may say."""

    name: Annotated[str, Meta(pattern=NAME, max_length=48)]
    scenario: str
    """a name that ships, or a file, relative to this one"""
    trials: Annotated[int, Meta(ge=1, le=MAX_TRIALS)]
    """per cell"""
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    trial_timeout: Annotated[float, Meta(gt=0.0, le=1e6)] = TRIAL_TIMEOUT_S
    """s of wall time, after which a trial counts as hung"""
    axis: list[AxisTable] = []
    draw: list[DrawTable] = []
    """fields that every trial draws anew, in this order"""
    starts: StartsTable | None = None
    """kinds of start that every trial draws from"""


class Axis(msgspec.Struct, frozen=True):
    """Fields of the scenario that vary together, and their values."""

    name: str
    """the field, if it is only one"""
    fields: tuple[str, ...]
    ways: tuple[Steps, ...]
    """to each of the fields"""
    values: tuple[tuple[Any, ...], ...]
    """of each of the fields, a tuple for each value of the axis"""
    labels: tuple[str, ...] | None
    paired: bool

    def label(self, place: int) -> str:
        """What to call a value of it."""
        if self.labels is not None:
            return self.labels[place]
        said = [value if isinstance(value, str) else canonical(value) for value in self.values[place]]
        if len(said) == 1:
            return said[0]
        return ", ".join(f"{field}={value}" for field, value in zip(self.fields, said, strict=True))


class Sweep(msgspec.Struct, frozen=True):
    """A sweep, complete: what each trial is follows from it."""

    source: str
    """the spec, as the user calls it"""
    name: str
    base: dict[str, Any]
    """the table of the scenario's file"""
    axes: tuple[Axis, ...]
    trials: int
    """per cell"""
    seed: int
    trial_timeout: float
    """s"""
    draws: Draws = Draws()
    """what each trial draws beside the starts that the scenario leaves open"""


def shipped() -> dict[str, Path]:
    """The sweeps that come with Tandem, by name."""
    return scenario_file.shipped("sweep")


def load(source: str, *, trials: int | None = None, seed: int | None = None) -> Sweep:
    """The sweep of that name, or in the file at that path; `trials` and `seed` override its own.

    Raises BadSpec, and NotToml where it is not TOML.
    """
    path = shipped().get(source, Path(source))
    try:
        table = table_in(read_text(path), source)
        spec = msgspec.convert(table, SpecFile)
    except FileNotFoundError:
        raise BadSpec(scenario_file.unknown(source, "sweep")) from None
    except msgspec.ValidationError as error:
        raise BadSpec(f"{source}: {field_first(str(error), {})}") from None
    except ValueError as error:
        raise BadSpec(f"{source}: {error}") from None
    base = _base(spec, path, source)
    axes = tuple(_axis(axis, f"{source}: axis[{i}]", base) for i, axis in enumerate(spec.axis))
    draws = Draws(_draws(spec, axes, base, source), spec.starts)
    _check_together(axes, draws, source)
    return Sweep(
        source=source,
        name=spec.name,
        base=base,
        axes=axes,
        trials=trials if trials is not None else spec.trials,
        seed=seed if seed is not None else spec.seed,
        trial_timeout=spec.trial_timeout,
        draws=draws,
    )


def _base(spec: SpecFile, path: Path, source: str) -> dict[str, Any]:
    """The table of the scenario that `spec` varies."""
    file = scenario_file.shipped().get(spec.scenario, path.parent / spec.scenario)
    try:
        return table_in(read_text(file), spec.scenario)
    except FileNotFoundError:
        names = ", ".join(scenario_file.shipped())
        raise BadSpec(
            f"{source}: scenario: '{spec.scenario}' is neither a file beside it nor a scenario that ships "
            f"({names})"
        ) from None
    except (ValueError, NotToml) as error:
        raise BadSpec(f"{source}: scenario: {error}") from None


def _axis(table: AxisTable, where: str, base: dict[str, Any]) -> Axis:
    fields = _fields(table, where)
    ways = []
    for i, field in enumerate(fields):
        named = f"{where}.fields[{i}]" if table.fields is not None else f"{where}.field"
        try:
            ways.append(steps(field, base))
        except NoSuchField as error:
            raise BadSpec(f"{named}: '{field}': {error}") from None
    seen: dict[str, int] = {}
    values = []
    for i, value in enumerate(table.values):
        values.append(_value(value, f"{where}.values[{i}]", table.fields))
        if (first := seen.setdefault(canonical(value), i)) != i:
            raise BadSpec(f"{where}.values[{i}]: the same as values[{first}]")
    if table.labels is not None and not len(table.labels) == len(set(table.labels)) == len(values):
        raise BadSpec(f"{where}.labels: not {len(values)} different ones, one for each of the values")
    return Axis(
        name=table.name if table.name is not None else fields[0],
        fields=tuple(fields),
        ways=tuple(ways),
        values=tuple(values),
        labels=tuple(table.labels) if table.labels is not None else None,
        paired=table.paired,
    )


def _fields(table: AxisTable, where: str) -> list[str]:
    """What the axis varies. Raises BadSpec where that, or what to call it, is not said."""
    if (table.field is None) == (table.fields is None):
        raise BadSpec(f"{where}: names one 'field', or a 'name' and the 'fields' that vary together")
    fields = table.fields if table.fields is not None else [str(table.field)]
    if table.name is None and table.fields is not None:
        raise BadSpec(f"{where}.name: missing: what to call {', '.join(fields)} together")
    if table.name is None and table.labels is not None:
        raise BadSpec(f"{where}.name: missing: the labels are a column of their own")
    if table.name in fields:
        raise BadSpec(f"{where}.name: '{table.name}' is one of its fields")
    return fields


def _value(value: Any, where: str, fields: Sequence[str] | None) -> tuple[Any, ...]:
    if not jsonable(value):
        raise BadSpec(f"{where}: not a number, a text, true or false, or a list or table of these")
    if fields is None:
        return (value,)
    if not isinstance(value, list) or len(value) != len(fields):
        raise BadSpec(f"{where}: not a list of {len(fields)} values, one for each of the fields")
    return tuple(value)


def _draws(spec: SpecFile, axes: Sequence[Axis], base: dict[str, Any], source: str) -> tuple[Draw, ...]:
    """Return the fields that every trial draws. Raises BadSpec."""
    known: dict[Steps, tuple[Any, ...]] = {
        way: tuple(value[i] for value in axis.values) for axis in axes for i, way in enumerate(axis.ways)
    }
    draws: list[Draw] = []
    for i, table in enumerate(spec.draw):
        where = f"{source}: draw[{i}]"
        if (table.uniform is None) == (table.log_uniform is None):
            raise BadSpec(f"{where}: has one of 'uniform' and 'log_uniform'")
        interval = table.uniform or table.log_uniform
        assert interval is not None
        low, high = interval
        if not low < high or not math.isfinite(high - low) or (table.log_uniform is not None and low <= 0.0):
            above = " above 0" if table.log_uniform is not None else ""
            raise BadSpec(f"{where}: from {low:g} to {high:g} is no interval{above}")
        if table.log_uniform is not None and not math.isfinite(high / low):
            raise BadSpec(f"{where}: from {low:g} to {high:g} is too wide")
        (way,) = _numbers([table.field], f"{where}.field", base)
        _check_takes_float(table.field, way, low, base, f"{where}.field")
        draws.append(
            Draw(
                table.field,
                way,
                interval,
                table.log_uniform is not None,
                _known(table.times, f"{where}.times", base, known),
                _known(table.over, f"{where}.over", base, known, zero=False),
            )
        )
        known[way] = ()
    return tuple(draws)


def _check_takes_float(field: str, way: Steps, value: float, base: dict[str, Any], where: str) -> None:
    """Raises BadSpec where the field at `way` is not a float; other bounds are each trial's."""
    try:
        msgspec.convert(with_value(base, way, value + 0.5), scenario_file.ScenarioFile)
    except msgspec.ValidationError as error:
        if "got `float`" in str(error):
            raise BadSpec(f"{where}: '{field}' is not a floating-point number, and cannot be drawn") from None


def _numbers(fields: Sequence[str], where: str, base: dict[str, Any]) -> tuple[Steps, ...]:
    """Return the ways to `fields`. Raises BadSpec where there is no such field."""
    found = []
    for field in fields:
        try:
            found.append(steps(field, base))
        except NoSuchField as error:
            raise BadSpec(f"{where}: '{field}': {error}") from None
    return tuple(found)


def _known(
    fields: Sequence[str],
    where: str,
    base: dict[str, Any],
    varied: Mapping[Steps, tuple[Any, ...]],
    *,
    zero: bool = True,
) -> tuple[Steps, ...]:
    """Return the ways to `fields`, whose values are known when they are needed. Raises BadSpec.

    `varied` are the values of the fields that axes set, none of those that are drawn; `zero`: one may be 0.
    """
    ways = _numbers(fields, where, base)
    for field, way in zip(fields, ways, strict=True):
        try:
            values = varied[way] if way in varied else (value_at(base, way),)
        except (KeyError, IndexError):
            raise BadSpec(f"{where}: '{field}' is neither in the scenario nor drawn before") from None
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
            raise BadSpec(f"{where}: '{field}' is not a number")
        if 0 in values and not zero:
            raise BadSpec(f"{where}: '{field}' is 0, by which nothing can be divided")
    return ways


def _check_together(axes: Sequence[Axis], draws: Draws, source: str) -> None:
    """Raises BadSpec where two axes, or draws, get into each other's way."""
    names: set[str] = set()
    for i, axis in enumerate(axes):
        if axis.name in names:
            raise BadSpec(f"{source}: axis[{i}]: another axis is called '{axis.name}'")
        names.add(axis.name)
    placed = [
        (f"axis[{i}]", field, way)
        for i, axis in enumerate(axes)
        for field, way in zip(axis.fields, axis.ways, strict=True)
    ]
    placed += [(f"draw[{i}]", draw.field, draw.way) for i, draw in enumerate(draws.fields)]
    for (one, field, way), (other, another, further) in combinations(placed, 2):
        shorter = min(len(way), len(further))
        if way[:shorter] == further[:shorter]:
            raise BadSpec(f"{source}: {other}: '{another}' is set by {one} ('{field}') already")
    count = math.prod(len(axis.values) for axis in axes)
    if count > MAX_CELLS:
        raise BadSpec(f"{source}: axis: {count} cells, more than {MAX_CELLS}")
