"""Firefox as Playwright starts it, though it may be older than Playwright: `apt-get install firefox-esr`.

Playwright drives Firefox by WebDriver BiDi and, for every page, sends commands that Firefox 140 does not
know, about the bodies of responses, downloads, screens and the like, which the tests do not use. This program
starts Firefox, passes all messages on, and answers that such a command has succeeded.
"""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import signal
import sys
from functools import partial
from typing import Any

from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve

WRITTEN = b"WebDriver BiDi listening on "


async def main() -> int:
    """Run Firefox with this program's arguments, and return its exit status."""
    found = shutil.which("firefox-esr") or shutil.which("firefox")
    assert found is not None
    firefox = await asyncio.create_subprocess_exec(
        found, *sys.argv[1:], stderr=asyncio.subprocess.PIPE, limit=2**24
    )
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, firefox.terminate)
    assert firefox.stderr is not None
    async for line in firefox.stderr:
        listening = re.search(WRITTEN + rb"(ws://\S+)", line)
        if listening is None:
            continue
        address = listening[1].decode()
        passing = partial(_pass_on, address)
        async with serve(passing, "127.0.0.1", 0, max_size=None) as server:
            host, port = server.sockets[0].getsockname()
            print(f"{WRITTEN.decode()}ws://{host}:{port}", file=sys.stderr, flush=True)
            async for _ in firefox.stderr:
                pass
    return await firefox.wait()


async def _pass_on(address: str, playwright: ServerConnection) -> None:
    """Pass messages on between Playwright and Firefox until one of them ends the connection."""
    async with connect(f"{address}/session", max_size=None) as firefox:

        async def answers() -> None:
            async for message in firefox:
                await playwright.send(_known(message))
            await playwright.close()

        answering = asyncio.create_task(answers())
        async for message in playwright:
            await firefox.send(message)
        answering.cancel()


def _known(message: str | bytes) -> str | bytes:
    """Return the answer to a command; that it has succeeded, if Firefox does not know it."""
    answer: dict[str, Any] = json.loads(message)
    if answer.get("error") not in ("unknown command", "unknown method"):
        return message
    return json.dumps({"type": "success", "id": answer["id"], "result": {"collector": "none"}})


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
