"""The program `tandem`."""

import signal

for _number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(_number, signal.SIG_DFL)  # until a command says otherwise: end at once, silently

from compose.cli.main import main  # noqa: E402  # nothing slow before that

if __name__ == "__main__":
    main()
