"""An export as commands make it: with a bar, and no longer than until they are told to stop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from compose.recording.run import legible
from compose.terminal.outcome import counting
from protocol.network.inbox import Inbox

if TYPE_CHECKING:
    from compose.view.export.folder import Exported

MODULES = ("foxglove", "pyarrow")
"""that it needs; whoever calls has made sure of them"""


def exported(folder: Path, out: Path, inbox: Inbox, *, quiet: bool = False) -> Exported:
    """What `compose.view.export.folder.export` does. Raises UserError; Interrupted when `inbox` says so."""
    from compose.view.export.folder import FILES, export  # noqa: PLC0415  # slow, and there may be no extra

    with legible(folder), counting("tandem export", 0 if quiet else len(FILES)) as done:
        return export(folder, out, done=done, check=lambda: inbox.next(0.0))
