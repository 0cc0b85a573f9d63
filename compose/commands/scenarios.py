"""`tandem scenarios`"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path

from compose import layout
from compose.scenario import shipped
from compose.status import ENDED
from protocol.terminal import say


def main(_options: argparse.Namespace) -> int:
    """List the scenarios and the campaigns that ship, with the first sentence of each."""
    _list(shipped())
    say("campaigns, for `tandem sweep`:")
    _list(shipped("sweeps"))
    return ENDED


def _list(files: Mapping[str, Path]) -> None:
    width = max(map(len, files))
    for name, path in files.items():
        line = f"{name:{width}} {_sentence(path.read_text(encoding='utf-8'))}"
        say(*layout.wrapped(line, width + 1))


def _sentence(text: str) -> str:
    """The first of the comment that the file begins with, on however many lines it stands."""
    comment = takewhile(lambda line: line.startswith("#"), text.splitlines())
    return re.split(r"(?<=\.) ", " ".join([line.removeprefix("#").strip() for line in comment]), maxsplit=1)[
        0
    ]
