"""Frame times of the page while it plays: `uv run python -m tests.frame_times RECORDING...`.

A frame time is the time in which the page draws, from the call of its animation frame to its return. It
prints the median and the 95 % quantile in ms; measure on a quiet machine.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from tests.browser import launched, until_shown, watching

FRAMES = 200
"""The number of frames that are measured."""
TIMED = """() => {
  const real = window.requestAnimationFrame.bind(window);
  window.frames_ms = [];
  window.requestAnimationFrame = (draw) => real((now) => {
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
                page.goto(f"{address}#tick=0")
                until_shown(page, 0)
                page.locator("#speed").select_option("1")
                page.evaluate(TIMED)
                page.keyboard.press("Space")
                page.wait_for_selector("#play[aria-label=Pause]")
                while page.evaluate("window.frames_ms.length") < FRAMES:
                    page.wait_for_timeout(100)
                frames = np.array(page.evaluate("window.frames_ms"))[:FRAMES]
                page.close()
            median, late = np.quantile(frames, [0.5, 0.95])
            print(f"{folder.name}: median {median:.1f} ms, 95 % {late:.1f} ms, {FRAMES} frames")


if __name__ == "__main__":
    main()
