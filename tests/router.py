"""A Zenoh router by a configuration alone, with Zenoh's own defaults: `python -m tests.router CONFIG`."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import zenoh

if __name__ == "__main__":
    file = Path(sys.argv[1])
    os.chdir(file.parent)  # where Zenoh looks for the files that a configuration names
    zenoh.init_log_from_env_or("off")
    with zenoh.open(zenoh.Config.from_file(file)):
        print("routing", flush=True)
        signal.pause()
