"""Helpers that test the page in Debian's browser: `apt-get install chromium`.

A test that uses the fixture `opened` (tests/conftest.py) is skipped if no browser is installed. If
TANDEM_SHOTS names a folder, `shot` writes screenshots to it. If TANDEM_BROWSER is "firefox", the tests use
Firefox: `apt-get install firefox-esr`.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from playwright.sync_api import Browser, Page, Route, expect, sync_playwright

from tests.commands import BOUND_S, TandemProcess

BOUND_MS = 1000 * BOUND_S
SERVER_GONE = (
    "ERR_(CONNECTION_(REFUSED|RESET|CLOSED)|EMPTY_RESPONSE|INCOMPLETE_CHUNKED_ENCODING)"
    "|was interrupted while the page was loading"
)
"""The errors that a browser logs after a test has stopped the server.

The error depends on whether the browser was connecting, waiting for an answer, or reading one.
"""
DOCUMENT = re.compile(r"^http://127\.0\.0\.1:\d+/(one)?(#.*)?$")
"""The addresses of the page, in which other addresses of the server do not match."""
SCRUB = "(scrub, tick) => { scrub.value = tick; scrub.dispatchEvent(new Event('input')); }"
"""Moves the slider of ticks, as a user does who drags it."""
Open = Callable[..., Page]
chromium_only = pytest.mark.skipif(
    os.environ.get("TANDEM_BROWSER") == "firefox",
    reason="Firefox 140 cannot be told the system's theme or its motion, nor run scripts on a file's page, "
    "and reports neither downloads nor the bodies of requests",
)
"""The mark of tests that Playwright cannot run in Firefox."""

expect.set_options(timeout=BOUND_MS)


@contextmanager
def launched(name: str = os.environ.get("TANDEM_BROWSER", "chromium")) -> Iterator[Browser]:
    """Yield the browser `name`, chromium or firefox; skip the test if it is not installed."""
    with chromium() if name == "chromium" else firefox() as browser:
        yield browser


@contextmanager
def chromium() -> Iterator[Browser]:
    """Yield Chromium; skip the test if it is not installed."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("there is no chromium: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def firefox() -> Iterator[Browser]:
    """Yield Firefox; skip the test if it is not installed."""
    if not (shutil.which("firefox-esr") or shutil.which("firefox")):
        pytest.skip("there is no firefox: apt-get install firefox-esr")
    with TemporaryDirectory() as folder, sync_playwright() as playwright:
        started = Path(folder) / "firefox"
        program = Path(__file__).with_name("firefox.py")
        started.write_text(
            f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {shlex.quote(str(program))} "$@"\n'
        )
        started.chmod(0o755)
        browser = playwright.firefox.launch(channel="moz-firefox", executable_path=started)
        yield browser
        browser.close()


@contextmanager
def pages(browser: Browser) -> Iterator[Open]:
    """Yield a function that opens pages, and waits until a page shows the `tick`, if there is one.

    At the end, fail if a page has logged an error, or has sent a request to any other host than the server.
    """
    complaints: list[str] = []
    hosts: set[str] = set()
    opened: list[Page] = []

    def opens(
        address: str, *, tick: int | None = None, width: int = 1280, height: int = 800, dark: bool = False
    ) -> Page:
        page = browser.new_page(
            viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
        )
        opened.append(page)
        page.on("console", lambda entry: complaints.append(entry.text) if entry.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: hosts.add(re.sub(r"^(\w+://[^/:]+).*", r"\1", request.url)))
        page.set_default_timeout(BOUND_MS)
        if browser.browser_type.name == "firefox":
            page.route(DOCUMENT, without_policy)
        page.goto(address if tick is None else f"{address}#tick={tick}")
        if tick is not None:
            until_shown(page, tick)
        return page

    yield opens
    for page in opened:
        page.close()
    unexpected = [text for text in complaints if not re.search(SERVER_GONE, text)]
    assert not unexpected, unexpected
    assert hosts <= {"http://127.0.0.1"}


def without_policy(route: Route) -> None:
    """Answer with a document without its content security policy.

    In Firefox, the policy also applies to the scripts of tests.
    """
    response = route.fetch()
    headers = {name: text for name, text in response.headers.items() if name != "content-security-policy"}
    route.fulfill(response=response, headers=headers)


@contextmanager
def watching(*arguments: str | Path) -> Iterator[tuple[TandemProcess, str]]:
    """Yield a process of `tandem watch`, and the address of its page."""
    with TandemProcess("watch", *arguments) as command:
        yield command, address_of(command)


def address_of(command: TandemProcess) -> str:
    """Return the address of the page of `command`, when it has printed it."""
    command.until_prints("http://127.0.0.1:")
    found = re.search(r"http://\S+", command.out)
    assert found is not None
    return found[0]


def until_shown(page: Page, tick: int) -> None:
    """Wait until the page shows `tick`."""
    expect(page.locator("body")).to_have_attribute("data-shown", str(tick))


def until_loaded(page: Page) -> None:
    """Wait until the page shows any tick; before that, it ignores the slider and most keys."""
    expect(page.locator("body")).to_have_attribute("data-shown", re.compile(r"\d"))


def scrub_to(page: Page, tick: int) -> None:
    """Move the slider of a loaded page to `tick`, and wait until the page shows it."""
    until_loaded(page)
    page.locator("#scrub").evaluate(SCRUB, tick)
    until_shown(page, tick)


def shot(page: Page, name: str) -> None:
    """Write a screenshot of the page if TANDEM_SHOTS is set."""
    if folder := os.environ.get("TANDEM_SHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png")


def stop_clock(page: Page) -> None:
    """Stop the clock of the page: from now on, its time passes only by `page.clock.fast_forward`."""
    page.clock.install()
    page.clock.pause_at(datetime.now(UTC) + timedelta(minutes=1))


def picture(page: Page) -> str:
    """Return the canvas as a data URL, after all pending drawing."""
    page.evaluate("() => new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    return str(page.evaluate("document.getElementById('canvas').toDataURL()"))


INKS = """() => {
  const canvas = document.getElementById('canvas'), style = getComputedStyle(document.documentElement);
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data, found = {};
  const tints = [1, 2, 3, 4].map((i) => `tint-${i}`);
  for (const name of ['ring', 'orbit', 'ghost', 'range', 'link', 'fault', 'robot-a', 'robot-b', ...tints]) {
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
    """Return the number of pixels of each named colour in the canvas, after all pending drawing."""
    picture(page)
    found: dict[str, int] = page.evaluate(INKS)
    return found
