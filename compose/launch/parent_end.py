"""The end of a process together with its parent, on Linux."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1
"""The option of prctl(2) for a signal on the end of the parent, from <sys/prctl.h>."""


def signal_when_parent_ends(number: signal.Signals) -> None:
    """Send `number` to this process when its parent ends; without effect on systems other than Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)


def end_with_parent(parent: int, number: signal.Signals) -> None:
    """Let the end of the process `parent` send `number` to this one; end at once if it has ended already."""
    signal_when_parent_ends(number)
    if os.getppid() != parent:
        os._exit(128 + number)
