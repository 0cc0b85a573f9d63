"""Topics of ROS 2 over a Zenoh session: as zenoh-bridge-ros2dds maps them, or as rmw_zenoh itself does.

The bridge maps a topic to the key of the same name. rmw_zenoh has the domain, the type and its hash in the
key, and an attachment to each message; it knows publishers and subscribers by liveliness tokens
(https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md).
"""

from __future__ import annotations

import itertools
import struct
import time
from collections.abc import Callable
from hashlib import blake2b
from typing import Any, Literal

import zenoh
from rosbags.typesys import Stores, get_typestore

from protocol.network import session

HUMBLE, JAZZY = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS2_JAZZY)
"""The types of two distributions. In Jazzy, a sensor_msgs/Range has a variance."""
QOS = "::,10:,:,:,,"
"""The quality of service in a token: reliable and volatile, with the last 10 messages."""
GID_BYTES = 16
"""The length of the number of a publisher."""


def decoded(payload: bytes, kind: str) -> Any:
    """Return the message of this type in CDR, of either distribution. Raises ValueError."""
    try:
        try:
            return HUMBLE.deserialize_cdr(payload, kind)
        except Exception:  # noqa: BLE001  # the library raises all kinds of errors for malformed bytes
            return JAZZY.deserialize_cdr(payload, kind)
    except Exception as error:  # noqa: BLE001  # as above
        raise ValueError(f"not a {kind}: {error}") from None


def rmw_type(kind: str) -> str:
    """Return the two parts of a key of rmw_zenoh that name a type: its name in DDS, and its hash."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_/{JAZZY.hash_rihs01(kind)}"


class RosTopics:
    """The topics of one node in a session."""

    def __init__(self, link: zenoh.Session, node: str, domain: str = "") -> None:
        """Publish as `node` in the `domain` of rmw_zenoh; by default through a bridge, which has no nodes."""
        self._link, self._node, self._domain = link, node, domain
        self._numbers = itertools.count(1)
        self._tokens: list[zenoh.LivelinessToken] = []
        if domain:
            self._show(f"0/0/NN/%/%/{node}")

    def publisher(self, topic: str, kind: str) -> Callable[[bytes], None]:
        """Return a function that publishes a message of this type, in CDR."""
        if not self._domain:
            return session.publisher(self._link, topic).put
        out = session.publisher(self._link, f"{self._domain}/{topic.strip('/')}/{rmw_type(kind)}")
        gid = blake2b(self._announce("MP", topic, kind).encode(), digest_size=GID_BYTES).digest()
        numbers = itertools.count(1)

        def put(payload: bytes) -> None:
            head = struct.pack("<qqB", next(numbers), time.time_ns(), GID_BYTES)
            out.put(payload, attachment=head + gid)

        return put

    def subscribe(self, topic: str, kind: str, take: Callable[[bytes], None]) -> None:
        """Call `take` with each message, in CDR, on a thread of Zenoh."""
        key = topic
        if self._domain:
            self._announce("MS", topic, kind)
            name, _, _ = rmw_type(kind).partition("/")
            key = f"{self._domain}/{topic.strip('/')}/{name}/*"  # the hash is that of any distribution
        self._link.declare_subscriber(key, lambda sample: take(sample.payload.to_bytes()))

    def _announce(self, entity: Literal["MP", "MS"], topic: str, kind: str) -> str:
        name = "%" + topic.strip("/").replace("/", "%")
        return self._show(f"0/{next(self._numbers)}/{entity}/%/%/{self._node}/{name}/{rmw_type(kind)}/{QOS}")

    def _show(self, rest: str) -> str:
        """Declare a liveliness token, and return its key."""
        key = f"@ros2_lv/{self._domain}/{self._link.zid()}/{rest}"
        self._tokens.append(session.show_alive(self._link, key))
        return key
