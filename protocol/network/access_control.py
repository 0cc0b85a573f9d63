"""The access rules of `protocol/network/keys.py` as a Zenoh configuration, which routers enforce.

A router identifies a participant by the common name of its certificate. Routers and the world forward
messages of others, so they may send any message. Robots and viewers may only do what a rule allows.

A robot also needs the declarations of subscribers and queryables, because Zenoh sends nothing if there is no
receiver. It gets them for all keys of each kind that it uses.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from protocol.network import keys

ROUTER_NAME = "router"
"""The common name in the certificate of a router."""
WORLD_NAME = "world"
"""The common name in the certificate of the world."""
VIEWER = "viewer"
"""The common name in the certificate of viewers."""
CARRIERS = (ROUTER_NAME, WORLD_NAME)
"""The participants that forward messages of others."""


class Passing(NamedTuple):
    """A kind of Zenoh message that a router lets pass."""

    flow: str
    """The direction: "ingress" from a participant, or "egress" to one."""
    message: str
    """Zenoh's name of the kind of message."""
    every: bool = False
    """True if it passes on all keys of the kind, and not only on those of the participant."""


BY = {
    "put": (Passing("ingress", "put"), Passing("egress", "declare_subscriber", every=True)),
    "answer": (
        Passing("ingress", "declare_queryable"),
        Passing("egress", "query"),
        Passing("ingress", "reply"),
    ),
    "show": (Passing("ingress", "liveliness_token"),),
}
"""The messages that pass for the participant that does the operation of a rule, by operation."""
TO = {
    "put": (Passing("ingress", "declare_subscriber"), Passing("egress", "put")),
    "answer": (
        Passing("egress", "declare_queryable", every=True),
        Passing("ingress", "query"),
        Passing("egress", "reply"),
    ),
    "show": (
        Passing("ingress", "declare_liveliness_subscriber"),
        Passing("ingress", "liveliness_query"),
        Passing("egress", "liveliness_token"),
    ),
}
"""The messages that pass for the participants that subscribe, query, or look for a token, by operation."""


class Permit(NamedTuple):
    """A permission: a kind of Zenoh message that passes a router from or to one participant."""

    flow: str
    """The direction: "ingress" from the participant, or "egress" to it."""
    message: str
    """Zenoh's name of the kind of message."""
    key: str
    """The key expression."""


def agent(robot: str) -> str:
    """Return the common name in the certificate of a robot's agent."""
    return f"agent-{robot}"


def permits(participant: str) -> set[Permit]:
    """Return all permissions of a participant: a robot ("agent-ID") or a viewer."""
    return {
        Permit(one.flow, one.message, _key(key, {}) if one.every else keys_of)
        for key, rule in keys.KEY_RULES.items()
        for roles, passing in (((rule.by,), BY), (rule.to, TO))
        for keys_of in _own(key, roles, participant)
        for one in passing[rule.way]
    }


def _own(key: Callable[..., str], roles: Iterable[str], participant: str) -> Iterator[str]:
    """Yield the key expressions of the kind `key` on which `participant` has one of these roles."""
    robot = participant.removeprefix("agent-") if participant.startswith("agent-") else None
    for role in roles:
        if role in inspect.signature(key).parameters:
            if robot is not None:
                yield _key(key, {role: robot})
        elif role == participant or (role == "robots" and robot is not None):
            yield _key(key, {})


def _key(key: Callable[..., str], named: dict[str, str]) -> str:
    return key(**{name: named.get(name, "*") for name in inspect.signature(key).parameters})


def access_control(robots: Iterable[str]) -> dict[str, Any]:
    """Return the section `access_control` of the Zenoh configuration of a router, for these robots."""
    messages = sorted({one.message for ways in (BY, TO) for passing in ways.values() for one in passing})
    rules = [_rule("carried", ["ingress", "egress"], messages, [f"{keys.KEY_ROOT}/**"])]
    policies = [{"subjects": list(CARRIERS), "rules": ["carried"]}]
    names = [VIEWER, *(agent(robot) for robot in robots)]
    for name in names:
        allowed: dict[tuple[str, str], list[str]] = {}
        for permit in sorted(permits(name)):
            allowed.setdefault((permit.flow, permit.message), []).append(permit.key)
        own = [
            _rule(f"{name} {' '.join(what)}", [what[0]], [what[1]], under) for what, under in allowed.items()
        ]
        rules += own
        policies.append({"subjects": [name], "rules": [rule["id"] for rule in own]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in (*CARRIERS, *names)],
        "policies": policies,
    }


def _rule(name: str, flows: list[str], messages: list[str], under: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": under}
