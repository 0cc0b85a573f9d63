"""`tandem init`: write the files to start from."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from importlib import resources
from pathlib import Path

from compose.errors import ENDED, UserError, writing
from compose.scenario.json_schema import json_schema
from compose.scenario.scenario_tables import ScenarioFile
from compose.sweep.spec import SpecFile
from compose.terminal.invocation import program
from protocol import files
from protocol.output import say

TEMPLATE = ".template"
"""The suffix of starter files that are Python modules of the user, and not of Tandem."""


def main(options: argparse.Namespace) -> int:
    """Write the files to start from, and print the commands that use them."""
    out: Path = options.folder
    content = starter()
    for name in content:
        if os.path.lexists(out / name):  # a link that leads nowhere is a file, too
            raise UserError(f"{out / name} already exists; choose another folder")
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        for name, text in content.items():
            files.write(out / name, text)
    say(*[str(out / name) for name in content], "", "to go on:")
    say(*[f"  {command}" for command in commands(out)])
    return ENDED


def starter() -> dict[str, str]:
    """Return the files to start from, by name."""
    place = Path(str(resources.files("compose") / "scenario" / "starter"))
    found = {path.name.removesuffix(TEMPLATE): path.read_text("utf-8") for path in sorted(place.iterdir())}
    for name, kind in (("scenario", ScenarioFile), ("sweep", SpecFile)):
        found[f"{name}.schema.json"] = json.dumps(json_schema(kind), indent=2) + "\n"
    return found


def commands(out: Path) -> list[str]:
    """Return the commands that use the files in `out`."""
    place, tandem, inside = shlex.quote(str(out)), program("tandem"), program("tandem", out)
    return [
        f"{tandem} run {place}/scenario.toml --out {place}/recording",
        f"{tandem} sweep {place}/sweep.toml --out {place}/results",
        f"{program('python')} {place}/analyse.py",
        f"(cd {place} && {inside} check-planner myplanner:MyPlanner --mission scenario.toml)",
        f"(cd {place} && {inside} check-driver myrobot:MyRobot --rate 10)",
    ]
