"""`tandem scenarios`"""

from __future__ import annotations

import argparse

from compose.scenario import shipped
from compose.status import ENDED


def main(_options: argparse.Namespace) -> int:
    """List the scenarios that ship, with the first line of each."""
    for name, path in shipped().items():
        first = path.read_text(encoding="utf-8").splitlines()[0]
        print(f"{name:10} {first.removeprefix('# ')}")
    return ENDED
