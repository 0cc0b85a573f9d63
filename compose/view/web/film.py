"""The guided play of a recording as an animated picture, taken from the page in headless Chromium.

The clock of the page stands still between two frames, so that the frames do not depend on the
speed of the machine.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from compose.errors import UserError
from compose.view.web.standalone import PAGE, standalone_page

if TYPE_CHECKING:
    from PIL.Image import Image as Picture
    from playwright.sync_api import Page

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""The names of the program that draws the page."""
WIDTH, HEIGHT = 900, 560
"""The size of the picture in pixels."""
FRAME_MS = 250
"""The time between two frames in ms; the page lets no more pass between two of its drawings."""
LAST_MS = 3000
"""The time in ms for which the last frame is shown before the picture begins again."""
MOST_FRAMES = 1500
"""The largest number of frames: five minutes. Guided play takes about one."""
STYLE = """
header, aside, #transport button, #pace { display: none !important; }
#mission { grid-template-columns: 1fr; }
"""
"""The style that hides the parts of the page which are not the story, or are for the mouse."""
SHARES = (1.0, 0.72, 0.45, 0.2)
"""The shares of a colour of the page on its background that are colours of the picture."""
SAME = 255
"""The colour of pixels that are as in the frame before."""


def film(folder: Path) -> bytes:
    """Return the guided play of the recording in `folder` as an animated GIF.

    Raises UserError if there is not exactly one recording, or if Chromium is not installed.
    """
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise UserError("--gif needs chromium: apt-get install chromium")
    html = standalone_page(folder).html
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  # slow, and optional

    with TemporaryDirectory() as temporary, sync_playwright() as playwright:
        file = Path(temporary) / "run.html"
        file.write_text(html, encoding="utf-8")
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.clock.install(time=0)
        page.goto(file.as_uri())
        page.add_style_tag(content=STYLE)
        page.clock.pause_at(1000)
        frames = list(_frames(page))
        browser.close()
    return _gif(frames)


def _frames(page: Page) -> Iterator[bytes]:
    """Yield the frames of guided play as PNG files."""
    page.wait_for_selector("body[data-shown='0']", state="attached")
    page.keyboard.press("f")  # a camera at rest: most of the picture stays the same
    page.locator("#play").evaluate("(button) => button.click()")
    for _ in range(MOST_FRAMES):
        page.clock.fast_forward(FRAME_MS)
        yield page.screenshot()
        if page.locator("#play").get_attribute("aria-label") == "Play":
            return


def _gif(frames: list[bytes]) -> bytes:
    """Return PNG files as an animated GIF; equal frames in a row become one."""
    from PIL import Image  # noqa: PLC0415  # optional

    images: list[Picture] = []
    durations: list[int] = []
    before = b""
    for frame in frames:
        if frame == before:
            durations[-1] += FRAME_MS
            continue
        before = frame
        images.append(Image.open(BytesIO(frame)).convert("RGB"))
        durations.append(FRAME_MS)
    durations[-1] = LAST_MS
    palette = Image.new("P", (1, 1))
    palette.putpalette(_colours())
    shown = [np.asarray(image.quantize(palette=palette, dither=Image.Dither.NONE)) for image in images]
    changes = [shown[0], *[np.where(now == was, SAME, now) for was, now in pairwise(shown)]]
    first, *rest = [Image.fromarray(change.astype(np.uint8)) for change in changes]
    for image in (first, *rest):
        image.putpalette(_colours())
    file = BytesIO()
    first.save(
        file, "GIF", save_all=True, append_images=rest, duration=durations, loop=0,
        transparency=SAME, disposal=1, optimize=False,
    )  # fmt: skip
    return file.getvalue()


def _colours() -> list[int]:
    """Return the red, green and blue of the colours of the page's light theme, and of their shares."""
    theme = (PAGE / "style.css").read_text("utf-8").partition("@media")[0]
    named = {name: bytes.fromhex(colour) for name, colour in re.findall(r"--([\w-]+): #([0-9a-f]{6})", theme)}
    shades = [
        [
            round(share * part + (1.0 - share) * back)
            for part, back in zip(colour, named["paper"], strict=True)
        ]
        for colour in named.values()
        for share in SHARES
    ]
    parts = [part for shade in shades for part in shade]
    return parts + [0] * (3 * 256 - len(parts))
