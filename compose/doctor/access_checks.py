"""Access rules, tried for real: what must not pass a router, and whether it does.

Two sessions with one's own keys, for a router is not asked about what stays within one. What is put is put
under a run of no mission, by a name drawn for it, and is no frame that anybody could take for one: no world,
robot or page acts on it, even if it passes. In a mission that runs, the doctor only listens, and only for
what it must not hear: where rules hold, the router tells nobody that it does; where they do not, the world
says its truth for that moment, which costs a little time and changes nothing. Nothing is ever put under a
mission's keys, no sign of life is shown, and no question is answered.
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
"""how long to wait for one answer"""
LOOK_AGAIN_S = 0.01
MATCHED_S = 0.5
"""how long a world may take to learn that somebody listens to its truth"""
TICKS = 3
"""that go by after that before it counts that nothing was heard: a truth is said after the tick's Senses"""
RING = 16
"""samples that wait on a key, so that others' wildcards do not displace what is looked for"""
NO_FRAME = b"?"
RENEW = "the router must enforce the rules: start it by its zenoh.json5 as `tandem keys` left it"


class SessionPair(NamedTuple):
    """Two sessions at one router, by the same keys."""

    speaker: zenoh.Session
    hearer: zenoh.Session

    def passed(self, what: Mapping[str, str]) -> dict[str, zenoh.Sample]:
        """Of these keys, by their names: those under which what is put by one comes to the other."""
        ears: dict[str, Any] = {name: self.hearer.declare_subscriber(key) for name, key in what.items()}
        self._settle()
        for key in what.values():
            self.speaker.put(key, NO_FRAME)
        self._settle()
        came = {name: sample for name, ear in ears.items() if (sample := _under(what[name], ear)) is not None}
        for ear in ears.values():
            ear.undeclare()
        return came

    def _settle(self) -> None:
        """What either has said has passed the router: a question and its answer have, on the same links."""
        for one in (self.hearer, self.speaker, self.hearer):
            session.alive(one, keys.world_alive("*"), ASK_S)


def probe_run() -> str:
    """A name that no mission has."""
    return f"doctor-{random.SystemRandom().getrandbits(64):016x}"


def tried(pair: SessionPair, endpoints: Endpoints, wait: float) -> Iterator[Finding]:
    """What `tandem keys` gave these endpoints the right to do passes, and nothing else."""
    who = endpoints.participant
    if who is None:
        yield untried("rules: there are none to try without --keys")
    elif who in access_control.CARRIERS:
        yield untried(f"rules: the {who} may say and hear anything; try them by the keys of a robot")
    else:
        me = who.removeprefix(access_control.agent("")) if who != access_control.VIEWER else None
        other = _another(endpoints, me)
        yield from _forged(pair, who, me, other)
        if me is not None:
            for run in _runs(pair.hearer):
                yield from _overheard(pair, run, me, wait)


def _another(endpoints: Endpoints, me: str | None) -> str:
    """A robot that these keys are not of."""
    subjects = endpoints.setting("access_control/subjects") or ()
    robots = [name for one in subjects for name in one.get("cert_common_names") or () if "agent-" in name]
    others = [name.removeprefix("agent-") for name in robots if name != access_control.agent(me or "")]
    return others[0] if others else "somebody-else"


def _others(run: str, me: str, other: str) -> Iterator[tuple[str, str]]:
    """A key of each kind under which `me` puts nothing, such as robot/b/command, and the whole of it."""
    for key, rule in keys.RULES.items():
        if rule.way == "put":
            named = {"run": run, "robot": other if rule.by == "robot" else me, "peer": me}
            yield _short(whole := key(*(named[name] for name in signature(key).parameters))), whole


def _short(key: str) -> str:
    return key.split("/", 2)[2]


def _forged(pair: SessionPair, who: str, me: str | None, other: str) -> Iterator[Finding]:
    said = dict(_others(probe_run(), me or other, other))
    if passed := sorted(pair.passed(said)):
        yield fix(f"rules: {who} can put {', '.join(passed)}; {RENEW}")
    else:
        yield ok(f"rules: what {who} puts as {', '.join(sorted(said))} does not pass")
    if me is not None:
        if pair.passed({"Report": keys.report(probe_run(), me, me)}):
            yield ok(f"rules: what {who} puts as Reports of {me} passes")
        else:
            yield fix(f"rules: what {who} puts as Reports of {me} does not pass; {RENEW}, with {me} in it")


def _runs(link: zenoh.Session) -> list[str]:
    return [key.run for key in session.alive(link, keys.world_alive("*"), ASK_S)]


def _overheard(pair: SessionPair, run: str, me: str, wait: float) -> Iterator[Finding]:
    """What must not be heard of a mission that runs, while what may be is."""
    peer = _peer(pair.hearer, run, me)
    if peer is None:
        yield untried(
            f"rules: reading the truth of {run}: {me} has no part in it; try by a robot's keys that has"
        )
        return
    forbidden = {
        _short(key): key for key in (keys.truth(run), keys.command(run, peer), keys.observation(run, peer))
    }
    latest: Any = zenoh.handlers.RingChannel(RING)
    ears: dict[str, Any] = {
        name: pair.hearer.declare_subscriber(key, latest) for name, key in forbidden.items()
    }
    own: Any = pair.hearer.declare_subscriber(keys.observation(run, me), latest)
    came: set[str] = set()
    ticks: set[int] = set()
    now = time.monotonic()
    matched, until = now + MATCHED_S, now + MATCHED_S + wait
    while len(ticks) < TICKS and len(came) < len(ears) and now < until:
        time.sleep(LOOK_AGAIN_S)
        now = time.monotonic()
        if (sample := _under(keys.observation(run, me), own)) is not None and now >= matched:
            ticks |= _ticks(sample.payload.to_bytes())
        came |= {name for name, ear in ears.items() if _under(forbidden[name], ear) is not None}
    for one in (own, *ears.values()):
        one.undeclare()
    what = ", ".join(sorted(forbidden))
    if came:
        yield fix(f"rules: {access_control.agent(me)} can read {', '.join(sorted(came))} in {run}; {RENEW}")
    elif len(ticks) >= TICKS:
        yield ok(f"rules: {access_control.agent(me)} hears nothing of {what} in {run}")
    else:
        yield untried(
            f"rules: reading {what}: {run} did not move within {wait:g} s; try while it does (--connect-timeout)"
        )


def _peer(link: zenoh.Session, run: str, me: str) -> str | None:
    answer = session.ask(link, keys.config(run, me), ASK_S)
    try:
        return decode(answer, RobotConfig).peer if isinstance(answer, bytes) else None
    except MalformedFrame:
        return None


def _under(key: str, ear: Any) -> zenoh.Sample | None:
    """Return the next sample that came under `key` itself; what came under a wildcard tells nothing of it."""
    samples: Iterator[zenoh.Sample] = iter(ear.try_recv, None)
    return next((sample for sample in samples if str(sample.key_expr) == key), None)


def _ticks(frame: bytes) -> set[int]:
    try:
        return {decode(frame, Observation).tick}
    except MalformedFrame:
        return set()
