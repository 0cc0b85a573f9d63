"""Commands forked from a process with all modules imported, for tests that only wait for the result.

A forked command behaves like one that is started by itself. `tests/commands.py` starts commands both ways.
"""

from __future__ import annotations

import os
import pkgutil
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import IO

import msgspec

import compose
from compose.cli import main
from compose.cli.warm_up import missions
from compose.launch import forked

WARM_UP = "tests.warm:warm_up"
MAIN = "tests.warm:run_command"
DRAWING = ("matplotlib.backends.backend_pdf", "matplotlib.backends.backend_svg")
"""modules that Matplotlib imports only when it writes a file"""

THREADED = "compose.view.export.rerun_recording"
"""a module whose library starts threads, which a process that forks must not have"""


WARMED = set[int]()
"""The ids of the fork servers that have imported all modules."""


class Request(msgspec.Struct, frozen=True):
    """A command line, its working directory and its environment."""

    words: list[bytes]
    """arguments as bytes, because they need not be valid text"""
    folder: str
    environment: dict[bytes, bytes]


def warm_up() -> None:
    """Import all modules that commands need, in the process that they are forked from."""
    missions()
    for module in pkgutil.walk_packages(compose.__path__, "compose."):
        if not module.name.endswith(".__main__") and module.name != THREADED:
            import_module(module.name)
    for name in DRAWING:
        import_module(name)


def warmed(within: float) -> forked.ForkServer:
    """Return the fork server after its imports, which must end `within` seconds."""
    server = forked.fork_server(WARM_UP)
    if server.pid not in WARMED:
        assert server.start("os:getpid", "the first").wait(within), f"still importing after {within:g} s"
        WARMED.add(server.pid)
    return server


def run(words: list[str], folder: Path | None, out: IO[bytes], err: IO[bytes], within: float) -> int:
    """Run `tandem WORDS` in `folder`, and return its exit status, negative if a signal killed it.

    Raises AssertionError if it runs for longer than `within` seconds.
    """
    command = Request([*map(os.fsencode, words)], str(folder or Path.cwd()), dict(os.environb))
    with tempfile.NamedTemporaryFile() as file:
        file.write(msgspec.msgpack.encode(command))
        file.flush()
        server = warmed(within)
        streams = [f"/proc/{os.getpid()}/fd/{stream.fileno()}" for stream in (out, err)]
        process = server.start(MAIN, "tandem", file.name, *streams)
        if not process.wait(within):
            process.end()
            raise AssertionError(f"still running after {within:g} s: {words}")
        if server.gone:
            raise AssertionError(f"{process.how_ended}: {words}")
    return process.end()


def run_command() -> None:
    """Run the command whose file sys.argv names, in this forked process."""
    with open(sys.argv[1], "rb") as file:
        command = msgspec.msgpack.decode(file.read(), type=Request)
    for stream, path in enumerate((os.devnull, *sys.argv[2:])):
        opened = os.open(path, os.O_WRONLY if stream else os.O_RDONLY)
        os.dup2(opened, stream)
        os.close(opened)
    os.chdir(command.folder)
    os.environb.clear()
    os.environb.update(command.environment)
    sys.argv = ["tandem", *map(os.fsdecode, command.words)]
    main.main()
