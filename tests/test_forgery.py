"""A participant with one robot's certificate cannot forge messages of others for a viewer."""

from __future__ import annotations

import json
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

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
from tests.commands import PAPER_1, Ended, TandemProcess, tandem, until

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
