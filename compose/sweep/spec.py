"""The sweep file: its TOML schema, and its validation.

Invalid input raises BadSpec, whose text is one line with the file and the field.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from compose.errors import BadSpec, NoSuchField, NotToml
from compose.scenario import scenario_tables, shipped_files
from compose.scenario.toml_file import field_first, read_text, table_in
from compose.sweep.draws import Draw, Draws, DrawTable, StartsTable
from compose.sweep.field_paths import Steps, canonical, jsonable, steps, value_at, with_value
from compose.sweep.field_users import changes_draws, overlap
from protocol.spelling import did_you_mean
from protocol.units import NAME

MAX_TRIALS = 10**7
"""The largest number of trials per cell."""
MAX_CELLS = 10_000
"""The largest number of cells of a sweep."""
TRIAL_TIMEOUT_S = 60.0
"""The default wall time in s after which a trial counts as hung."""
NOT_JSONABLE = "must be a number, a string, true or false, or a list or table of these"
"""The error of a value that a scenario cannot have."""
Label = Annotated[str, Meta(min_length=1, max_length=60)]


class RowTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A row of an axis: the fields in which its cells differ from the base scenario."""

    label: Label
    """the name of the row in tables and figures"""
    set: dict[str, Any]
    """the values of fields, by their paths in quotes; all other fields are as in the base scenario"""


class AxisTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [[axis]]: one `field` and its values, or a `name` and several `fields` that vary together.

    An axis whose values differ in different fields has a `name` and `rows` instead.
    """

    values: Annotated[list[Any], Meta(min_length=1)] | None = None
    """the values; with `fields`, a list of values for each"""
    rows: Annotated[list[RowTable], Meta(min_length=1)] | None = None
    """the rows, `{label = "...", set = {"PATH" = VALUE, ...}}`, instead of `values`"""
    field: str | None = None
    """the path of the field that varies"""
    fields: Annotated[list[str], Meta(min_length=1)] | None = None
    """the paths of the fields that vary together"""
    name: Annotated[str, Meta(pattern=NAME, max_length=48)] | None = None
    """the name of an axis with several fields, or with labels"""
    labels: list[Label] | None = None
    """names of the values in tables and figures"""
    paired: bool | None = None
    """true if trials with the same number have the same seeds at all values; left out: where the fields
    change neither draws nor the world, such as those of the planner"""


class SpecFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The schema of a sweep file."""

    name: Annotated[str, Meta(pattern=NAME, max_length=48)]
    """the name of the sweep"""
    scenario: str
    """name of a shipped scenario, or path of a scenario file relative to the sweep file's folder"""
    trials: Annotated[int, Meta(ge=1, le=MAX_TRIALS)]
    """number of trials per cell"""
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    """the seed from which the seeds of all trials follow"""
    set: dict[str, Any] = {}
    """fields in which the base scenario differs from `scenario`, by their paths in quotes"""
    trial_timeout: Annotated[float, Meta(gt=0.0, le=1e6)] = TRIAL_TIMEOUT_S
    """wall time in s after which a trial counts as hung"""
    axis: list[AxisTable] = []
    """one `[[axis]]` for each axis; a sweep without axes has one cell"""
    draw: list[DrawTable] = []
    """fields whose values are drawn for each trial, in this order"""
    starts: StartsTable | None = None
    """kinds of start from which each trial draws; None to use the starts of the scenario"""


class Axis(msgspec.Struct, frozen=True):
    """One axis of a sweep: scenario fields that vary together, and their values."""

    name: str
    """name of the axis; by default, the path of its only field"""
    fields: tuple[str, ...]
    """paths of the fields, as in the sweep file"""
    ways: tuple[Steps, ...]
    """parsed paths of the fields"""
    values: tuple[tuple[Any, ...], ...]
    """values of the axis, each a tuple with one element per field; None leaves the field as in the base"""
    labels: tuple[str, ...] | None
    """names of the values; None to derive them from the values"""
    paired: bool = False
    """true if the seeds of trials do not depend on this axis"""

    @property
    def columns(self) -> list[str]:
        """The names of its columns in tables: that of its labels, if it has some, and those of its fields."""
        return [*([self.name] if self.labels is not None else []), *self.fields]

    def row(self, place: int) -> tuple[Any, ...]:
        """Return the elements of `columns` for the value at index `place`."""
        return (*(self.labels[place : place + 1] if self.labels is not None else ()), *self.values[place])

    @property
    def of_planners(self) -> bool:
        """True if it varies the planner or its options."""
        return any(way[0] == "planner" for way in self.ways)

    @property
    def of_rows(self) -> bool:
        """True if some of its values leave a field as in the base scenario."""
        return any(None in value for value in self.values)

    def label(self, place: int) -> str:
        """Return the name of the value at index `place`."""
        if self.labels is not None:
            return self.labels[place]
        texts = [value if isinstance(value, str) else canonical(value) for value in self.values[place]]
        if len(texts) == 1:
            return texts[0]
        return ", ".join(f"{field}={value}" for field, value in zip(self.fields, texts, strict=True))


class Sweep(msgspec.Struct, frozen=True):
    """A validated sweep. It determines every trial completely."""

    source: str
    """name or path of the sweep file, as the user gave it"""
    name: str
    base: dict[str, Any]
    """parsed table of the scenario file, before any axis or draw is applied"""
    axes: tuple[Axis, ...]
    trials: int
    """number of trials per cell"""
    seed: int
    """seed of the sweep, from which the seeds of its trials are derived"""
    trial_timeout: float
    """wall time in s after which a trial counts as hung"""
    draws: Draws = Draws()
    """values drawn for each trial, in addition to starts that the scenario leaves open"""

    @property
    def of_group(self) -> bool:
        """True if its robots form a group or a team."""
        robots, mission = self.base.get("robot"), self.base.get("mission")
        if (
            self.base.get("anchor")
            or "team" in self.base
            or (isinstance(mission, dict) and "frame" in mission)
        ):
            return True
        if not isinstance(robots, list):
            return "group" in self.base
        return len(robots) > 2 and not any("peer" in robot for robot in robots if isinstance(robot, dict))


def shipped() -> Mapping[str, Path]:
    """Return the paths of the shipped sweep files, by name."""
    return shipped_files.shipped("sweep")


def load(source: str, *, trials: int | None = None, seed: int | None = None) -> Sweep:
    """Return the sweep that `source` names: a shipped sweep, or a file at that path.

    `trials` and `seed` override the values of the sweep file. Raises BadSpec if the sweep is unknown or
    invalid, and NotToml if the file is not TOML.
    """
    path = shipped().get(source, Path(source))
    try:
        table = table_in(read_text(path), source)
    except FileNotFoundError:
        raise BadSpec(shipped_files.unknown(source, "sweep")) from None
    except ValueError as error:
        raise BadSpec(f"{source}: {error}") from None
    if (why := shipped_files.misplaced(source, table, "sweep")) is not None:
        raise BadSpec(why)
    return validated(table, source, path.parent, trials=trials, seed=seed)


def validated(
    table: Mapping[str, Any],
    source: str,
    folder: Path,
    *,
    base: dict[str, Any] | None = None,
    trials: int | None = None,
    seed: int | None = None,
) -> Sweep:
    """Return the sweep whose file has the content `table`.

    `source` begins errors, and `folder` is that of the sweep file. `base` is the table of the scenario if it
    is not in a file; `trials` and `seed` override the values of the sweep file. Raises BadSpec.
    """
    try:
        spec = msgspec.convert(table, SpecFile)
    except msgspec.ValidationError as error:
        raise BadSpec(f"{source}: {field_first(str(error), SpecFile)}") from None
    base = base if base is not None else _base(spec, folder, source)
    axes = tuple(_axis(axis, f"{source}: axis[{i}]", base) for i, axis in enumerate(spec.axis))
    draws = Draws(_draws(spec, axes, base, source), spec.starts)
    _check_together(axes, draws, source)
    varied = [way for axis in axes for way in axis.ways]
    found = Sweep(
        source=source,
        name=spec.name,
        base=base,
        axes=tuple(
            msgspec.structs.replace(
                axis,
                paired=not any(changes_draws(way, base, varied, draws.fields) for way in axis.ways)
                if given.paired is None
                else given.paired,
            )
            for axis, given in zip(axes, spec.axis, strict=True)
        ),
        trials=trials if trials is not None else spec.trials,
        seed=seed if seed is not None else spec.seed,
        trial_timeout=spec.trial_timeout,
        draws=draws,
    )
    if found.of_group and spec.starts is not None:
        raise BadSpec(f"{source}: starts: the robots form no pairs, and its kinds are those of pairs")
    return found


def _base(spec: SpecFile, folder: Path, source: str) -> dict[str, Any]:
    """Return the table of the base scenario of `spec`. Raises BadSpec if it cannot be read."""
    file = shipped_files.shipped().get(spec.scenario, folder / spec.scenario)
    try:
        base = table_in(read_text(file), spec.scenario)
    except FileNotFoundError:
        names = shipped_files.shipped()
        raise BadSpec(
            f"{source}: scenario: '{spec.scenario}' is neither a file in the folder of the sweep file nor a "
            f"shipped scenario ({', '.join(names)}){did_you_mean(spec.scenario, names)}"
        ) from None
    except (ValueError, NotToml) as error:
        raise BadSpec(f"{source}: scenario: {error}") from None
    for field, value in spec.set.items():
        (way,) = _ways({field: value}, base, f"{source}: set")
        base = with_value(base, way, value)
    return base


def _axis(table: AxisTable, where: str, base: dict[str, Any]) -> Axis:
    """Return the validated axis; `where` is its prefix in error messages. Raises BadSpec."""
    if (table.values is None) == (table.rows is None):
        raise BadSpec(f"{where}: needs either 'values' or 'rows'")
    axis = (
        _axis_of_rows(table, table.rows, where, base) if table.rows else _axis_of_values(table, where, base)
    )
    if table.name is None:
        for form in ("rows", "fields", "labels"):
            if getattr(table, form) is not None:
                raise BadSpec(f"{where}.name: missing: an axis with '{form}' needs a name")
    if table.name in axis.fields:
        raise BadSpec(f"{where}.name: '{table.name}' is also one of the fields of this axis")
    return axis


def _axis_of_values(table: AxisTable, where: str, base: dict[str, Any]) -> Axis:
    """Return the axis of a field, or of several that vary together. Raises BadSpec."""
    if (table.field is None) == (table.fields is None):
        raise BadSpec(f"{where}: needs either 'field', or 'name' and 'fields'")
    if table.fields is None:
        fields, ways = [str(table.field)], _ways([str(table.field)], base, f"{where}.field")
    else:
        fields = table.fields
        ways = tuple(_ways([one], base, f"{where}.fields[{i}]")[0] for i, one in enumerate(fields))
    seen: dict[str, int] = {}
    values = table.values or []
    for i, value in enumerate(values):
        if not jsonable(value):
            raise BadSpec(f"{where}.values[{i}]: {NOT_JSONABLE}")
        if table.fields is not None and (not isinstance(value, list) or len(value) != len(fields)):
            raise BadSpec(f"{where}.values[{i}]: must be a list of {len(fields)} values, one for each field")
        if (first := seen.setdefault(canonical(value), i)) != i:
            raise BadSpec(f"{where}.values[{i}]: equal to values[{first}]")
    if table.labels is not None and not len(table.labels) == len(set(table.labels)) == len(values):
        raise BadSpec(f"{where}.labels: must be {len(values)} different labels, one for each value")
    return Axis(
        name=table.name or fields[0],
        fields=tuple(fields),
        ways=ways,
        values=tuple((value,) if table.fields is None else tuple(value) for value in values),
        labels=tuple(table.labels) if table.labels is not None else None,
    )


def _axis_of_rows(table: AxisTable, rows: Sequence[RowTable], where: str, base: dict[str, Any]) -> Axis:
    """Return the axis whose values differ in different fields. Raises BadSpec."""
    for name in ("field", "fields", "labels"):
        if getattr(table, name) is not None:
            raise BadSpec(f"{where}.{name}: an axis with 'rows' has none")
    ways: dict[str, Steps] = {}
    labels: dict[str, int] = {}
    for i, row in enumerate(rows):
        named = f"{where}.rows[{i}]"
        if (first := labels.setdefault(row.label, i)) != i:
            raise BadSpec(f"{named}.label: equal to that of rows[{first}]")
        found = dict(zip(row.set, _ways(row.set, base, f"{named}.set"), strict=True))
        for (field, way), (another, further) in combinations(found.items(), 2):
            if overlap(way, further):
                raise BadSpec(f"{named}.set: '{another}' is already set by '{field}'")
        ways |= found
    if not ways:
        raise BadSpec(f"{where}.rows: no row sets a field")
    return Axis(
        name=str(table.name),
        fields=tuple(ways),
        ways=tuple(ways.values()),
        values=tuple(tuple(row.set.get(field) for field in ways) for row in rows),
        labels=tuple(labels),
    )


def _ways(fields: Iterable[str] | Mapping[str, Any], base: dict[str, Any], where: str) -> tuple[Steps, ...]:
    """Return the parsed paths of `fields`, which may have values. Raises BadSpec if one does not exist."""
    found = []
    for field in fields:
        try:
            found.append(steps(field, base))
        except NoSuchField as error:
            raise BadSpec(f"{where}: '{field}': {error}") from None
        if isinstance(fields, Mapping) and not jsonable(fields[field]):
            raise BadSpec(f"{where}: '{field}': {NOT_JSONABLE}")
    return tuple(found)


def _draws(spec: SpecFile, axes: Sequence[Axis], base: dict[str, Any], source: str) -> tuple[Draw, ...]:
    """Return the validated draws of `spec`, in order. Raises BadSpec."""
    known: dict[Steps, Sequence[Any]] = {
        way: [value[i] for value in axis.values if value[i] is not None]
        for axis in axes
        for i, way in enumerate(axis.ways)
    }
    draws: list[Draw] = []
    for i, table in enumerate(spec.draw):
        where = f"{source}: draw[{i}]"
        if (table.uniform is None) == (table.log_uniform is None):
            raise BadSpec(f"{where}: needs exactly one of 'uniform' and 'log_uniform'")
        low, high = interval = table.uniform or table.log_uniform or (0.0, 0.0)
        logarithmic = table.log_uniform is not None
        if not low < high or not math.isfinite(high - low) or (logarithmic and low <= 0.0):
            above = " above 0" if logarithmic else ""
            raise BadSpec(f"{where}: {low:g} to {high:g} is not an interval{above}")
        if logarithmic and not math.isfinite(high / low):
            raise BadSpec(f"{where}: the interval {low:g} to {high:g} is too wide")
        (way,) = _ways([table.field], base, f"{where}.field")
        _check_takes_float(table.field, way, low, base, f"{where}.field")
        times = _known(table.times, f"{where}.times", base, known)
        over = _known(table.over, f"{where}.over", base, known, zero=False)
        draws.append(Draw(table.field, way, interval, logarithmic, times, over))
        known[way] = ()
    return tuple(draws)


def _check_takes_float(field: str, way: Steps, value: float, base: dict[str, Any], where: str) -> None:
    """Raise BadSpec if the field at `way` is not a float. Its bounds are checked for each trial."""
    try:
        msgspec.convert(with_value(base, way, value + 0.5), scenario_tables.ScenarioFile)
    except msgspec.ValidationError as error:
        if "got `float`" in str(error):
            raise BadSpec(f"{where}: '{field}' is not a floating-point field and cannot be drawn") from None


def _known(
    fields: Sequence[str],
    where: str,
    base: dict[str, Any],
    varied: Mapping[Steps, Sequence[Any]],
    *,
    zero: bool = True,
) -> tuple[Steps, ...]:
    """Return the parsed paths of `fields`, whose values scale a draw. Raises BadSpec.

    Each value must be a number that is known before the draw. `varied` contains the possible values of fields
    that axes set, and none for each field that is drawn earlier. A value may be 0 only if `zero` is true.
    """
    ways = _ways(fields, base, where)
    for field, way in zip(fields, ways, strict=True):
        try:
            values = varied[way] if way in varied else [value_at(base, way)]
        except (KeyError, IndexError):
            raise BadSpec(f"{where}: '{field}' is neither set by the scenario nor drawn earlier") from None
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
            raise BadSpec(f"{where}: '{field}' is not a number")
        if 0 in values and not zero:
            raise BadSpec(f"{where}: '{field}' is 0 and cannot be a divisor")
    return ways


def _check_together(axes: Sequence[Axis], draws: Draws, source: str) -> None:
    """Raise BadSpec if axes share a name, if axes or draws overlap, or if there are too many cells."""
    names: set[str] = set()
    for i, axis in enumerate(axes):
        if axis.name in names:
            raise BadSpec(f"{source}: axis[{i}]: another axis has the name '{axis.name}'")
        names.add(axis.name)
    placed = [
        (f"axis[{i}]", axis.of_rows, field, way)
        for i, axis in enumerate(axes)
        for field, way in zip(axis.fields, axis.ways, strict=True)
    ]
    placed += [(f"draw[{i}]", False, draw.field, draw.way) for i, draw in enumerate(draws.fields)]
    for (one, of_rows, field, way), (other, _, another, further) in combinations(placed, 2):
        if overlap(way, further) and not (of_rows and one == other):
            raise BadSpec(f"{source}: {other}: '{another}' is already set by {one} ('{field}')")
    count = math.prod(len(axis.values) for axis in axes)
    if count > MAX_CELLS:
        raise BadSpec(f"{source}: axis: {count} cells exceed the limit of {MAX_CELLS}")
