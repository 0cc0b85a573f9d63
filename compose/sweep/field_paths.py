"""Dotted paths to fields of a scenario file: `mission.period`, `robot.a.start`, `robot[1].anchor[0]`."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import msgspec

from compose.errors import NoSuchField
from compose.scenario.scenario_tables import ScenarioFile
from compose.scenario.toml_file import field_first
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
    """Return the parsed `path` of a field that a scenario file with the content `base` has, or could have.

    Raises NoSuchField.
    """
    value: Any = base
    walked: list[str | int] = []
    for name in _split(path):
        tables = value if isinstance(value, list) and value and isinstance(value[0], Mapping) else ()
        step = _place(name, tables, _written(walked)) if isinstance(name, str) and tables else name
        if value is not None and not isinstance(value, list if isinstance(step, int) else Mapping):
            what = "list" if isinstance(step, int) else "table"
            raise NoSuchField(f"{_written(walked)} of the base scenario is not a {what}")
        walked.append(step)
        value = _inner(value, step)
        if isinstance(step, int) and value is None:
            _check(base, walked, {})  # a table may be added to a list if it needs no fields, as a fault
    _check(base, walked, _ANY)
    return tuple(walked)


_ANY = object()
"""A value that no field has: its type is refused only where there is a field."""


def _check(base: Mapping[str, Any], walked: Sequence[str | int], value: object) -> None:
    """Raise NoSuchField if `base` with this `value` has an unknown field, or a table lacks a required one."""
    try:
        msgspec.convert(with_value(base, tuple(walked), value), ScenarioFile)
    except msgspec.ValidationError as error:
        if re.match("Object (contains unknown field|missing required field .* - at )", str(error)):
            raise NoSuchField(field_first(str(error), ScenarioFile)) from None


def _inner(value: Any, step: str | int) -> Any:
    """Return the value at `step` of a table or a list; None if it is missing."""
    if isinstance(step, str):
        return value.get(step) if value is not None else None
    return value[step] if value is not None and step < len(value) else None


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


def _place(step: str, listed: Sequence[Any], so_far: str) -> int:
    """Return the index of the table with the id `step` in a list. Raises NoSuchField."""
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
