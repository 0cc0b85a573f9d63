"""JSON, JSON5 and TOML that is nested or large is one line, whoever reads it, and takes no time."""

from __future__ import annotations

import ast
import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

import tandem
from compose.errors import NotToml, UserError
from compose.recording.run import read
from compose.scenario.shipped_files import shipped
from compose.scenario.toml_file import table_in
from compose.sweep import results_folder, spec
from compose.view.web import results_page
from compose.view.web.sources import Recorded
from protocol import documents
from protocol.documents import MOST_NESTED, Syntax, TooNested, check_nesting
from protocol.network.endpoints import BadConfiguration, configured
from tests.commands import tandem as command

NESTED = 100_000 * '{"a":'
PARSERS = {"msgspec.json.decode", "msgspec.json.Decoder", "msgspec.toml.decode", "json.loads", "json.load"}
"""The functions that parse what `protocol.documents` checks."""
OWN = {
    "compose/view/foxglove/layout.py",  # what a library returned
    "protocol/network/endpoints.py",  # what Zenoh returned of a configuration that was checked
    "protocol/documents.py",
}


def test_a_recording_with_nested_files_is_read_without_them(paper_1: Path, tmp_path: Path) -> None:
    for path in paper_1.glob("*.journal"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for name in ("summary.json", "kills.jsonl"):
        (tmp_path / name).write_text(f"{NESTED}\n")
    note = f"{tmp_path / 'kills.jsonl'}: line 1: it is nested more than {MOST_NESTED} deep"
    assert read(tmp_path).notes[0].startswith(note)
    assert tandem.open(tmp_path).mode is None
    show = Recorded("", tmp_path)
    show.load()
    assert show.setup is not None
    assert show.notes[0].startswith(note)
    for verb in ("audit", "replay"):
        ended = command(verb, tmp_path)
        assert ended.status == 0
        assert ended.err.startswith(f"tandem {verb}: {note}")


def test_nested_results_are_one_line(tmp_path: Path) -> None:
    for name in ("sweep.json", "estimate.json"):
        (tmp_path / name).write_text(NESTED)
    sweep = spec.load("noise")
    readers: list[Callable[[], Any]] = [
        lambda: results_page.of_sweep(tmp_path),
        lambda: results_page.of_estimate(tmp_path),
        lambda: _entered(results_folder.opened(tmp_path, sweep)),
    ]
    for reader in readers:
        with pytest.raises(UserError, match=f"nested more than {MOST_NESTED} deep"):
            reader()


def _entered(context: AbstractContextManager[Any]) -> None:
    with context:
        pass


@pytest.mark.parametrize(
    ("text", "syntax"),
    [
        ("[" * 100_000, "JSON"),
        (NESTED, "JSON"),
        (f"{'[' * 65}{']' * 65}", "JSON"),
        (f"a{50_000 * '.a'} = 1", "TOML"),
        (f"[a{50_000 * '.a'}]", "TOML"),
        (f"a{33 * '.a'} = {{ a{33 * '.a'} = 1 }}", "TOML"),
        (f"a = {'[' * 100_000}", "TOML"),
        (f"// a 'comment'\n{NESTED}", "JSON5"),
        (f"{{a: '\"', /* ' */ b: {'[' * 100_000}", "JSON5"),
    ],
)
def test_what_is_nested_too_deeply_is_refused_before_it_is_parsed(
    text: str, syntax: Syntax, tmp_path: Path
) -> None:
    began = time.process_time()
    with pytest.raises(TooNested):
        check_nesting(text, syntax)
    if syntax == "TOML":
        with pytest.raises(NotToml, match=r"^it: not TOML: it is nested"):
            table_in(text, "it")
    if syntax == "JSON5":
        (tmp_path / "zenoh.json5").write_text(text)
        with pytest.raises(BadConfiguration, match=r"zenoh\.json5: it is nested"):
            configured(tmp_path / "zenoh.json5")
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize(
    ("text", "syntax"),
    [
        (json.dumps({"a": "[" * 1000, '"{' * 100: [[]] * 1000}), "JSON"),
        (f"{'[' * 64}{']' * 64}", "JSON"),
        (f"a = [{1000 * '0.5, '}]\n{''.join([f'b{i} = 1.5{chr(10)}' for i in range(100)])}", "TOML"),
        (f"# {'[' * 99}\na = '{'[' * 99}'\nb = \"\"\"\"{'[' * 99}\"\"\"\nc = '''{'.' * 99}'''", "TOML"),
        (f"{{ // {'[' * 99}\n /* {'{' * 99} */ a: '{'[' * 99}', b: \"'{'[' * 99}\" }}", "JSON5"),
        *[(path.read_text(), "TOML") for path in shipped().values()],
    ],
)
def test_brackets_in_strings_and_comments_do_not_nest(text: str, syntax: Syntax) -> None:
    check_nesting(text, syntax)
    if syntax != "JSON5":
        (documents.json_value if syntax == "JSON" else documents.toml_table)(text)


def test_a_document_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "sweep.json").open("wb") as file:
        file.truncate(10 << 30)
    with pytest.raises(UserError, match=f"larger than {documents.MOST_DOCUMENT_BYTES} bytes"):
        results_page.of_sweep(tmp_path)


@pytest.mark.long
def test_no_other_module_parses_documents() -> None:
    root = Path(__file__).parents[1]
    for package in ("agent", "compose", "protocol", "tandem", "world"):
        for path in sorted((root / package).rglob("*.py")):
            called = {
                ast.unparse(node)
                for node in ast.walk(ast.parse(path.read_text()))
                if isinstance(node, ast.Attribute)
            }
            assert not called & PARSERS or str(path.relative_to(root)) in OWN, path
