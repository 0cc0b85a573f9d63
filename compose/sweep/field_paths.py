"""Dotted paths to fields of a scenario file: `mission.period`, `robot.a.start`, `robot[1].anchor[0]`."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import msgspec
from msgspec import inspect

from compose.errors import NoSuchField
from compose.scenario.scenario_tables import ScenarioFile
from protocol.spelling import did_you_mean

Steps = tuple[str | int, ...]
"""A parsed path: table keys and list indices, from the top of the file."""
_STEP = re.compile(r"([A-Za-z0-9_-]+)|\[([0-9]{1,4})\]")
_PATH = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+|\[[0-9]{1,4}\])*")
SEED_FIELD = "seed"
"""The field that a sweep cannot vary, because every trial has its own seed."""


def steps(path: str, base: Mapping[str, Any]) -> Steps:
    """Return the parsed `path` of a field that a sweep can vary, checked like `field_steps`.

    Raises NoSuchField, also for the seed.
    """
    found = field_steps(path, base)
    if found == (SEED_FIELD,):
        raise NoSuchField("every trial has its own seed")
    return found


def field_steps(path: str, base: Mapping[str, Any]) -> Steps:
    """Return the parsed `path`, checked against the scenario schema and the table `base`.

    The field may be missing in `base` if the schema has it. Raises NoSuchField.
    """
    kind = _schema()
    value: Any = base
    walked: list[str | int] = []
    for step in _split(path):
        so_far = _written(walked)
        match _bare(kind):
            case inspect.StructType(fields=fields):
                kinds = {field.encode_name: field.type for field in fields}
                if value is not None and not isinstance(value, Mapping):
                    raise NoSuchField(f"{so_far} of the base scenario is not a table")
                if step not in kinds:
                    near = did_you_mean(str(step), kinds)
                    raise NoSuchField(f"{so_far or 'a scenario'} has no field '{step}'{near}")
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
    return tuple(walked)


@cache
def _schema() -> inspect.Type:
    """Return the types of all fields of a scenario file, whose translation takes longer than a mission."""
    return inspect.type_info(ScenarioFile)


def with_value(table: Mapping[str, Any], way: Steps, value: Any) -> dict[str, Any]:
    """Return a copy of `table` in which the field at `way` is `value`."""
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
    """Return the value of the field at `way`. Raises KeyError or IndexError if it is missing."""
    value: Any = table
    for step in way:
        value = value[step]
    return value


def _split(path: str) -> list[str | int]:
    """Return the steps of a path. Raises NoSuchField if its syntax is wrong."""
    if not _PATH.fullmatch(path):
        example = "not a path such as mission.period, robot.a.start or robot[1].anchor[0]"
        raise NoSuchField(example if path else "is empty")
    return [key or int(place) for key, place in _STEP.findall(path)]


def _written(walked: Sequence[str | int]) -> str:
    """Return steps as the text of a path."""
    return "".join([f"[{step}]" if isinstance(step, int) else f".{step}" for step in walked]).lstrip(".")


def _bare(kind: inspect.Type) -> inspect.Type:
    """Return the type of a field without constraints and without None."""
    if isinstance(kind, inspect.Metadata):
        return _bare(kind.type)
    if isinstance(kind, inspect.UnionType):
        left = [one for one in kind.types if not isinstance(one, inspect.NoneType)]
        return _bare(left[0]) if len(left) == 1 else kind
    return kind


def _may_be_empty(kind: inspect.Type) -> bool:
    """Return true if the type is a table without required fields, such as a fault.

    A list can be extended by an empty table of such a type.
    """
    bare = _bare(kind)
    return isinstance(bare, inspect.StructType) and not any(field.required for field in bare.fields)


def _place(step: str | int, listed: Sequence[Any], so_far: str, *, spare: bool) -> int:
    """Return the index of `step` in the list `listed`: the index itself, or that of the table with that id.

    An index beyond the end is valid only if `spare`. Raises NoSuchField.
    """
    if isinstance(step, int):
        if step >= len(listed) and not spare:
            raise NoSuchField(f"the base scenario has no {so_far}[{step}]")
        return step
    ids = [one.get("id") if isinstance(one, Mapping) else None for one in listed]
    if step not in ids:
        near = did_you_mean(step, [one for one in ids if isinstance(one, str)])
        raise NoSuchField(f"the base scenario has no {so_far} with the id '{step}'{near}")
    return ids.index(step)


def jsonable(value: Any) -> bool:
    """Return true if both TOML and JSON can represent the value. They cannot represent NaN and infinity."""
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
    """Return the value as canonical JSON text; 1 and 1.0 give the same text."""
    return msgspec.json.encode(_whole(value), order="deterministic").decode()


def _whole(value: Any) -> Any:
    """Return `value` with every integral float replaced by an integer."""
    match value:
        case float() if value.is_integer():
            return int(value)
        case list():
            return [_whole(one) for one in value]
        case dict():
            return {key: _whole(one) for key, one in value.items()}
        case _:
            return value
