"""One robot: its planner, its estimator, its view of the peer, and the process that runs them."""

import os

# With one thread, the order of summation in numpy does not depend on the machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
