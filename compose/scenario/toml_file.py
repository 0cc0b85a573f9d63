"""Reading of TOML files written by users, and error messages that begin with the field."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect

from compose.errors import NotToml, no_such
from protocol import documents, files
from protocol.spelling import did_you_mean

PLAIN_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "null": "nothing",
}
"""The words for the types that msgspec's errors name."""


def read_text(path: Path) -> str:
    """Return the text of the file.

    Raises FileNotFoundError, and ValueError whose text says why the file cannot be read.
    """
    try:
        return files.read_text(path, documents.MOST_DOCUMENT_BYTES)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from None
    except ValueError:
        raise ValueError("cannot be read: it is not UTF-8 text") from None


def table_in(text: str, source: str) -> dict[str, Any]:
    """Return the table of the TOML in `text`, without validation.

    Raises NotToml, whose text begins with `source`.
    """
    try:
        return documents.toml_table(text)
    except ValueError as error:
        raise NotToml(f"{source}: not TOML: {error}") from None


def field_first(error: str, schema: type[msgspec.Struct]) -> str:
    """Return msgspec's `error` with the field in front: "mission.period: expected a number, got text".

    `schema` is the type of the whole file. From it follow the permitted words of a field, and suggestions.
    """
    match = re.fullmatch(r"(?P<what>.*?)(?: - at `\$\.?(?P<where>.*)`)?", error, re.DOTALL)
    assert match is not None
    what, where = match["what"].replace("`", "'"), match["where"] or ""
    what = what.replace("Object contains ", "").replace("Object missing required field", "missing field")
    if not what[1:2].isupper():  # "JSON is malformed" stays as it is
        what = what[0].lower() + what[1:]
    quoted = re.search(r"'(.*)'", what, re.DOTALL)
    word = quoted[1] if quoted is not None else ""
    if what.startswith("invalid enum value") and (words := known_words(schema, where)):
        what = no_such(word, words)
    elif what.startswith("unknown field"):
        what += did_you_mean(word, known_words(schema, where))
    elif what.startswith("expected"):
        what = re.sub(r"'([a-z |]+)'", _plain_types, what)
    if "matching regex" in what:
        what = "invalid name: use letters, digits, - and _, and begin with a letter or digit"
    return f"{where}: {what}" if where else what


def _plain_types(quoted: re.Match[str]) -> str:
    """Return the words for types such as `float | null`, of which null is left out beside another."""
    kinds = quoted[1].split(" | ")
    return " or ".join([PLAIN_TYPES.get(one, one) for one in kinds if one != "null" or len(kinds) == 1])


def known_words(schema: type[msgspec.Struct], where: str) -> list[str]:
    """Return the fields of the table, or the words that the field may be, at the path `where` in `schema`."""
    kinds = list(_bare(inspect.type_info(schema)))
    for step in re.findall(r"[A-Za-z_][\w-]*", where):
        inner = [one for kind in kinds if isinstance(kind, inspect.StructType) for one in kind.fields]
        kinds = [bare for field in inner if field.encode_name == step for bare in _bare(field.type)]
    fields = [
        one.encode_name for kind in kinds if isinstance(kind, inspect.StructType) for one in kind.fields
    ]
    return fields or [
        str(one) for kind in kinds if isinstance(kind, inspect.LiteralType) for one in kind.values
    ]


def _bare(kind: inspect.Type) -> Iterator[inspect.Type]:
    """Yield the types that a value of type `kind` may have, or its elements if it is a list."""
    match kind:
        case inspect.Metadata(type=inner):
            yield from _bare(inner)
        case inspect.UnionType(types=several):
            for one in several:
                yield from _bare(one)
        case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item):
            yield from _bare(item)
        case _:
            yield kind
