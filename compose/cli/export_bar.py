"""An export with a progress bar, which a signal stops."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from compose.recording.run import read, user_errors
from compose.terminal.outcome import counting
from protocol.network.inbox import Inbox

if TYPE_CHECKING:
    from compose.view.export.folder import Exported

MODULES = ("foxglove", "pyarrow")
"""The optional libraries that an export needs; the caller checks that they are installed."""


def exported(folder: Path, out: Path, inbox: Inbox, *, quiet: bool = False) -> Exported:
    """Export the recording in `folder` to `out`, with a progress bar unless `quiet`.

    Raises UserError if a file cannot be read or written, and Interrupted if `inbox` stops the export.
    """
    from compose.view.export.folder import FILES, export  # noqa: PLC0415  # slow to import, and optional

    with user_errors(folder), counting("tandem export", 0 if quiet else len(FILES)) as done:
        return export(read(folder), out, done=done, check=lambda: inbox.next(0.0))
