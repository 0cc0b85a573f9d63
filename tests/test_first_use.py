"""Several threads may be the first that decode a type. By itself, msgspec then crashes the process."""

from __future__ import annotations

import subprocess
import sys

AT_ONCE = """
import sys, threading
sys.setswitchinterval(1e-7)
begin, ended = threading.Barrier(4), []

def first():
    begin.wait()
    decode_all()
    ended.append(True)

threads = [threading.Thread(target=first) for _ in range(4)]
for one in threads:
    one.start()
for one in threads:
    one.join()
print(len(ended))
"""
FRAMES = """
from protocol.wire import decode, encode
from tests.examples import EXAMPLES

frames = [(encode(one), type(one)) for one in EXAMPLES]

def decode_all():
    for frame, kind in frames:
        decode(frame, kind)
"""


def of_four_threads(code: str) -> tuple[int, str]:
    """Return the exit status of a new process, and how many of its threads could run `decode_all`."""
    ended = subprocess.run(
        [sys.executable, "-c", code + AT_ONCE], stdout=subprocess.PIPE, check=False, timeout=60.0
    )
    return ended.returncode, ended.stdout.decode().strip()


def test_several_threads_can_be_the_first_that_decode_messages() -> None:
    for _ in range(3):
        assert of_four_threads(FRAMES) == (0, "4")
