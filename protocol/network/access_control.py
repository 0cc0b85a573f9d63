"""The rules of protocol/network/keys.py as a Zenoh router enforces them, by the common name of a certificate.

A router passes on what others say, and so may the world: these two may say anything of a mission.
Robots and viewers may do what a rule allows them, and nothing else. What is declared tells who listens where;
a robot is told so for every key of a kind that it uses, for without it would believe that nobody listens.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from protocol.network import keys

ROUTER = "router"
WORLD = "world"
VIEWER = "viewer"
CARRIERS = (ROUTER, WORLD)
"""who passes on what others say"""


class Passing(NamedTuple):
    """A message that passes a router: "ingress" from a participant, "egress" to one."""

    flow: str
    message: str
    every: bool = False
    """under any key of the kind, not one's own alone: it tells who listens or answers"""


BY = {
    "put": (Passing("ingress", "put"), Passing("egress", "declare_subscriber", every=True)),
    "answer": (
        Passing("ingress", "declare_queryable"),
        Passing("egress", "query"),
        Passing("ingress", "reply"),
    ),
    "show": (Passing("ingress", "liveliness_token"),),
}
"""what passes for whoever does it, by the way of a rule"""
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
"""what passes for whoever hears it, asks, or looks for it"""


class Permit(NamedTuple):
    """A message that may pass a router, from or to one participant."""

    flow: str
    message: str
    key: str


def agent(robot: str) -> str:
    """The common name of a robot's certificate."""
    return f"agent-{robot}"


def permits(participant: str) -> set[Permit]:
    """All that a robot ("agent-ID") or a viewer may say and be told."""
    return {
        Permit(one.flow, one.message, _key(key, {}) if one.every else own)
        for key, rule in keys.RULES.items()
        for roles, passing in (((rule.by,), BY), (rule.to, TO))
        for own in _own(key, roles, participant)
        for one in passing[rule.way]
    }


def _own(key: Callable[..., str], roles: Iterable[str], participant: str) -> Iterator[str]:
    """The keys of a kind under which `participant` has one of these roles."""
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
    """The part `access_control` of a Zenoh configuration, for a router that these robots may reach."""
    messages = sorted({one.message for ways in (BY, TO) for passing in ways.values() for one in passing})
    rules = [_rule("carried", ["ingress", "egress"], messages, [f"{keys.ROOT}/**"])]
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
