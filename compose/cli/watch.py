"""`tandem watch`: a page on which a run is watched."""

from __future__ import annotations

import argparse
import errno
import ipaddress
import os
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from compose.errors import ENDED, UserError
from compose.extras import need
from compose.launch.viewers import OVER
from protocol.output import say

if TYPE_CHECKING:
    from compose.view.web.site import Site

NICENESS = 10
"""the mission's processes come first"""


def main(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    need("starlette", "uvicorn")
    from compose.view.web import server, site  # noqa: PLC0415  # there may be no extra

    if options.recording is None:
        from compose.network import places  # noqa: PLC0415  # a record needs no network

        shown = site.of_network(places(options))
    elif options.connect or options.config or options.keys:
        flag = "--connect" if options.connect else "--config" if options.config else "--keys"
        raise UserError(f"{flag}: a record needs no network; leave out one of the two")
    else:
        shown = site.of_record(options.recording) if options.launched else site.of_folder(options.recording)
    for note in shown.notes:
        say(f"tandem watch: {note}", error=True)
    try:
        taken = server.bound(options.port or 0, options.address)
    except server.CannotServe as error:
        what = f"--address: {options.address}"
        if error.errno != errno.EADDRNOTAVAIL:
            what = f"--port: {options.port}"
        raise UserError(f"{what} cannot be had: {error.strerror}") from None
    if not ipaddress.ip_address(options.address).is_loopback:
        say(f"tandem watch: --address: whoever reaches {options.address} can watch", error=True)
    if shown.waiting:
        os.nice(NICENESS)

    def ready(stop: Callable[[], None]) -> None:
        if options.launched:
            threading.Thread(target=_follow_launcher, args=(shown, stop), daemon=True).start()
        say(server.address(taken) if options.launched else f"{server.address(taken)} until Ctrl-C")

    shown.start()
    try:
        server.serve(shown, taken, ready)
    finally:
        shown.stop()
    return ENDED


def _follow_launcher(shown: Site, stop: Callable[[], None]) -> None:
    """The launcher says when the mission is over, and holds standard input open as long as the page stays."""
    while said := os.read(0, 64):
        if OVER in said:
            shown.concluded()
    stop()
