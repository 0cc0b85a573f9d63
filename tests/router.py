"""A Zenoh router with a configuration file and Zenoh's defaults: `python -m tests.router CONFIG`."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import zenoh

if __name__ == "__main__":
    file = Path(sys.argv[1])
    os.chdir(file.parent)  # Zenoh resolves file names in a configuration against the working directory
    zenoh.init_log_from_env_or("off")
    with zenoh.open(zenoh.Config.from_file(file)):
        print("routing", flush=True)
        signal.pause()
