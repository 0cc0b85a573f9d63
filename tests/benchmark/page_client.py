"""A client that makes the requests of an open page without a browser, as a load."""

from __future__ import annotations

import http.client
import json
import sys
import time
from contextlib import suppress
from urllib.parse import quote, urlsplit

PAGE_TIMEOUT_S = 30.0
BETWEEN_S = 0.05
"""The time in s that a page waits between two requests while the mission runs (see `page/store.js`)."""


def visit(address: str) -> None:
    """Request the updates and all scenes of the first listed mission until the server ends."""
    place = urlsplit(address).netloc
    news = http.client.HTTPConnection(place, timeout=PAGE_TIMEOUT_S)
    scenes = http.client.HTTPConnection(place, timeout=PAGE_TIMEOUT_S)
    name, last = "", -1
    while not name:
        news.request("GET", "/api/news")
        for line in news.getresponse():
            if line.startswith(b"data: ") and (shows := json.loads(line[6:]).get("list", {}).get("shows")):
                name = quote(shows[0]["name"])
                break
        news.close()
    news.request("GET", f"/api/news?show={name}")
    for line in news.getresponse():
        show = json.loads(line[6:]).get("show") if line.startswith(b"data: ") else None
        if show is None or show["last"] <= last:
            continue
        scenes.request("GET", f"/api/shows/{name}/scenes?from={last + 1}&to={show['last']}")
        last = max(last, json.loads(scenes.getresponse().read())["to"])
        time.sleep(BETWEEN_S)


def main() -> None:
    """Visit the page at the address in sys.argv."""
    with suppress(OSError, http.client.HTTPException):  # the server has ended
        visit(sys.argv[1])
