"""The entry point of the program `tandem`, also as `python -m tandem`."""

import os
import sys


def _end(kind: type[BaseException], error: BaseException, trace: object) -> None:
    """End without a traceback after Ctrl-C, which has no handler until `compose.cli` is imported."""
    if issubclass(kind, KeyboardInterrupt):
        os._exit(130)
    sys.__excepthook__(kind, error, trace)  # type: ignore[arg-type]


sys.excepthook = _end

from tandem.clash import ModuleClash, check  # noqa: E402  # after the lines above, because it takes time

try:
    check()
except ModuleClash as error:  # the modules that print and know exit statuses may be those that clash
    sys.exit(print(f"tandem: {error}", file=sys.stderr) or 2)  # noqa: T201

from compose.cli.__main__ import main  # noqa: E402

if __name__ == "__main__":
    main()
