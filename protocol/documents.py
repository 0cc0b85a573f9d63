"""The parsing of documents in JSON, JSON5 and TOML, which others may have written.

Their nesting is checked first, because parsers of nested values recurse, or take quadratic time.
"""

from __future__ import annotations

import re
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal

import msgspec

from protocol import files

Syntax = Literal["JSON", "JSON5", "TOML"]
MOST_NESTED = 64
"""The maximum depth of nested values. Tandem's own documents, and those of Zenoh, have at most 10."""
MOST_DOCUMENT_BYTES = 16 << 20
"""The maximum size of a document. The largest, the files of a sweep of 10^4 cells, have some MB."""

_STRING = rb'"[^"\\]*(?:\\.[^"\\]*)*"?'
_IGNORED = {
    "JSON": re.compile(_STRING, re.DOTALL),
    "JSON5": re.compile(_STRING + rb"|'[^'\\]*(?:\\.[^'\\]*)*'?|//[^\n\r]*|/\*.*?(?:\*/|\Z)", re.DOTALL),
}
"""Whole strings and comments. An unfinished one ends the text."""
_TOML = re.compile(
    rb'"""(?:[^\\]|\\.)*?(?:"""|\Z)|' + rb"'''.*?(?:'''|\Z)|"
    rb'"[^"\\\n]*(?:\\.[^"\\\n]*)*"?|' + rb"'[^'\n]*'?|#[^\n]*|[][{}.,\n]",
    re.DOTALL,
)
"""The strings and comments of TOML, and the characters that begin or end a nested value or a key."""
_STEPS = bytes.maketrans(b"[{]}", b"\x01\x01\xff\xff")
"""The change of the depth by each bracket, as a signed byte."""
_NO_BRACKETS = bytes({*range(256)} - {*b"[]{}"})


class TooNested(msgspec.DecodeError):
    """A document is nested too deeply to be parsed."""

    def __init__(self) -> None:
        super().__init__(f"it is nested more than {MOST_NESTED} deep")


def flaw(error: Exception) -> str:
    """Return what is wrong with a document of which a field was looked up, by the exception."""
    return f"the field {error} is missing" if isinstance(error, KeyError) else str(error)


def json_value(text: bytes | str, kind: Any = Any) -> Any:
    """Return the value of type `kind` in the JSON `text`. Raises msgspec.DecodeError."""
    try:
        check_nesting(text, "JSON")
        return msgspec.json.decode(text, type=kind)
    except UnicodeError as error:
        raise msgspec.DecodeError(f"it is not UTF-8: {error}") from None


def json_file(path: Path, kind: Any = Any) -> Any:
    """Return the value of type `kind` in the JSON file at `path`. Raises OSError and msgspec.DecodeError."""
    return json_value(files.read_bytes(path, MOST_DOCUMENT_BYTES), kind)


def toml_table(text: str) -> dict[str, Any]:
    """Return the table in the TOML `text`. Raises ValueError."""
    check_nesting(text, "TOML")
    return msgspec.toml.decode(text, type=dict[str, Any])


def check_nesting(text: bytes | str, syntax: Syntax) -> None:
    """Raise TooNested if values in `text` are nested more than MOST_NESTED deep.

    In TOML, each dot in a key nests, too.
    """
    data = text.encode(errors="surrogatepass") if isinstance(text, str) else text
    if data.count(b"[") + data.count(b"{") + data.count(b".") <= MOST_NESTED:
        return
    if syntax == "TOML":
        _check_toml(data)
        return
    steps = _IGNORED[syntax].sub(b"", data).translate(_STEPS, delete=_NO_BRACKETS)
    if max(accumulate(memoryview(steps).cast("b")), default=0) > MOST_NESTED:
        raise TooNested


def _check_toml(data: bytes) -> None:
    """Raise TooNested like `check_nesting`."""
    opened: list[int] = []
    depth = dots = 0
    for token in _TOML.finditer(data):
        match token[0]:
            case b"[" | b"{":
                opened.append(dots)
                depth, dots = depth + 1, 0
            case b"]" | b"}" if opened:
                depth, dots = depth - 1 - dots, opened.pop()
            case b".":
                depth, dots = depth + 1, dots + 1
            case b"," | b"\n" if token[0] == b"," or not opened:
                depth, dots = depth - dots, 0
        if depth > MOST_NESTED:
            raise TooNested
