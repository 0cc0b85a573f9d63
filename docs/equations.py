"""The hook of mkdocs that sets equations: `$$ ... $$` in a page becomes MathML, which browsers show."""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert

BLOCK = re.compile(r"^\$\$\n(?P<latex>.*?)\n\$\$$", re.M | re.S)
"""An equation in lines of its own, as in pages on GitHub."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return the text of a page with MathML in place of its equations."""
    return BLOCK.sub(
        lambda one: f'<div class="equation">{convert(one["latex"], display="block")}</div>', markdown
    )
