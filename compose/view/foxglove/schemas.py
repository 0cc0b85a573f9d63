"""The formats of messages as JSON Schema."""

from __future__ import annotations

from functools import cache

import msgspec
from msgspec import inspect

from compose.scenario.json_schema import structs_in


@cache
def schema(kind: type[msgspec.Struct]) -> bytes:
    """Return the JSON Schema of messages of type `kind` on the wire: arrays of its name and its fields.

    It extends msgspec's schema, which has no field names in arrays and regular expressions in Python syntax.
    """
    described = msgspec.json.schema(kind)
    structs = {one.__name__: one for one in structs_in(inspect.type_info(kind))}
    for name, part in described["$defs"].items():
        struct = structs.get(name)
        if struct is not None and "prefixItems" in part:
            tagged = len(part["prefixItems"]) - len(struct.__struct_fields__)
            titles = ["kind"] * tagged + list(struct.__struct_fields__)
            part["prefixItems"] = [
                {"title": title, **item} for title, item in zip(titles, part["prefixItems"], strict=True)
            ]
    encoded = msgspec.json.encode(described, order="sorted")
    return encoded.replace(rb'"\\A', b'"^').replace(rb'\\Z"', b'$"')  # the anchors of regular expressions


def object_schema(kind: type[msgspec.Struct]) -> bytes:
    """Return the JSON Schema of objects of type `kind`, without references, which not all viewers follow."""
    return msgspec.json.encode(msgspec.json.schema(kind)["$defs"][kind.__name__], order="sorted")
