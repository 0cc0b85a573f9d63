"""The commands and flags that version 0.3 removed, and what replaces each; version 0.4 drops this table."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NoReturn

from compose.errors import UserError

_FOXGLOVE = "use `--watch`, or open run.mcap of `tandem export` in Foxglove"
REMOVED = {
    "run --foxglove": _FOXGLOVE,
    "run --foxglove-origin": _FOXGLOVE,
    "export --gif": "use `--html`, whose page plays the mission",
    "export --mp4": "use `--html`, whose page plays the mission",
    "bench": "`uv run python -m tests.benchmark` in a clone measures the same",
    "estimate --all-anchors": "all anchors are used without it",
    "run SCENARIO SCENARIO": "a loop of the shell runs several files",
    "run --seed N..N": "`tandem sweep` runs many seeds, with one table",
}
"""The replacement, as the end of a sentence, of a command, or of a command and its flag."""


def removed(name: str) -> UserError:
    """Return the error for the row `name` of REMOVED."""
    return UserError(f"`{name}` was removed in version 0.3: {REMOVED[name]}")


def another_scenario(_: str) -> NoReturn:
    """Raise UserError, as the type of a second scenario of `tandem run`."""
    raise removed("run SCENARIO SCENARIO")


def refuse_removed(words: Sequence[str]) -> None:
    """Raise UserError if `words`, a command and its arguments, name something that was removed."""
    if words[:1] == ["run"] and re.search(r" --seed[ =]\S+(,|\.\.)", " ".join(words)):
        raise removed("run --seed N..N")
    flags = [word.partition("=")[0] for word in words[1:]]
    for name in REMOVED:
        command, _, flag = name.partition(" ")
        if words[:1] == [command] and (not flag or flag in flags):
            raise removed(name)
