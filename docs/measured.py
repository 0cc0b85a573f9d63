"""Measured numbers that docs/reference.py does not write, and the code measured: `uv run docs/measured.py`.

The script prints each paragraph with numbers, the commit whose code was measured, the number of commits since
that changed a package on which results depend, and the command that measures it again. With `--check`, its
exit status is 1 if a paragraph is not the one that measured.toml has. `--again TEXT` records the paragraph
that begins with TEXT as measured with the code of now.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

from docs.reference import PLACE

DOCS = Path(__file__).parent
RECORD = DOCS / "measured.toml"
RESULTS = "results.md"
"""The page of which each paragraph with numbers has a statement; of other pages, some have."""
DECIDING = ("agent", "world", "protocol")
"""The packages on which results depend."""
NO_NUMBERS = re.compile(r"\[[^]]*\]\([^)]*\)|`[^`]*`|95 % intervals")
"""Links, code and words, whose digits are no results."""


class Statement(NamedTuple):
    """A paragraph, item of a list, or table with measured numbers."""

    page: str
    begins: str
    """The first words of it."""
    command: str
    """The command that measures it."""
    commit: str
    """The commit whose code was measured, or that stated it first."""
    text: str
    """A hash of the whole paragraph."""


def hashed(paragraph: str) -> str:
    """Return a hash of a paragraph, without its line breaks."""
    return sha256(" ".join(paragraph.split()).encode()).hexdigest()[:12]


def paragraphs(page: str) -> list[str]:
    """Return the parts of a page with numbers that docs/reference.py does not write."""
    parts = re.split(r"\n\s*\n|\n(?=- )", PLACE.sub("", page))
    return [
        part
        for part in (one.strip() for one in parts)
        if not part.startswith(("#", "![", "```", "<!--")) and re.search(r"\d", NO_NUMBERS.sub("", part))
    ]


def recorded() -> list[Statement]:
    """Return the statements in measured.toml."""
    return [Statement(**one) for one in tomllib.loads(RECORD.read_text("utf-8"))["statement"]]


def unrecorded(known: list[Statement], docs: Path = DOCS) -> Iterator[str]:
    """Yield a line for each paragraph that is not as recorded, and each of RESULTS without a record."""
    for one in known:
        part = paragraph_of(one, docs)
        if part is None:
            yield f"{one.page}: no paragraph begins with {one.begins!r}"
        elif hashed(part) != one.text:
            yield f"{one.page}: {one.begins!r} has changed: measure it by `{one.command}`, then use --again"
    begins = tuple(one.begins for one in known if one.page == RESULTS)
    for part in paragraphs((docs / RESULTS).read_text("utf-8")):
        if not part.startswith(begins):
            yield f"{RESULTS}: no command measures {part[:50]!r}: add it to docs/measured.toml"


def paragraph_of(statement: Statement, docs: Path = DOCS) -> str | None:
    """Return the paragraph of a statement; None if there is none."""
    there = paragraphs((docs / statement.page).read_text("utf-8"))
    return next((part for part in there if part.startswith(statement.begins)), None)


def changes_since(commit: str, repository: Path = DOCS.parent) -> int | None:
    """Return the number of commits since `commit` that changed DECIDING; None if it is unknown here."""
    command = ["git", "rev-list", "--count", f"{commit}..HEAD", "--", *DECIDING]
    ended = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    return int(ended.stdout) if ended.returncode == 0 else None


def age(statement: Statement, repository: Path = DOCS.parent) -> str:
    """Return the line that says how old a statement is."""
    changes = changes_since(statement.commit, repository)
    since = (
        "unknown here" if changes is None else f"commits since: {changes}" if changes else "of today's code"
    )
    return f"{statement.page}: {statement.begins}...: {statement.commit}, {since}; `{statement.command}`"


def written(statements: list[Statement]) -> str:
    """Return the content of measured.toml."""
    entries = [
        "\n".join(["[[statement]]", *[f'{name} = "{value}"' for name, value in one._asdict().items()]])
        for one in statements
    ]
    return "\n\n".join(
        [
            "# The measured numbers that docs/reference.py does not write; docs/measured.py reads it.",
            *entries,
            "",
        ]
    )


def main() -> None:
    """Print the statements, compare them, or record one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="exit status 1 if a paragraph has changed")
    parser.add_argument("--again", metavar="TEXT", help="record the paragraph that begins so")
    options = parser.parse_args()
    known = recorded()
    if options.again:
        head = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=DOCS, capture_output=True, text=True, check=True
        ).stdout.strip()
        chosen = [one for one in known if one.begins.startswith(options.again)]
        text = paragraph_of(chosen[0]) if len(chosen) == 1 else None
        if text is None:
            sys.exit(f"{len(chosen)} statements begin with {options.again!r}")
        again = chosen[0]._replace(commit=head, text=hashed(text))
        RECORD.write_text(written([again if one is chosen[0] else one for one in known]), "utf-8")
        return
    problems = list(unrecorded(known))
    for line in problems if options.check else [*map(age, known), *problems]:
        print(line)
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
