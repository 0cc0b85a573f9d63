"""Requests that a foreign web page makes through the user's browser, recognised by their Host and Origin.

A browser says in Origin which page asks, and no page can change that. A page whose own name is made to lead
here (DNS rebinding) says that name in Host. A program that is no browser sends no Origin.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")


def refusal(
    hosts: Sequence[str], origins: Sequence[str], names: Collection[str], allowed: Collection[str] = ()
) -> str | None:
    """Return why a request is refused, in a line; none if it is not.

    `hosts` and `origins` are the values of these headers in the request; `names` are those of the server, and
    `allowed` the origins of other pages that may ask.
    """
    if len(hosts) != 1 or _name(hosts[0]) not in names:
        return "this server has no such name (Host)"
    own = (f"http://{hosts[0]}", f"https://{hosts[0]}")
    if len(origins) > 1 or any(origin not in (*own, *allowed) for origin in origins):
        return "pages of this origin may not ask (Origin)"
    return None


def _name(host: str) -> str:
    """`host` without its port."""
    name, colon, port = host.rpartition(":")
    return (name if colon and (not port or port.isdecimal()) else host).lower()
