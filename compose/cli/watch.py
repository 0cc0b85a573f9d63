"""`tandem watch`: serve a web page that shows recordings or live missions."""

from __future__ import annotations

import argparse
import errno
import ipaddress
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from compose.cli.recording import note
from compose.errors import ENDED, STOPPED_STATUS, UserError
from compose.extras import need
from compose.launch.forked import launcher
from protocol.output import say

if TYPE_CHECKING:
    from compose.view.web.site import Site

NICENESS = 10
"""The niceness of the page's process, so that the processes of the mission get the CPU first.

In lockstep nobody is late, and a page with less of the CPU than a mission's process never shows what is now.
"""


def main(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    need("starlette", "uvicorn")
    from compose.view.web import server  # noqa: PLC0415  # the libraries are optional
    from compose.view.web.live import Listener  # noqa: PLC0415
    from compose.view.web.site import Site  # noqa: PLC0415

    if not options.recording:
        from compose.network import places  # noqa: PLC0415  # a recording needs no network

        shown = Site(listeners=list(map(Listener, places(options))))
    elif options.connect or options.config or options.keys:
        flag = "--connect" if options.connect else "--config" if options.config else "--keys"
        raise UserError(f"{flag}: a recording needs no network; give either DIR or {flag}")
    else:
        shown = _recorded(options.recording, options.launched)
    note("watch", shown.notes)
    try:
        taken = server.bound(options.port or 0, options.address)
    except server.CannotServe as error:
        what = f"--address: {options.address}"
        if error.errno != errno.EADDRNOTAVAIL:
            what = f"--port: {options.port}"
        raise UserError(f"{what} cannot be used: {error.strerror}") from None
    if not ipaddress.ip_address(options.address).is_loopback:
        say(f"tandem watch: --address: every machine that reaches {options.address} can watch", error=True)
    if shown.waiting and not options.lockstep:
        os.nice(NICENESS)

    def ready(stop: Callable[[], None]) -> None:
        if options.launched:
            threading.Thread(target=_follow_launcher, args=(shown, stop), daemon=True).start()
            launcher().send_bytes(server.address(taken).encode())
        else:
            say(f"{server.address(taken)} until Ctrl-C")

    shown.start()
    try:
        server.serve(shown, taken, ready)
    finally:
        shown.stop()
    return ENDED if options.launched else STOPPED_STATUS  # alone, only a signal ends it


def _recorded(folders: Sequence[Path], launched: bool) -> Site:
    """Return the content for one folder, or for two recordings side by side. Raises UserError."""
    from compose.view.web import site  # noqa: PLC0415  # the libraries are optional
    from compose.view.web.sources import Recorded  # noqa: PLC0415

    match folders:
        case [one] if launched:  # the recording need not exist yet
            return site.Site([Recorded(one.name, one, expected=True)])
        case [one]:
            return site.of_folder(one)
        case [_, _]:
            return site.of_two(folders)
    raise UserError(f"{folders[2]}: at most two recordings can be shown side by side")


def _follow_launcher(shown: Site, stop: Callable[[], None]) -> None:
    """Follow the launcher, which sends a message when the mission is over, and hangs up at the end."""
    with suppress(EOFError):
        while True:
            launcher().recv_bytes()
            shown.concluded()
    stop()
