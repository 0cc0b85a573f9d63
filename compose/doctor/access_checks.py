"""Tests of a router's access rules: forbidden messages are sent, and must not pass.

The test needs two sessions with the same keys, because messages within one session do not pass the router. It
publishes under the random name of a run that does not exist, and its payload is not a frame. No world,
robot or page acts on it, even if it passes.

In a running mission, the test only subscribes, and only to keys that it must not read. If the rules are
enforced, the router does not announce the subscription. If they are not, the world publishes its ground truth
while the test lasts, which costs a little time and changes nothing. The test never publishes under keys of a
mission, declares no liveliness token and answers no query.
"""

from __future__ import annotations

import random
import time
from collections.abc import Iterator, Mapping
from inspect import signature
from typing import Any, NamedTuple

import zenoh

from compose.doctor.finding import Finding, fix, ok, untried
from protocol.messages import Observation, RobotConfig
from protocol.network import access_control, keys, session
from protocol.network.endpoints import Endpoints
from protocol.wire import MalformedFrame, decode

ASK_S = 2.0
"""Time in s to wait for one answer."""
ACCESS_POLL_S = 0.01
"""The polling interval in s."""
MATCHED_S = 0.5
"""Time in s that a world has to learn of a subscriber to its ground truth."""
TICKS = 3
"""The number of ticks without a forbidden message after which the test passes. The ground truth of a tick is
published after its Observations."""
RING = 16
"""The size of the buffer of a key in samples, so that samples under wildcards do not displace all others."""
NO_FRAME = b"?"
"""A payload that no process accepts."""
RENEW = "the router must enforce the rules: start it with the zenoh.json5 that `tandem keys` wrote"
"""The advice for a rule that is not enforced."""


class SessionPair(NamedTuple):
    """Two sessions at one router with the same keys."""

    publisher: zenoh.Session
    subscriber: zenoh.Session

    def passed(self, tested: Mapping[str, str]) -> dict[str, zenoh.Sample]:
        """Publish under each key of `tested`; return the samples that reached the other session, by name."""
        subscribers: dict[str, Any] = {
            name: self.subscriber.declare_subscriber(key) for name, key in tested.items()
        }
        self._settle()
        for key in tested.values():
            self.publisher.put(key, NO_FRAME)
        self._settle()
        received = {
            name: sample
            for name, one in subscribers.items()
            if (sample := _under(tested[name], one)) is not None
        }
        for one in subscribers.values():
            one.undeclare()
        return received

    def _settle(self) -> None:
        """Wait until earlier messages of both sessions have passed the router, with queries on its links."""
        for one in (self.subscriber, self.publisher, self.subscriber):
            session.alive(one, keys.world_alive("*"), ASK_S)


def probe_run() -> str:
    """Return the name of a run that does not exist."""
    return f"doctor-{random.SystemRandom().getrandbits(64):016x}"


def tried(pair: SessionPair, endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    """Check that the router lets pass what these keys allow, and nothing else.

    `wait` is the time in s to observe each running mission.
    """
    participant = endpoints.participant
    if participant is None:
        yield untried("rules: there are none to test without --keys")
    elif participant in access_control.CARRIERS:
        yield untried(
            f"rules: the {participant} may publish and read anything; test them with a robot's keys"
        )
    else:
        robot = (
            participant.removeprefix(access_control.agent(""))
            if participant != access_control.VIEWER
            else None
        )
        other = _another(endpoints, robot)
        yield from _publishing(pair, participant, robot, other)
        if robot is not None:
            for run in _runs(pair.subscriber):
                yield from _reading(pair, run, robot, wait)


def _another(endpoints: Endpoints, robot: str | None) -> str:
    """Return a robot other than `robot`, if possible one that the rules name."""
    subjects = endpoints.setting("access_control/subjects") or ()
    robots = [name for one in subjects for name in one.get("cert_common_names") or () if "agent-" in name]
    others = [name.removeprefix("agent-") for name in robots if name != access_control.agent(robot or "")]
    return others[0] if others else "somebody-else"


def _forbidden(run: str, robot: str, other: str) -> Iterator[tuple[str, str]]:
    """Yield a key of each kind under which `robot` must not publish, shortened and in full.

    A shortened key is robot/b/command, for example.
    """
    for key, rule in keys.KEY_RULES.items():
        if rule.way == "put":
            named = {"run": run, "robot": other if rule.by == "robot" else robot, "peer": robot}
            yield _short(full := key(*(named[name] for name in signature(key).parameters))), full


def _short(key: str) -> str:
    return key.split("/", 2)[2]


def _publishing(pair: SessionPair, participant: str, robot: str | None, other: str) -> Iterator[Finding]:
    """Check that forbidden messages do not pass, and that the robot's own Reports do."""
    tested = dict(_forbidden(probe_run(), robot or other, other))
    if passed := sorted(pair.passed(tested)):
        yield fix(f"rules: {participant} can publish {', '.join(passed)}; {RENEW}")
    else:
        yield ok(f"rules: {participant} cannot publish {', '.join(sorted(tested))}")
    if robot is not None:
        if pair.passed({"Report": keys.report(probe_run(), robot, robot)}):
            yield ok(f"rules: {participant} can publish Reports of {robot}")
        else:
            yield fix(f"rules: {participant} cannot publish Reports of {robot}; {RENEW}, with {robot} in it")


def _runs(link: zenoh.Session) -> list[str]:
    return [key.run for key in session.alive(link, keys.world_alive("*"), ASK_S)]


def _reading(pair: SessionPair, run: str, robot: str, wait: float) -> Iterator[Finding]:
    """Check that `robot` cannot read forbidden keys of a running mission while it can read its own."""
    peer = _peer(pair.subscriber, run, robot)
    if peer is None:
        yield untried(
            f"rules: reading the truth of {run}: {robot} is not in it; test with the keys of a robot that is"
        )
        return
    forbidden = {
        _short(key): key for key in (keys.truth(run), keys.command(run, peer), keys.observation(run, peer))
    }
    latest: Any = zenoh.handlers.RingChannel(RING)
    subscribers: dict[str, Any] = {
        name: pair.subscriber.declare_subscriber(key, latest) for name, key in forbidden.items()
    }
    own: Any = pair.subscriber.declare_subscriber(keys.observation(run, robot), latest)
    received: set[str] = set()
    ticks: set[int] = set()
    now = time.monotonic()
    matched, until = now + MATCHED_S, now + MATCHED_S + wait
    while len(ticks) < TICKS and len(received) < len(subscribers) and now < until:
        time.sleep(ACCESS_POLL_S)
        now = time.monotonic()
        if (sample := _under(keys.observation(run, robot), own)) is not None and now >= matched:
            ticks |= _ticks(sample.payload.to_bytes())
        received |= {name for name, one in subscribers.items() if _under(forbidden[name], one) is not None}
    for one in (own, *subscribers.values()):
        one.undeclare()
    names = ", ".join(sorted(forbidden))
    participant = access_control.agent(robot)
    if received:
        yield fix(f"rules: {participant} can read {', '.join(sorted(received))} in {run}; {RENEW}")
    elif len(ticks) >= TICKS:
        yield ok(f"rules: {participant} cannot read {names} in {run}")
    else:
        yield untried(f"rules: reading {names}: {run} had no ticks within {wait:g} s; raise --timeout")


def _peer(link: zenoh.Session, run: str, robot: str) -> str | None:
    """Return the peer of `robot`, from its configuration; None if the world does not answer with one."""
    answer = session.ask(link, keys.config(run, robot), ASK_S)
    config = decoded(answer, RobotConfig) if isinstance(answer, bytes) else None
    return config.peer if config is not None else None


def _under(key: str, subscriber: Any) -> zenoh.Sample | None:
    """Return the next sample under `key` itself; samples under wildcards say nothing about its rule."""
    samples: Iterator[zenoh.Sample] = iter(subscriber.try_recv, None)
    return next((sample for sample in samples if str(sample.key_expr) == key), None)


def _ticks(frame: bytes) -> set[int]:
    observation = decoded(frame, Observation)
    return {observation.tick} if observation is not None else set()


def decoded(frame: bytes | None, kind: Any) -> Any:
    """Return the message in a frame; None if there is no frame, or it cannot be decoded."""
    try:
        return decode(frame, kind) if frame is not None else None
    except MalformedFrame:
        return None
