"""The command with which this process was started, so that the commands that Tandem prints can be copied."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path


def program(name: str, folder: Path | None = None) -> str:
    """Return the words that start `name`, "tandem" or "python", in a shell in `folder` [default: this one].

    They are `uv run` and the name if uv has started this process, else the name alone if it is on the PATH.
    """
    if "UV_RUN_RECURSION_DEPTH" in os.environ:  # set by `uv run`
        project = Path(sys.prefix).parent
        inside = (folder or Path()).resolve().is_relative_to(project)
        elsewhere = (project / "pyproject.toml").exists() and not inside
        return f"uv run --project {shlex.quote(str(project))} {name}" if elsewhere else f"uv run {name}"
    found = shutil.which(name)
    if found is not None and Path(found).parent == Path(sys.executable).parent:
        return name
    here = shlex.quote(sys.executable)
    return f"{here} -m {name}" if name != "python" else here
