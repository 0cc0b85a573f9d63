"""The entry point of the program `tandem`."""

import os
import signal

for _number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(_number, lambda *_: os._exit(130))  # until `main`, end without a traceback

from compose.cli.main import main  # noqa: E402  # after the lines above, because it takes time

__all__ = ["main"]

if __name__ == "__main__":
    main()
