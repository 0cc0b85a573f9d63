"""The access rules: each permission is tried with a session per role, through a router that enforces them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

import pytest
import zenoh

from compose.launch.processes import free_endpoint
from compose.network import KEYED
from protocol.network import keys, session
from protocol.network.endpoints import configured
from tests.commands import BOUND_S, tandem, until

KEYS = {
    "truth": keys.truth("r"),
    "briefing of a": keys.config("r", "a"),
    "sense of a": keys.observation("r", "a"),
    "drive of a": keys.command("r", "a"),
    "report of a to b": keys.report("r", "a", "b"),
    "beat of a": keys.tick_start("r", "a"),
    "estimate of a": keys.estimate("r", "a"),
    "world alive": keys.world_alive("r"),
    "a alive": keys.robot_alive("r", "a"),
}
MAY = {
    "agent-a": {
        ("ask", "briefing of a"),
        ("hear", "sense of a"),
        ("put", "drive of a"),
        ("put", "report of a to b"),
        ("put", "estimate of a"),
        ("see", "world alive"),
        ("show", "a alive"),
        ("see", "a alive"),
    },
    "agent-b": {
        ("hear", "report of a to b"),
        ("see", "world alive"),
    },
    "viewer": {
        ("hear", "truth"),
        ("ask", "briefing of a"),
        ("hear", "sense of a"),
        ("hear", "drive of a"),
        ("hear", "report of a to b"),
        ("hear", "estimate of a"),
        ("see", "world alive"),
        ("see", "a alive"),
    },
}
"""The complete matrix of what each role may do; everything else must fail."""


def key_functions() -> set[Callable[..., str]]:
    public = {name: one for name, one in vars(keys).items() if inspect.isfunction(one) and name[0] != "_"}
    return {one for one in public.values() if next(iter(inspect.signature(one).parameters)) == "run"}


def test_every_key_has_a_rule_and_is_tried() -> None:
    assert key_functions() == set(keys.KEY_RULES)
    whose = {"run": "r", "robot": "a", "peer": "b"}
    made = {one(*(whose[name] for name in inspect.signature(one).parameters)) for one in key_functions()}
    assert made == set(KEYS.values())


def test_every_role_of_a_rule_is_one_that_there_is() -> None:
    for key, rule in keys.KEY_RULES.items():
        there = {"world", "viewer", "robots", *inspect.signature(key).parameters} - {"run"}
        assert {rule.by, *rule.to} <= there


# --- tried at a router ----------------------------------------------------------------------------------


class Network(NamedTuple):
    """A router, and a function that opens further sessions at it."""

    open: Callable[[str], zenoh.Session]
    world: zenoh.Session
    """The session of the world, which may send and receive every key of a mission.

    It answers queries and shows a liveliness token under every key.
    """


@pytest.fixture(scope="module", params=["a router between", "the world is the router"])
def network(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    folder = tmp_path_factory.mktemp("access") / "keys"
    assert tandem("keys", folder, "--robots", "a,b").status == 0
    endpoint = free_endpoint("tls")
    with ExitStack() as stack:

        def opened(name: str) -> zenoh.Session:
            endpoints = configured(folder / name / KEYED, connect=[endpoint])
            return stack.enter_context(session.open_client(endpoints, unreachable))

        routes = "router" if request.param == "a router between" else "world"
        router = session.open_router(configured(folder / routes / KEYED, listen=[endpoint]))
        world = stack.enter_context(router)
        if routes == "router":
            world = opened("world")
        for key in {*KEYS.values(), keys.config("r", "b")}:
            world.declare_queryable(key, partial(answer, "world"))
            stack.callback(undeclare, session.show_alive(world, key))
        yield Network(opened, world)


def unreachable() -> None:
    raise AssertionError("the router does not let it in")


def answer(who: str, query: zenoh.Query) -> None:
    query.reply(query.key_expr, who)


def undeclare(declared: Any) -> None:
    declared.undeclare()


def heard(declared: Any) -> set[str]:
    """Return the keys of the samples received so far.

    A channel contains a sample as soon as it arrives; a callback would be called later.
    """
    found = set()
    while (sample := declared.try_recv()) is not None:
        found.add(str(sample.key_expr))
    return found


def answers(who: zenoh.Session, key: str) -> list[str]:
    replies = who.get(
        key, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=BOUND_S
    )
    return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]


class Participant:
    """A session of one role at the router, and the result of each operation."""

    def __init__(self, network: Network, name: str) -> None:
        self.session = network.open(name)
        self._world = network.world
        self._own = keys.config("r", name.removeprefix("agent-") if name != "viewer" else "a")
        until(lambda: answers(self.session, self._own), f"{name} is answered")

    def _settled(self) -> None:
        """Wait until everything sent by either session has passed the router.

        A query and its answer then have, too, on the same links.
        """
        assert "world" in answers(self.session, self._own)  # an answer of its own never leaves its session

    def put(self, key: str) -> bool:
        """Return whether the world receives a put of this session."""
        return self._passes(self._world, key, self.session)

    def hear(self, key: str) -> bool:
        """Return whether this session receives a put of the world."""
        return self._passes(self.session, key, self._world)

    def _passes(self, hearer: zenoh.Session, key: str, speaker: zenoh.Session) -> bool:
        declared = hearer.declare_subscriber(key)
        self._settled()
        self._settled()  # the world's declaration has passed once its first answer has
        speaker.put(key, b"?")
        self._settled()
        came = heard(declared)
        undeclare(declared)
        return bool(came)

    def answer(self, key: str) -> bool:
        """Return whether this session can answer a query of the world."""
        declared: Any = self.session.declare_queryable(key, partial(answer, "it"))
        self._settled()
        found = answers(self._world, key)
        undeclare(declared)
        return "it" in found

    def ask(self, key: str) -> bool:
        """Return whether the world answers a query of this session."""
        return answers(self.session, key) == ["world"]

    def show(self, key: str) -> bool:
        """Return whether the world sees a liveliness token of this session."""
        elsewhere = key.replace("tandem/r/", "tandem/s/")  # a run in which the world shows no token
        token = session.show_alive(self.session, elsewhere)
        self._settled()
        found = session.alive(self._world, elsewhere, BOUND_S)
        undeclare(token)
        return found == [keys.parse(elsewhere)]

    def see(self, key: str) -> bool:
        """Return whether this session sees liveliness tokens, both by query and by subscription."""
        asked = session.alive(self.session, key, BOUND_S)
        looking: Any = self.session.liveliness()
        declared = looking.declare_subscriber(key, history=True)
        came: set[str] = set()

        def told() -> bool:
            came.update(heard(declared))
            return bool(came)

        if asked:
            until(told, "who asks and is told is told unasked, too")
        self._settled()
        told()
        undeclare(declared)
        assert {keys.parse(one) for one in came} == set(asked)
        return bool(came)


@pytest.mark.parametrize("name", MAY)
def test_the_router_lets_pass_what_the_matrix_says_and_nothing_else(name: str, network: Network) -> None:
    participant = Participant(network, name)
    deeds = {deed: getattr(participant, deed) for deed in ("put", "hear", "answer", "ask", "show", "see")}
    found = {(deed, what) for what, key in KEYS.items() for deed, does in deeds.items() if does(key)}
    assert found == MAY[name]


@pytest.mark.parametrize("key", ["tandem/**", "**", "tandem/*/world/truth", "tandem/*/robot/*/observation"])
def test_a_subscription_to_many_keys_receives_nothing(key: str, network: Network) -> None:
    robot = Participant(network, "agent-b")
    declared = robot.session.declare_subscriber(key)
    robot._settled()
    for one in KEYS.values():
        network.world.put(one, b"?")
    robot._settled()
    assert heard(declared) == set()


@pytest.mark.parametrize("key", ["tandem/r/robot/*/command", "tandem/r/robot/**", "tandem/**"])
def test_a_frame_under_a_wildcard_key_reaches_no_process(key: str, network: Network) -> None:
    robot = Participant(network, "agent-b")
    declared = network.world.declare_subscriber("tandem/r/**")
    robot._settled()
    robot._settled()
    robot.session.put(key, b"?")
    robot._settled()
    came = heard(declared)
    undeclare(declared)
    assert came == set()


def test_a_robot_without_the_right_to_answer_gets_no_query(network: Network) -> None:
    robot = Participant(network, "agent-b")
    declared: Any = robot.session.declare_queryable("tandem/r/world/config/**", partial(answer, "agent-b"))
    robot._settled()
    a = Participant(network, "agent-a")
    assert answers(a.session, keys.config("r", "a")) == ["world"]
    undeclare(declared)
