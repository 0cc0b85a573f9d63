"""A browser to look at the page with: Debian's, `apt-get install chromium`.

A test that asks for the fixture `opened` (tests/conftest.py) skips where there is none. With
TANDEM_SHOTS=DIR, `shot` leaves a picture of what a test saw there.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.commands import BOUND_S, TandemProcess

BOUND_MS = 1000 * BOUND_S
SERVER_GONE = "ERR_(CONNECTION_(REFUSED|RESET|CLOSED)|EMPTY_RESPONSE|INCOMPLETE_CHUNKED_ENCODING)"
"""What a browser says after a test has stopped the server.

Which of these it says depends on whether it was connecting, waiting for an answer, or reading one.
"""
SCRUB = "(scrub, tick) => { scrub.value = tick; scrub.dispatchEvent(new Event('input')); }"
Open = Callable[..., Page]

expect.set_options(timeout=BOUND_MS)


@contextmanager
def chromium() -> Iterator[Browser]:
    """The browser; the test skips where there is none."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("there is no chromium: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def pages(browser: Browser) -> Iterator[Open]:
    """Opens pages; in the end none must have complained, or asked anybody but the server."""
    complaints: list[str] = []
    hosts: set[str] = set()
    opened: list[Page] = []

    def opens(address: str, *, width: int = 1280, height: int = 800, dark: bool = False) -> Page:
        page = browser.new_page(
            viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
        )
        opened.append(page)
        page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: hosts.add(re.sub(r"^(\w+://[^/:]+).*", r"\1", request.url)))
        page.set_default_timeout(BOUND_MS)
        page.goto(address)
        return page

    yield opens
    for page in opened:
        page.close()
    unexpected = [said for said in complaints if not re.search(SERVER_GONE, said)]
    assert not unexpected, unexpected
    assert hosts <= {"http://127.0.0.1"}


@contextmanager
def watching(*arguments: str | Path) -> Iterator[tuple[TandemProcess, str]]:
    """`tandem watch`, and the address of its page."""
    with TandemProcess("watch", *arguments) as command:
        yield command, address_of(command)


def address_of(command: TandemProcess) -> str:
    """Where its page is, once it has said so."""
    command.until_says("http://127.0.0.1:")
    found = re.search(r"http://\S+", command.out)
    assert found is not None
    return found[0]


def until_shown(page: Page, tick: int) -> None:
    """Wait until the page shows `tick`."""
    expect(page.locator("body")).to_have_attribute("data-shown", str(tick))


def shot(page: Page, name: str) -> None:
    """Leave a picture of the page, if there is a folder for it."""
    if folder := os.environ.get("TANDEM_SHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png")


def picture(page: Page) -> str:
    """The plane, pixel by pixel, once all that was asked for is drawn."""
    page.evaluate("() => new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    return str(page.evaluate("document.getElementById('canvas').toDataURL()"))


INKS = """() => {
  const canvas = document.getElementById('canvas'), style = getComputedStyle(document.documentElement);
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data, found = {};
  for (const name of ['ring', 'orbit', 'ghost', 'range', 'link', 'fault', 'phase-1', 'phase-2', 'phase-3']) {
    const hex = style.getPropertyValue('--' + name).trim();
    const ink = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    found[name] = 0;
    for (let i = 0; i < data.length; i += 4) {
      if (data[i + 3] > 100 && ink.every((part, k) => Math.abs(data[i + k] - part) < 12)) found[name] += 1;
    }
  }
  return found;
}"""


def inks(page: Page) -> dict[str, int]:
    """How many pixels of the plane are of each of its colours, once all that was asked for is drawn."""
    picture(page)
    found: dict[str, int] = page.evaluate(INKS)
    return found
