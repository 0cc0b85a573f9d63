"""A dotted path into a scenario file: `mission.period`, `robot.a.start`, `robot[1].anchor[0]`."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import msgspec
from msgspec import inspect

from compose.errors import NoSuchField
from compose.scenario.scenario_file import ScenarioFile

Steps = tuple[str | int, ...]
"""keys of tables and places in lists, from the top of the file"""
_STEP = re.compile(r"(?P<dot>\.?)(?:(?P<key>[A-Za-z0-9_-]+)|\[(?P<place>[0-9]{1,4})\])")
DRAWN = "seed"
"""the one field that is every trial's own"""


def steps(path: str, base: Mapping[str, Any]) -> Steps:
    """The way to the field `path` of the scenario `base`, which may leave it out. Raises NoSuchField."""
    kind: inspect.Type = inspect.type_info(ScenarioFile)
    value: Any = base
    walked: list[str | int] = []
    for step in _split(path):
        so_far = _written(walked)
        match _bare(kind):
            case inspect.StructType(fields=fields):
                kinds = {field.encode_name: field.type for field in fields}
                if value is not None and not isinstance(value, Mapping):
                    raise NoSuchField(f"{so_far} of the base scenario is no table")
                if step not in kinds:
                    raise NoSuchField(f"{so_far or 'a scenario'} has no field '{step}'")
                kind = kinds[str(step)]
                value = value.get(step) if value is not None else None
            case inspect.DictType(value_type=kind):
                value = value.get(step) if isinstance(value, Mapping) else None
            case inspect.ListType() | inspect.TupleType() | inspect.VarTupleType() as many:
                listed = value if isinstance(value, Sequence) else ()
                spare = not isinstance(many, inspect.TupleType) and _may_be_empty(many.item_type)
                place = _place(step, listed, so_far, spare=spare)
                kind = many.item_types[place] if isinstance(many, inspect.TupleType) else many.item_type
                value = listed[place] if place < len(listed) else None
                walked.append(place)
                continue
            case _:
                raise NoSuchField(f"{so_far} is a single value")
        walked.append(step)
    if walked == [DRAWN]:
        raise NoSuchField("every trial has a seed of its own")
    return tuple(walked)


def with_value(table: Mapping[str, Any], way: Steps, value: Any) -> dict[str, Any]:
    """A copy of `table` in which the field at `way` is `value`."""
    changed = copy.deepcopy(dict(table))
    inner: Any = changed
    for step, then in pairwise((*way, None)):
        if isinstance(step, int):
            inner.extend([{} for _ in range(step + 1 - len(inner))])
        if then is None:
            inner[step] = copy.deepcopy(value)
        elif isinstance(step, int):
            inner = inner[step]
        else:
            inner = inner.setdefault(step, [] if isinstance(then, int) else {})
    return changed


def value_at(table: Mapping[str, Any], way: Steps) -> Any:
    """Return the value of the field at `way`. Raises KeyError or IndexError where `table` leaves it out."""
    value: Any = table
    for step in way:
        value = value[step]
    return value


def _split(path: str) -> list[str | int]:
    found: list[str | int] = []
    at = 0
    while at < len(path):
        match = _STEP.match(path, at)
        if match is None or bool(match["dot"]) != (at > 0 and match["key"] is not None):
            raise NoSuchField("no path: such as mission.period, robot.a.start or robot[1].anchor[0]")
        found.append(match["key"] or int(match["place"]))
        at = match.end()
    if not found:
        raise NoSuchField("is empty")
    return found


def _written(walked: Sequence[str | int]) -> str:
    return "".join([f"[{step}]" if isinstance(step, int) else f".{step}" for step in walked]).lstrip(".")


def _bare(kind: inspect.Type) -> inspect.Type:
    """What a field holds that may be left out."""
    if isinstance(kind, inspect.Metadata):
        return _bare(kind.type)
    if isinstance(kind, inspect.UnionType):
        left = [one for one in kind.types if not isinstance(one, inspect.NoneType)]
        return _bare(left[0]) if len(left) == 1 else kind
    return kind


def _may_be_empty(kind: inspect.Type) -> bool:
    """Whether it is a table of which every field may be left out, as of a fault; then so may the table."""
    bare = _bare(kind)
    return isinstance(bare, inspect.StructType) and not any(field.required for field in bare.fields)


def _place(step: str | int, listed: Sequence[Any], so_far: str, *, spare: bool) -> int:
    """Where in a list: as the path says, with `spare` beyond its end, too; or of the table with that id."""
    if isinstance(step, int):
        if step >= len(listed) and not spare:
            raise NoSuchField(f"the base scenario has no {so_far}[{step}]")
        return step
    ids = [one.get("id") if isinstance(one, Mapping) else None for one in listed]
    if step not in ids:
        raise NoSuchField(f"the base scenario has no {so_far} with the id '{step}'")
    return ids.index(step)


def jsonable(value: Any) -> bool:
    """Whether the value is made of what both TOML and JSON know; NaN is not."""
    match value:
        case bool() | int() | str():
            return True
        case float():
            return value == value and abs(value) != float("inf")  # noqa: PLR0124  # NaN is not itself
        case list():
            return all(jsonable(one) for one in value)
        case dict():
            return all(jsonable(one) for one in value.values())
        case _:
            return False


def canonical(value: Any) -> str:
    """The value as JSON text that is the same however it was written: 1 and 1.0 are one number."""
    return msgspec.json.encode(_whole(value), order="deterministic").decode()


def _whole(value: Any) -> Any:
    match value:
        case float() if value.is_integer():
            return int(value)
        case list():
            return [_whole(one) for one in value]
        case dict():
            return {key: _whole(one) for key, one in value.items()}
        case _:
            return value
