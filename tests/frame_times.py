"""Frame times of the page while it plays: `uv run python -m tests.frame_times RECORDING...`.

It prints the median and the 95 % quantile in ms of the time in which the page draws a frame, from the call
of its animation frame to its return, and of the time between two frames, at half of the mission. Measure on a
quiet machine; it also prints the load.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

from tests.browser import launched, scrub_to, until_loaded, watching

FRAMES = 200
"""The number of frames that are measured."""
TIMED = """() => {
  const real = window.requestAnimationFrame.bind(window);
  let before = null;
  window.frames_ms = [];
  window.between_ms = [];
  window.requestAnimationFrame = (draw) => real((now) => {
    if (before !== null) window.between_ms.push(now - before);
    before = now;
    const began = performance.now();
    draw(now);
    window.frames_ms.push(performance.now() - began);
  });
}"""
"""A script that measures the frames of a page from its next one on."""


def main() -> None:
    """Print a line for each recording named by the arguments."""
    with launched() as browser:
        for folder in map(Path, sys.argv[1:]):
            with watching(folder) as (_, address):
                page = browser.new_page(viewport={"width": 1280, "height": 800})
                page.goto(f"{address}#tick=999999")
                until_loaded(page)
                scrub_to(page, int(page.locator("#scrub").get_attribute("max") or 0) // 2)
                page.locator("#speed").select_option("1")
                page.evaluate(TIMED)
                page.keyboard.press("Space")
                page.wait_for_selector("#play[aria-label=Pause]")
                while page.evaluate("window.between_ms.length") < FRAMES:
                    page.wait_for_timeout(100)
                drawing, between = (
                    np.quantile(page.evaluate(f"window.{name}_ms")[:FRAMES], [0.5, 0.95])
                    for name in ("frames", "between")
                )
                page.close()
            print(
                f"{folder.name}: drawing {drawing[0]:.1f}, {drawing[1]:.1f} ms; "
                f"between frames {between[0]:.1f}, {between[1]:.1f} ms; load {os.getloadavg()[0]:.1f}"
            )


if __name__ == "__main__":
    main()
