"""Plain words: docstrings begin with what a thing is, no private language, no name used twice."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from compose.cli.commands import COMMANDS, CommandEntry
from compose.cli.main import command_parser

ROOT = Path(__file__).parents[1]
PACKAGES = ("agent", "world", "protocol", "compose", "tandem")
STARTS = re.compile(
    r"(of|what|who|whom|whose|where|whether|when|which|why|how|in|on|at|by|to|from|for|with|without|under|as|about|"
    r"after|before|over|through|between|beside|along|against|among|within|until|since|into)\b",
    re.IGNORECASE,
)
"""A bare preposition or a wh-word at the start of a docstring."""

PRIVATE_WORDS = {
    "campaign": "sweep",
    "judge": "audit",
    "liar": "attacker",
    "odds": "probability",
    "patience": "timeout",
    "worldless": "hardware mode",
    "briefing": "RobotConfig",
    "farewell": "FinalReport",
    "alarm": "inconsistent",
    "on record": "in the recording",
    "link_statistics": "what happened to a report",
    "the letter": "the `paper` planner",
    "as often as you like": "may be repeated",
    "nobody is asked": "there is no authentication",
}
"""Words of the language that Tandem once had, and the words that replace them."""
HISTORY = ("CHANGELOG.md", "docs/changelog.md")
"""The pages that list the old names."""
IMPORT_ONLY_NAMES = {"__init__", "__main__"}
PUBLIC_NAMES = {"Run", "Scenario", "World"}
"""The classes of the Python API that wrap one of the same name: the name that a user expects."""


@cache
def trees() -> dict[str, ast.Module]:
    """Return the syntax tree of each module, by its path."""
    return {
        str(path.relative_to(ROOT)): ast.parse(path.read_text(encoding="utf-8"))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of every docstring, those of constants and fields included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            if (text := ast.get_docstring(node)) is not None:
                yield getattr(node, "lineno", 1), text
            for before, here in zip(node.body, node.body[1:], strict=False):
                if (
                    isinstance(before, ast.Assign | ast.AnnAssign)
                    and isinstance(here, ast.Expr)
                    and isinstance(here.value, ast.Constant)
                    and isinstance(here.value.value, str)
                ):
                    yield here.lineno, here.value.value


def private_words(text: str) -> set[str]:
    return {word for word in PRIVATE_WORDS if re.search(rf"\b{word}s?\b", text, re.IGNORECASE)}


@pytest.mark.long
def test_a_docstring_begins_with_what_the_thing_is() -> None:
    found = [
        f"{path}:{line}: {text.splitlines()[0]}"
        for path, tree in trees().items()
        for line, text in docstrings(tree)
        if STARTS.match(text)
    ]
    assert len(found) < 5, "\n".join(found)


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.stem
)
def test_a_page_has_no_private_words(page: Path) -> None:
    if str(page.relative_to(ROOT)) not in HISTORY:
        assert private_words(page.read_text(encoding="utf-8")) == set()


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_the_help_of_a_command_has_no_private_words(command: CommandEntry) -> None:
    assert private_words(command_parser(command).format_help()) == set()


@pytest.mark.long
def test_messages_and_docstrings_have_no_private_words() -> None:
    found = [
        f"{path}:{node.lineno}: {sorted(words)}: {node.value[:80]}"
        for path, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value
        if (words := private_words(node.value))
    ]
    assert found == []


@pytest.mark.long
def test_no_class_has_the_name_of_another() -> None:
    names = Counter(
        node.name for tree in trees().values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)
    )
    assert {name for name, count in names.items() if count > 1} == PUBLIC_NAMES


@pytest.mark.long
def test_no_module_has_the_name_of_another() -> None:
    """Except those of compose/cli: each has the name of its command."""
    names = Counter(Path(path).stem for path in trees() if not path.startswith("compose/cli/"))
    assert {name for name, count in names.items() if count > 1} <= IMPORT_ONLY_NAMES


def test_compose_has_at_most_twelve_packages_and_three_modules_of_its_own() -> None:
    compose = ROOT / "compose"
    packages = {path.parent.name for path in compose.glob("*/__init__.py")}
    modules = {path.stem for path in compose.glob("*.py")} - IMPORT_ONLY_NAMES
    assert len(packages) <= 12, packages
    assert modules == {"errors", "extras", "network"}


def test_private_words_are_found() -> None:
    """The checks above find a word at the start and inside of a text, and do not find it in another word."""
    assert private_words("The campaigns go on.") == {"campaign"}
    assert private_words("It is on record.") == {"on record"}
    assert private_words("an alarming, judgemental letter") == set()
    assert STARTS.match("Whether it is there.")
    assert not STARTS.match("Whereas")
