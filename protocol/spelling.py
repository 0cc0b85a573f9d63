"""Suggestions for mistyped names."""

from __future__ import annotations

from collections.abc import Iterable


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return "; did you mean 'name'?" for the name in `words` that is most like `word`, or ""."""
    from difflib import get_close_matches  # noqa: PLC0415  # needed only for an error message

    names = {name.lstrip("-"): name for name in words}  # leading dashes do not count as similarity
    close = get_close_matches(word.lstrip("-"), names, n=1)
    return f"; did you mean '{names[close[0]]}'?" if close else ""
