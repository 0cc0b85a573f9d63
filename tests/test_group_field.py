"""A group in hardware mode: one `tandem robot` each, with the drivers of simulated robots."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from signal import SIGINT, SIGKILL

import msgspec
import pytest

from agent.process.agent_journal import Step
from compose.launch.in_process import run_mission
from compose.launch.processes import free_endpoint
from compose.scenario.scenario_file import parse
from docs.rover import BODY
from protocol.journal import journal_file
from protocol.messages import Observation
from protocol.motion import Pose, step
from protocol.wire import MAX_FRAME_BYTES, decode
from tests.commands import (
    BOUND_S,
    SECTION_IV,
    Ended,
    TandemProcess,
    anchored,
    processes_of,
    size,
    tandem,
    until,
)
from tests.test_field import beacon, pose, told
from world.hardware.driver_journal import OfDriver, driver_journal
from world.hardware.termination import LAST_WORDS


def four(seed: int, *anchors: tuple[float, float]) -> str:
    """Return a scenario of four robots."""
    placed = [
        f'[[robot]]\nid = "{name}"\nanchor = {[*at]}\n' for name, at in zip("abcd", anchors, strict=True)
    ]
    return f'name = "four"\nseed = {seed}\n{SECTION_IV}\n{"".join(placed)}'


FAR = four(22, (17.2, 2.5), (0.4, 18.0), (3.3, 2.2), (11.7, 6.2))
"""A group in which a and d meet first; then a visits c, and d visits b. All are localised after 41 ticks."""
NEAR = four(275, (11.4, 12.4), (8.6, 5.6), (4.4, 2.7), (5.0, 9.4))
"""A group in which more than two robots are within range of each other at once."""
UNANCHORED = f"""name = "four"
seed = 24
{SECTION_IV}
area = [0.0, 0.0, 8.0, 6.0]
{anchored(a=(0.0, 0.0), b=(8.0, 1.0))}
[[robot]]
id = "c"
[[robot]]
id = "d"
"""
"""A group in which a and b meet first, and find c and d, which have no anchor, after 20 ticks."""
TOLERANT = f"""name = "four"
seed = 17
{SECTION_IV}
area = [0.0, 0.0, 7.0, 6.0]
tolerates = 1
[[robot]]
id = "a"
anchor = [0.0, 0.0]
attack = {{kind = "reframe", size = 1.0}}
{anchored(b=(7.0, 1.0), c=(3.0, 6.0), d=(1.0, 3.0))}
[[robot]]
id = "e"
[[robot]]
id = "f"
"""
"""A group in which a reports false poses to e and f, which claim theirs by others after 20 ticks."""
RATE = 4


class Group:
    """The robots of a group, each of which connects to all earlier ones."""

    def __init__(
        self, out: Path, text: str, open_ones: ExitStack, lost: Sequence[str], keys: Path | None
    ) -> None:
        """`text` is the scenario, `lost` are options of the beacon, and `keys` is the folder of the keys."""
        self._out, self._open, self._keys = out, open_ones, keys
        self._air = open_ones.enter_context(beacon(*lost))
        self.scenario = parse(text, "four")
        self._endpoints = [free_endpoint("tls" if keys else "tcp") for _ in self.scenario.robots]
        self._patience = "8" if lost else "60"
        (out / "four.toml").write_text(text)
        self.robots: dict[str, TandemProcess] = {}

    def start(self, *names: str) -> None:
        """Start these robots, with the same commands each time."""
        for name in names:
            start, place = self.scenario.robot(name).start, "abcdef".index(name)
            connect = [word for one in self._endpoints[:place] for word in ("--connect", one)]
            self.robots[name] = self._open.enter_context(
                TandemProcess(
                    *("robot", name, "--mission", self._out / "four.toml", "--driver", "docs.rover:Rover"),
                    *("--rate", str(RATE), "--out", self._out / name, "--listen", self._endpoints[place]),
                    *connect,
                    *(("--keys", self._keys / "world") if self._keys else ()),
                    *("--connect-timeout", self._patience),
                    *("--option", f"start={start.x!r},{start.y!r},{start.heading!r}"),
                    *("--option", f"beacon={self._air}", "--option", f"state={self._out / f'body-{name}'}"),
                    *("--option", "timeout=60"),
                )
            )

    def measured(self, name: str, ticks: int) -> None:
        """Wait until a robot has measured more than that number of ticks."""
        self.robots[name].until(lambda: len(steps(self._out, name)) > ticks, "some ticks are over")

    def written(self, name: str, amount: int) -> None:
        """Wait until the journal of a robot has `amount` bytes, or the robot has ended."""
        path, robot = self._out / name / f"agent-{name}.journal", self.robots[name]
        until(lambda: size(path) >= amount or not robot.running, self.said)

    def kill(self, name: str) -> None:
        """Kill all processes of a robot."""
        self.robots[name].tell(SIGKILL)
        self.robots[name].ended()
        until(lambda: not processes_of((self._out / name).resolve()), f"{name}'s agent has ended")

    def said(self) -> str:
        """Return what all robots have printed."""
        return "\n".join([f"{name}: {one.out}{one.err}" for name, one in self.robots.items()])


@contextmanager
def group(out: Path, text: str, *lost: str, keys: Path | None = None) -> Iterator[Group]:
    with ExitStack() as open_ones:
        yield Group(out, text, open_ones, lost, keys)


def pose_at_end(out: Path, robot: str) -> Pose:
    """Return the final pose of a robot: that of its claim, and what its wheels have driven since.

    A Command does not say that: the driver may have received it too late to execute it.
    """
    frames = journal_file.read(out / robot / driver_journal(robot))
    messages = [decode(frame, OfDriver, MAX_FRAME_BYTES) for frame in frames]
    later = [one.executed for one in messages if isinstance(one, Observation)]
    *_, since, _, tick = msgspec.json.decode((out / f"body-{robot}").read_bytes(), type=BODY)
    assert tick == len(later) - 1, "the state of the body is that after the last Observation"
    agent = told(out, robot)
    period, path = agent.config.mission.period, agent.path
    found = path[-1]
    for driven in (*later[len(path) :], since):
        assert driven is not None
        found = step(found, driven.v, driven.omega, period)
    return found


def all_are_localised(out: Path, four: Group) -> dict[str, Ended]:
    """Assert that all robots end localised, correctly, and that audit and replay find nothing."""
    until(lambda: not any(robot.running for robot in four.robots.values()), four.said, 3.0 * BOUND_S)
    ends = {name: robot.ended() for name, robot in four.robots.items()}
    both = out / "all"
    both.mkdir()
    for name, ended in ends.items():
        assert ended.status == 0, ended.out + ended.err
        assert f"{name}: localised after" in ended.out
        agent = told(out, name)
        assert agent.config.members
        found = pose_at_end(out, name)
        assert (found.x, found.y) == pytest.approx(pose(ended, name, "truly at")[:2], abs=1e-6)
        assert [one.observation.tick for one in agent.steps] == list(range(len(agent.steps)))
        assert tandem("replay", out / name).status == 0
        shutil.copy(out / name / f"agent-{name}.journal", both)
    audited = tandem("audit", both)
    assert audited.status == 0, audited.out
    return ends


@pytest.mark.parametrize(("text", "encrypted"), [(FAR, False), (NEAR, True)])
@pytest.mark.long
def test_four_robots_localise_in_hardware_mode(tmp_path: Path, text: str, encrypted: bool) -> None:
    """If all Commands and Reports are in time, each is localised in the same tick as in simulation."""
    keys = tmp_path / "keys" if encrypted else None
    if encrypted:
        assert tandem("keys", tmp_path / "keys", "--robots", "a,b,c,d").status == 0
    with group(tmp_path, text, keys=keys) as four:
        four.start("d", "b", "a", "c")  # in any order
        ends = all_are_localised(tmp_path, four)
    agents = {name: told(tmp_path, name) for name in four.robots}
    near = any(len(one.observation.contacts) > 1 for agent in agents.values() for one in agent.steps)
    assert near or text == FAR
    late = any(f"{name}: missed the deadline in 0 of" not in ended.out for name, ended in ends.items())
    late = late or any(one.missed for agent in agents.values() for one in agent.steps)
    simulated = run_mission(four.scenario)
    for name, agent in agents.items():
        claim, expected = agent.standing_claim, simulated.claim(name)
        assert claim is not None
        assert expected is not None
        assert late or claim[0] == expected.tick


@pytest.mark.long
def test_robots_of_a_group_that_are_killed_at_any_moment_resume(tmp_path: Path) -> None:
    """All, the first one, whose ticks the others count, two, one that waits to be visited, and all again.

    Each time, once the journals of those that are killed have that number of bytes.
    """
    with group(tmp_path, FAR) as four:
        four.start("a", "b", "c", "d")
        for killed, amount in (("abcd", 500), ("a", 2500), ("bd", 4500), ("c", 6500), ("abcd", 8500)):
            for name in killed:
                four.written(name, amount)
            for name in killed:
                four.robots[name].tell(SIGKILL)
            for name in killed:
                four.kill(name)
            before = {name: len(told(tmp_path, name).steps) for name in killed}
            four.start(*killed)
        all_are_localised(tmp_path, four)
        for name, ticks in before.items():
            # a driver that is killed may have journaled a tick that its agent has not
            resumed = [f"{name}: in run four, resumed at tick {tick}" for tick in (ticks - 1, ticks)]
            assert any(one in four.robots[name].out for one in resumed)
            assert len(told(tmp_path, name).steps) > ticks


@pytest.mark.long("slow")
def test_a_robot_that_is_killed_before_it_knows_all_results_receives_them_afterwards(tmp_path: Path) -> None:
    """The others have its result, and do not end while it is down: nobody else could tell it theirs."""
    with group(tmp_path, FAR, "--lost", "3") as four:
        four.start("a", "b", "c", "d")
        four.robots["c"].until(lambda: claims(tmp_path, "c"), "c is localised")
        said = len(steps(tmp_path, "c")) + 2
        four.robots["c"].until(lambda: len(steps(tmp_path, "c")) > said, "it has said so")
        four.kill("c")
        until(lambda: all(claims(tmp_path, name) for name in "abd"), four.said)
        end = max(len(steps(tmp_path, name)) for name in "abd") + 3 * LAST_WORDS
        until(lambda: len(steps(tmp_path, "a")) > end or not four.robots["a"].running, four.said)
        four.start("c")
        all_are_localised(tmp_path, four)


def kill_in_turn(four: Group, kills: Sequence[tuple[str, int]]) -> None:
    """Kill robots, and start them again, each time once they have measured more than that number of ticks."""
    for killed, at in kills:
        for name in killed:
            four.measured(name, at)
        for name in killed:  # once one is killed, the others measure no further ticks
            four.kill(name)
        four.start(*killed)


@pytest.mark.long
def test_robots_without_an_anchor_localise_in_hardware_mode(tmp_path: Path) -> None:
    """The robot that finds them is killed, and they are themselves, while they drive squares."""
    with group(tmp_path, UNANCHORED) as four:
        four.start("a", "b", "c", "d")
        kill_in_turn(four, (("a", 16), ("bd", 17), ("c", 18)))
        all_are_localised(tmp_path, four)
        assert all("resumed at tick" in robot.out for robot in four.robots.values())


@pytest.mark.long
def test_robots_that_tolerate_an_attacker_localise_in_hardware_mode(tmp_path: Path) -> None:
    """The attacker is killed, and then an honest finder and a robot that waits for a second one."""
    with group(tmp_path, TOLERANT) as six:
        six.start(*"abcdef")
        kill_in_turn(six, (("a", 16), ("bf", 18)))
        all_are_localised(tmp_path, six)
        assert all("resumed at tick" in six.robots[name].out for name in "abf")


@pytest.mark.long("slow")
def test_a_robot_that_is_dead_for_good_keeps_the_others_from_nothing(tmp_path: Path) -> None:
    """Robot a, whose ticks the others count, dies on the way to c: another one visits c later."""
    with group(tmp_path, FAR, "--lost", "2") as four:
        four.start("a", "b", "c", "d")
        four.robots["a"].until(lambda: claims(tmp_path, "a"), "a is localised")
        four.kill("a")
        until(lambda: all(claims(tmp_path, name) for name in "bcd"), four.said, 3.0 * BOUND_S)
        for name in "bcd":
            four.robots[name].tell(SIGINT)
        for name in "bcd":
            ended = four.robots[name].ended()
            assert ended.status == 130
            found = pose_at_end(tmp_path, name)
            assert (found.x, found.y) == pytest.approx(pose(ended, name, "truly at")[:2], abs=1e-6)


@pytest.mark.long
def test_a_robot_that_comes_late_joins_its_group(tmp_path: Path) -> None:
    """The others begin without it after the connection timeout."""
    with group(tmp_path, NEAR, "--lost", "1") as four:
        four.start("b", "c", "d")
        four.robots["b"].until(lambda: len(steps(tmp_path, "b")) > 3, "the mission has begun")
        assert "a: not connected; the mission begins" in four.said()
        four.start("a")
        all_are_localised(tmp_path, four)


def steps(out: Path, robot: str) -> Sequence[Step]:
    """Return the ticks in the journal of `robot`; none if there is no journal yet."""
    path = out / robot / f"agent-{robot}.journal"
    return told(out, robot).steps if path.exists() and size(path) else ()


def claims(out: Path, robot: str) -> bool:
    """Return whether `robot` has claimed a pose."""
    return bool(steps(out, robot)) and told(out, robot).standing_claim is not None
