"""`tandem scenarios`"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from compose.scenario import shipped
from compose.status import ENDED


def main(_options: argparse.Namespace) -> int:
    """List the scenarios and the campaigns that ship, with the first line of each."""
    _list(shipped())
    print("campaigns, for `tandem sweep`:")
    _list(shipped("sweeps"))
    return ENDED


def _list(files: Mapping[str, Path]) -> None:
    for name, path in files.items():
        first = path.read_text(encoding="utf-8").splitlines()[0]
        print(f"{name:10} {first.removeprefix('# ')}")
