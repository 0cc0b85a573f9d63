"""The rights of each role in the network, enforced by a router; a robot's certificate forges no other."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
import zenoh

from compose.launch.processes import free_endpoint
from compose.network import KEYED
from compose.scenario.scenario_file import load
from compose.view.web.live import FRAMES_AHEAD, MOST_TICKS_MISSED, ReceivedMission, RefusedFrame
from protocol.messages import (
    Cause,
    Command,
    Estimate,
    GroundTruth,
    Localised,
    Message,
    MissionEnd,
    Observation,
    Report,
    Undecided,
)
from protocol.motion import ORIGIN, Pose
from protocol.network import keys, session
from protocol.network.endpoints import configured
from protocol.network.keys import Key
from protocol.wire import MalformedFrame, encode
from tests.commands import BOUND_S, PAPER_1, Ended, TandemProcess, tandem, until

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


RUN = "mine"
LAST = 2**31
HERE = Pose(99.0, 99.0, 0.0)


def command(tick: int, robot: str, verdict: Localised | Undecided | None = None) -> Command:
    return Command(tick, robot, 1.0, 0.0, 1, "forged", verdict)


def report(tick: int, robot: str) -> Report:
    return Report(tick, robot, 1, "forged", None, 0, 0, (), 0, (), 0, 0)


FORGED: dict[str, Message] = {
    "the end": MissionEnd(0, "localised", (Cause("failed", text="forged"),)),
    "an end to come": MissionEnd(LAST, "failed", (Cause("failed", text="forged"),)),
    "the truth": GroundTruth(0, {"a": HERE, "b": HERE}),
    "b's verdict": command(0, "b", Localised(HERE)),
    "b's manoeuvre": command(0, "b"),
    "b's report": report(0, "b"),
    "b's belief": Estimate(0, "b", (HERE,), (HERE,), localised=True),
    "b's sense": Observation(0, "b", None, 1.0),
    "a's own sense": Observation(0, "a", None, 1.0),
    "a tick to come": command(LAST, "a"),
    "a report to come": report(LAST, "a"),
    "a belief to come": Estimate(LAST, "a", (HERE,), (HERE,), localised=True),
}
OF_A = (Key(keys.command, RUN, "a"), Key(keys.report, RUN, "a", "b"), Key(keys.estimate, RUN, "a"))
"""The keys on which the certificate of robot a permits frames."""


def told(received: ReceivedMission) -> dict[str, Any]:
    """Return all known data, as text."""
    known = received.known
    return {
        "ticks": repr(known.ticks),
        "end": known.end,
        "last": known.last,
        "farewells": known.final_reports,
    }


@pytest.fixture
def received() -> ReceivedMission:
    """Return a mission at tick 0, of which a message of the world has been received."""
    one = ReceivedMission(RUN)
    for robot in "ab":
        one.take(Key(keys.config, RUN, robot), encode(load("paper-1").config(robot)))
        one.take(Key(keys.observation, RUN, robot), encode(Observation(0, robot, None, 1.0)))
    return one


@pytest.mark.parametrize("what", FORGED)
@pytest.mark.parametrize("source", OF_A, ids=lambda source: str(source.kind.__name__))
def test_a_viewer_takes_nothing_of_that_from_a_robot_by_its_keys(
    what: str, source: Key, received: ReceivedMission
) -> None:
    before = told(received)
    with pytest.raises((RefusedFrame, MalformedFrame)):
        received.take(source, encode(FORGED[what]))
    assert told(received) == before


def test_a_viewer_takes_what_a_key_carries(received: ReceivedMission) -> None:
    for source, message in zip(
        OF_A, (command(0, "a"), report(0, "a"), Estimate(0, "a", (ORIGIN,), (), localised=False)), strict=True
    ):
        before = told(received)
        received.take(source, encode(message))
        assert told(received) != before
    received.take(Key(keys.truth, RUN), encode(FORGED["the truth"]))
    received.take(Key(keys.observation, RUN, "a"), encode(FORGED["the end"]))
    assert received.known.end == FORGED["the end"]


def test_the_tick_is_unknown_before_the_first_message_of_the_world(received: ReceivedMission) -> None:
    """Messages of a robot may overtake those of the world a little, but the world does not skip ticks."""
    unheard, own, observation = ReceivedMission(RUN), OF_A[0], Key(keys.observation, RUN, "a")
    unheard.take(own, encode(command(LAST, "a")))
    assert unheard.known.last == -1
    received.take(own, encode(command(FRAMES_AHEAD, "a")))
    with pytest.raises(RefusedFrame):
        received.take(own, encode(command(FRAMES_AHEAD + 1, "a")))
    with pytest.raises(RefusedFrame):
        received.take(observation, encode(Observation(MOST_TICKS_MISSED + 1, "a", None, 1.0)))
    received.take(observation, encode(Observation(MOST_TICKS_MISSED, "a", None, 1.0)))
    received.take(own, encode(command(MOST_TICKS_MISSED + FRAMES_AHEAD, "a")))
    assert received.known.last == MOST_TICKS_MISSED + FRAMES_AHEAD


def test_a_report_to_a_robot_outside_the_mission_is_refused(received: ReceivedMission) -> None:
    before = told(received)
    for peer in ("z", "a"):
        with pytest.raises(RefusedFrame, match="which is not in the mission"):
            received.take(Key(keys.report, RUN, "a", peer), encode(report(0, "a")))
    assert told(received) == before


def shown(address: str) -> dict[str, Any]:
    try:
        with urlopen(f"{address}/api/shows/{RUN}") as answer:
            found: dict[str, Any] = json.load(answer)
            return found
    except HTTPError:
        return {}


@pytest.mark.long
def test_with_one_robots_certificate_nobody_forges_end_truth_ticks_or_another_robot(tmp_path: Path) -> None:
    """The mission stays in tick 0 until b is connected. It then continues and is displayed correctly."""
    scenario, folder, endpoint = tmp_path / "paper.toml", tmp_path / "keys", free_endpoint("tls")
    scenario.write_text(PAPER_1)
    assert tandem("keys", folder, "--robots", "a,b").status == 0

    def keyed(name: str) -> tuple[str | Path, ...]:
        return "--keys", folder / name

    with ExitStack() as stack:

        def start(*arguments: str | Path) -> TandemProcess:
            return stack.enter_context(TandemProcess(*arguments))

        clock = start("world", scenario, "--run", RUN, "--listen", endpoint, *keyed("world"))
        clock.until_prints("waiting for")
        watch = start("watch", "--connect", endpoint, *keyed("viewer"))
        watch.until_prints("http://")
        address = watch.out.split()[0].rstrip("/")
        a = start("agent", "a", "--connect", endpoint, *keyed("agent-a"))
        watch.until(lambda: shown(address).get("last") == 0, "it shows tick 0")
        link = stack.enter_context(
            session.open_client(configured(folder / "agent-a" / KEYED, connect=[endpoint]), lambda: None)
        )
        for source in OF_A:
            assert source.kind is not None
            named = [name for name in source[1:] if name]
            publisher = session.publisher(link, source.kind(*named))
            heeded: list[bool] = []
            session.on_matching(publisher, heeded.append)
            until(partial(any, heeded), "the viewer listens")
            for message in FORGED.values():
                publisher.put(encode(message))
        for source in OF_A:
            assert source.kind is not None
            key = source.kind(*[name for name in source[1:] if name])
            for why in ("it names robot 'b' as its sender", "its tick is in the future"):
                watch.until_prints(f"refused a frame on {key}: {why}")
        found = shown(address)
        assert (found["last"], found["end"], found["live"]) == (0, None, True)
        listed = tandem("ps", "--connect", endpoint, *keyed("viewer"), "--json", "--timeout", "2")
        [mission] = json.loads(listed.out)["missions"]
        assert (mission["tick"], mission["outcome"]) == (0, None)
        assert all(robot["tick"] in (0, None) for robot in mission["robots"])
        b = start("agent", "b", "--connect", endpoint, *keyed("agent-b"))
        ended: list[Ended] = [one.ended() for one in (clock, a, b)]
        assert [one.status for one in ended] == [0, 0, 0], clock.err
        watch.until(lambda: shown(address)["end"] is not None, "it shows the end")
        found = shown(address)
        assert found["end"]["outcome"] == "localised"
        assert found["last"] == found["end"]["tick"] == 48
        assert "forged" not in json.dumps(found)
