"""One robot's mind, and the process that it runs in."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's sums are then the same on every machine
