"""The JSON Schemas accept the shipped files, and refuse a typing mistake."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest

from compose.scenario.json_schema import json_schema
from compose.scenario.scenario_tables import ScenarioFile
from compose.scenario.shipped_files import shipped
from compose.sweep.spec import SpecFile
from tests.commands import tandem

jsonschema = pytest.importorskip("jsonschema")

KINDS: dict[str, type[msgspec.Struct]] = {"scenario": ScenarioFile, "sweep": SpecFile}
FILES = [(kind, path) for kind in KINDS for path in shipped(kind).values()]


def problems(kind: str, table: dict[str, Any]) -> list[str]:
    """Return the texts of all violations of the schema."""
    validator = jsonschema.Draft202012Validator(json_schema(KINDS[kind]))
    return [error.message for error in validator.iter_errors(table)]


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda one: getattr(one, "stem", one))
def test_a_shipped_file_fits_its_schema(kind: str, path: Path) -> None:
    assert problems(kind, tomllib.loads(path.read_text())) == []


def test_a_mistake_does_not_fit() -> None:
    table = tomllib.loads(shipped()["paper-1"].read_text())
    assert problems("scenario", {**table, "sede": 1}) != []
    assert problems("scenario", {**table, "seed": -1}) != []
    assert problems("scenario", {**table, "name": "two words"}) != []
    assert problems("scenario", {**table, "planner": {"name": "papers"}}) != []


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_prints_a_valid_schema_that_explains_every_field(kind: str) -> None:
    ended = tandem("scenarios", "--schema", kind)
    schema = json.loads(ended.out)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema == json_schema(KINDS[kind])
    for name, definition in schema["$defs"].items():
        for field, found in definition["properties"].items():
            assert found.get("description"), f"{name}.{field}"
    assert "null" not in ended.out
    assert "\\\\A" not in ended.out, "not a pattern of ECMAScript"
