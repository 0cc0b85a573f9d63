"""The known name that a mistyped one is close to."""

from __future__ import annotations

from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'name'?" for the name in `known` that is most like `word`, or nothing."""
    from difflib import get_close_matches  # noqa: PLC0415  # only where there is a mistake to be told

    close = get_close_matches(word, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""
