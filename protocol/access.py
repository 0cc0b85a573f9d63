"""The rules of protocol/keys.py as a Zenoh router enforces them, by the common name of a certificate.

A router passes on what others say, and so may the world: these two may say anything of a mission.
Robots and viewers may do what a rule allows them, and nothing else. What is declared tells who listens where;
a robot is told so for every key of a kind that it uses, for without it would believe that nobody listens.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from protocol import keys

ROUTER = "router"
WORLD = "world"
VIEWER = "viewer"
CARRIERS = (ROUTER, WORLD)
"""who passes on what others say"""

MESSAGES = {
    "put": ("put", "declare_subscriber"),
    "answer": ("reply", "declare_queryable", "query"),
    "show": ("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
}
"""Zenoh's, of each way of a rule"""
SAID = {
    "put": (("ingress", "put"),),
    "answer": (("ingress", "declare_queryable"), ("ingress", "reply"), ("egress", "query")),
    "show": (("ingress", "liveliness_token"),),
}
"""what passes the router where one does it, under a key of its own: in from it, and out to it"""
HEARD = {
    "put": (("ingress", "declare_subscriber"), ("egress", "put")),
    "answer": (("ingress", "query"), ("egress", "reply")),
    "show": (
        ("ingress", "declare_liveliness_subscriber"),
        ("ingress", "liveliness_query"),
        ("egress", "liveliness_token"),
    ),
}
"""the same where one hears it, asks, or looks for it"""
TOLD_BY = {"put": (("egress", "declare_subscriber"),), "answer": (), "show": ()}
"""what is told to who does it, under any key of the kind: who listens"""
TOLD_TO = {"put": (), "answer": (("egress", "declare_queryable"),), "show": ()}
"""and to who asks: who answers"""


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
    found = set()
    for key, rule in keys.RULES.items():
        every = _key(key, {})
        for own in _own(key, (rule.by,), participant):
            found |= {Permit(*one, own) for one in SAID[rule.way]} | {
                Permit(*one, every) for one in TOLD_BY[rule.way]
            }
        for own in _own(key, rule.to, participant):
            found |= {Permit(*one, own) for one in HEARD[rule.way]} | {
                Permit(*one, every) for one in TOLD_TO[rule.way]
            }
    return found


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
    messages = sorted({message for way in MESSAGES.values() for message in way})
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
