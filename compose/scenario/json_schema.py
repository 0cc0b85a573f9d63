"""JSON Schemas of scenario and sweep files, with which editors complete and check them."""

from __future__ import annotations

import ast
import inspect as source
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from types import ModuleType
from typing import Any

import msgspec
from msgspec import inspect

from compose.launch import planner_loader

CLASS_NAME = r"^[A-Za-z_][A-Za-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*$"
"""The pattern of MODULE:CLASS."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""The version of JSON Schema."""


def json_schema(file: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON Schema of a file whose content is a `file`, with the docstrings of all fields.

    It accepts more than a command does: rules between fields are not part of it.
    """
    schema: dict[str, Any] = _for_toml(msgspec.json.schema(file))
    structs = {struct.__name__: struct for struct in structs_in(inspect.type_info(file))}
    for name, definition in schema["$defs"].items():
        struct = structs[name]
        definition["description"] = " ".join((struct.__doc__ or "").split("\n\n")[0].split())
        for field, found in definition["properties"].items():
            if text := described(struct, field):
                found["description"] = text
            if struct.__annotations__.get(field) == "PlannerName":
                known = [*planner_loader.PLANNER_NAMES, *planner_loader.installed()]
                definition["properties"][field] = _one_of(known, found)
    return {"$schema": DIALECT, **schema}


def _one_of(known: list[str], field: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a field that has a known name, or that of a class."""
    others = {name: value for name, value in field.items() if name not in ("type", "pattern", "maxLength")}
    return {"anyOf": [{"enum": known}, {"type": "string", "pattern": CLASS_NAME}], **others}


def _for_toml(value: Any) -> Any:
    """Return a schema without null, which TOML does not have, and with patterns as ECMAScript writes them."""
    if isinstance(value, list | tuple):
        return [_for_toml(one) for one in value if one != {"type": "null"}]
    if not isinstance(value, dict):
        return value
    found = {name: _for_toml(one) for name, one in value.items() if one is not None}
    if "pattern" in found:
        found["pattern"] = found["pattern"].replace(r"\A", "^").replace(r"\Z", "$")
    if len(several := found.get("anyOf", ())) == 1:
        del found["anyOf"]
        found = several[0] | found
    return found


def structs_in(kind: inspect.Type) -> Iterator[type[msgspec.Struct]]:
    """Yield the structs in a type, at any depth."""
    match kind:
        case inspect.StructType(cls=cls, fields=fields):
            yield cls
            for field in fields:
                yield from structs_in(field.type)
        case inspect.Metadata(type=inner):
            yield from structs_in(inner)
        case inspect.UnionType(types=several) | inspect.TupleType(item_types=several):
            for one in several:
                yield from structs_in(one)
        case (
            inspect.ListType(item_type=item)
            | inspect.VarTupleType(item_type=item)
            | inspect.DictType(value_type=item)
        ):
            yield from structs_in(item)


def described(struct: type[msgspec.Struct], field: str) -> str:
    """Return the docstring of a field, of the class that declares it; empty if it has none."""
    for cls in struct.__mro__:
        module = source.getmodule(cls)
        if module is not None and field in (found := _docstrings(module).get(cls.__name__, {})):
            return found[field]
    return ""


@cache
def _docstrings(module: ModuleType) -> dict[str, dict[str, str]]:
    """Return the docstring under each field of each class in `module`, by class and field."""
    found: dict[str, dict[str, str]] = {}
    try:
        text = source.getsource(module)
    except (OSError, TypeError):  # a module in C
        return {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.ClassDef):
            found[node.name] = dict(_pairs(node.body))
    return found


def _pairs(body: Sequence[ast.stmt]) -> Iterable[tuple[str, str]]:
    """Yield the names of annotated fields that have a string below them, and that string."""
    for field, below in pairwise(body):
        match field, below:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                yield name, " ".join(text.split())
