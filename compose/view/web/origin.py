"""Protection against requests that foreign web pages make through the user's browser.

A browser sends the origin of the requesting page in the Origin header, which pages cannot change. A page
whose own host name resolves to this server (DNS rebinding) has that name in the Host header. Programs other
than browsers send no Origin.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence


def refusal(hosts: Sequence[str], origins: Sequence[str]) -> str | None:
    """Return the reason for which a request is refused, in one line; None if it is allowed.

    `hosts` and `origins` are the values of these headers in the request.
    """
    if len(hosts) != 1 or not _is_here(hosts[0]):
        return "the Host header must be an IP address or localhost"
    own = (f"http://{hosts[0]}", f"https://{hosts[0]}")
    if len(origins) > 1 or any(origin not in own for origin in origins):
        return "requests from pages of this origin are not allowed (Origin header)"
    return None


def _is_here(host: str) -> bool:
    """Return whether `host` is localhost or an IP address, which no foreign host name can imitate."""
    name = re.sub(r":[0-9]*$", "", host).lower()
    if name == "localhost":
        return True
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True
