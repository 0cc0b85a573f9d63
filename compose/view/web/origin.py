"""Requests that a foreign web page makes through the user's browser, recognised by their Host and Origin.

A browser says in Origin which page asks, and no page can change that. A page whose own name is made to lead
here (DNS rebinding) says that name in Host. A program that is no browser sends no Origin.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Collection, Sequence


def refusal(hosts: Sequence[str], origins: Sequence[str], allowed: Collection[str] = ()) -> str | None:
    """Return why a request is refused, in a line; none if it is not.

    `hosts` and `origins` are the values of these headers in the request; `allowed` are the origins of other
    pages that may ask.
    """
    if len(hosts) != 1 or not _is_here(hosts[0]):
        return "this server is asked for by its address, or as localhost (Host)"
    own = (f"http://{hosts[0]}", f"https://{hosts[0]}")
    if len(origins) > 1 or any(origin not in (*own, *allowed) for origin in origins):
        return "pages of this origin may not ask (Origin)"
    return None


def _is_here(host: str) -> bool:
    """Whether `host` is localhost or an address, to which no foreign name can lead."""
    name = re.sub(r":[0-9]*$", "", host).lower()
    if name == "localhost":
        return True
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True
