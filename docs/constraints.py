"""Refresh the tested versions in pyproject.toml: `uv run docs/constraints.py [--check]`.

The script writes the versions of all packages in this environment to `constraint-dependencies` under
`[tool.uv]`, between the two marker lines. uv then resolves a fresh clone to these versions. Run the tests
first: the list holds the versions that were tested. With `--check` the script writes nothing, and its exit
status is 1 if a listed version is not the installed one.

To install newer versions before the refresh, delete the lines between the markers and run
`uv sync --upgrade --group dev`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping
from importlib.metadata import distributions
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
OWN = "tandem-ranging"
BEGIN = "# begin of the tested versions (uv run docs/constraints.py)\n"
END = "# end of the tested versions\n"
_BLOCK = re.compile(f"(?<={re.escape(BEGIN)}).*(?={re.escape(END)})", re.DOTALL)
_PIN = re.compile(r'"([^"]+)==([^"]+)"')
TOOLS = {"pip", "setuptools", "uv", "wheel"}
"""packages that install others, and are not part of the environment that was tested"""


def normalised(name: str) -> str:
    """Return the name of a package in the form in which names are compared (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def installed() -> dict[str, str]:
    """Return the version of every installed package, by normalised name, without Tandem and installers."""
    found = {normalised(one.metadata["Name"]): one.version for one in distributions()}
    return {name: version for name, version in sorted(found.items()) if name not in {OWN, *TOOLS}}


def pinned(project: str) -> dict[str, str]:
    """Return the versions that the text of pyproject.toml lists, by name."""
    block = _BLOCK.search(project)
    return dict(_PIN.findall(block[0])) if block is not None else {}


def refreshed(project: str, versions: Mapping[str, str]) -> str:
    """Return the text of pyproject.toml with `versions` in its list."""
    lines = "".join([f'    "{name}=={version}",\n' for name, version in versions.items()])
    return _BLOCK.sub(f"constraint-dependencies = [\n{lines}]\n", project)


def main() -> None:
    """Write the list, or compare it with what is installed."""
    parser = argparse.ArgumentParser(description="Refresh the tested versions in pyproject.toml.")
    parser.add_argument("--check", action="store_true", help="only compare; exit status 1 if they differ")
    options = parser.parse_args()
    project, versions = PROJECT.read_text(), installed()
    if not options.check:
        PROJECT.write_text(refreshed(project, versions))
        return
    wrong = [
        f"{name}: listed {version}, installed {versions[name]}"
        for name, version in pinned(project).items()
        if name in versions and versions[name] != version
    ]
    print(*wrong, sep="\n", end="\n" if wrong else "")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
