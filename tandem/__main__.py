"""The entry point of the program `tandem`, also as `python -m tandem`."""

import sys

from tandem.clash import ModuleClash, check

try:
    check()
except ModuleClash as error:  # the modules that print and know exit statuses may be those that clash
    sys.exit(print(f"tandem: {error}", file=sys.stderr) or 2)  # noqa: T201

from compose.cli.__main__ import main

if __name__ == "__main__":
    main()
