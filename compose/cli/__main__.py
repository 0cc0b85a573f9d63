"""The entry point of the program `tandem`."""

import signal

for _number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(_number, signal.SIG_DFL)  # until a command sets its handlers, end without a traceback

from compose.cli.main import main  # noqa: E402  # after the lines above, because it takes time

__all__ = ["main"]

if __name__ == "__main__":
    main()
