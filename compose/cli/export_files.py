"""The files of `tandem export`, which `tandem run` writes at its end, too."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from compose.cli.recording import read_noted
from compose.recording.recording_files import user_errors
from compose.recording.run import Run
from compose.terminal.outcome import counting

if TYPE_CHECKING:
    from compose.view.export.folder import Exported

EXPORT_MODULES = ("foxglove", "pyarrow")
"""The optional libraries that an export of all files needs; the caller checks that they are installed."""


def exported(
    folder: Path,
    out: Path,
    check: Callable[[], object] = lambda: None,
    *,
    run: Run | None = None,
    quiet: bool = False,
) -> Exported:
    """Export the recording in `folder` to `out`, with a progress bar unless `quiet`.

    `check` is called repeatedly, and may raise an exception to end the export. `run` is the recording if it
    has been read already. Raises UserError if a file cannot be read or written.
    """
    from compose.view.export.folder import FILES, export  # noqa: PLC0415  # slow to import, and optional

    with user_errors(folder), counting("export", 0 if quiet else len(FILES)) as done:
        run = run or read_noted(folder, "export")
        gc.freeze()  # else each garbage collection goes through all messages again
        return export(run, out, done=done, check=check)
