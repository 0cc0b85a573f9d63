"""`tandem scenarios`: list the scenarios and sweeps that ship with Tandem."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path

from compose.errors import ENDED
from compose.scenario.scenario_tables import ScenarioFile
from compose.scenario.shipped_files import shipped
from compose.terminal import text_width
from protocol.output import say


def main(options: argparse.Namespace) -> int:
    """List the scenarios and the sweeps that ship, with the first sentence of each; or print a schema."""
    if options.schema is not None:
        from compose.scenario.json_schema import json_schema  # noqa: PLC0415  # rarely needed
        from compose.sweep.spec import SpecFile  # noqa: PLC0415

        schema = json_schema(ScenarioFile if options.schema == "scenario" else SpecFile)
        say(*json.dumps(schema, indent=2).splitlines())
        return ENDED
    _list(shipped())
    say("sweeps, for `tandem sweep`:")
    _list(shipped("sweep"))
    return ENDED


def _list(files: Mapping[str, Path]) -> None:
    width = max(map(len, files))
    for name, path in files.items():
        line = f"{name:{width}} {_sentence(path.read_text(encoding='utf-8'))}"
        say(*text_width.wrapped(line, width + 1))


def _sentence(text: str) -> str:
    """Return the first sentence of the comment at the top of a file, which may span several lines."""
    comment = takewhile(lambda line: line.startswith("#"), text.splitlines())
    return re.split(r"(?<=\.) ", " ".join([line.removeprefix("#").strip() for line in comment]), maxsplit=1)[
        0
    ]
