"""Mutated frames on every key of a running mission: `python -m tests.storm 1000000`.

This is a measurement, because it takes long; `tests/test_bad_frames.py` runs a short one. An unrelated Zenoh
session puts the given number of frames, drawn from a seed and spread evenly over the ticks of a mission of
two pairs. This process replaces the agents of robots c and d: it replays their frames from the recording of
the same mission in one process. They answer a tick after its frames have been put, so the mission lasts as
long as the storm, and at most the frames of two ticks are queued anywhere.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import zenoh
from msgspec.structs import replace
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from compose.launch import in_process
from compose.recording.summary_json import leave, summary
from compose.scenario.scenario_file import load
from protocol.journal.journal_file import read
from protocol.messages import (
    Command,
    Environment,
    Estimate,
    FinalReport,
    MissionEnd,
    Observation,
    Report,
    RobotConfig,
)
from protocol.motion import Controls
from protocol.network import keys, session
from protocol.network.endpoints import at
from protocol.network.inbox import Inbox
from protocol.wire import MAX_SENT_BYTES, decode, encode
from tests.commands import BOUND_S, SECTION_IV, TandemProcess, until, world
from world.scenario import Scenario

RUN = "storm"
CALM_TICKS = 12
"""The number of ticks at the end without frames; the last frame arrives before the MissionEnd."""
LINK_BYTES = 47_000
"""The size of a huge frame, slightly below the one that breaks a low-latency link."""
AGENTS, PUPPETS = ("a", "b"), ("c", "d")
"""The robots with agents, and the robots that this process replaces."""
MOMENTS = 5
"""The number of memory measurements, from the first frame to the last."""

Treatment = Literal["refused", "passed over", "either", "unheard"]
"""The expected treatment of a frame.

`refused`: it is counted as refused. `passed over`: it belongs to another tick and is ignored. `either`: one
of these, depending on earlier frames. `unheard`: no process subscribes to its key.
"""


def scenario(distance: float) -> str:
    """Return a scenario of two pairs whose first pair has faults in both directions.

    The first pair meets late. Then a receives the reports of b late and duplicated, and b receives none of a.
    """
    return f"""
name = "storm"
seed = 3
{SECTION_IV}
[[robot]]
id = "a"
peer = "b"
anchor = [0.0, 0.0]
[[robot]]
id = "b"
peer = "a"
anchor = [{distance}, 0.0]
[[robot]]
id = "c"
peer = "d"
anchor = [0.0, 4000.0]
[[robot]]
id = "d"
peer = "c"
anchor = [10.0, 4000.0]
[[fault]]
link = "a->b"
partition = true
contact_ticks = [0, 90]
[[fault]]
link = "b->a"
delay = [0, 9]
duplicate = 0.2
"""


class Shot(NamedTuple):
    """A frame of the storm."""

    kind: str
    key: str
    frame: bytes | None
    """content; None for a deletion"""
    treatment: Treatment


class Genuine:
    """Every frame of a mission in one process without a storm, by key and tick."""

    def __init__(self, played: Scenario, folder: Path) -> None:
        recording = in_process.run_mission(played, folder)
        leave(recording, summary(recording, "in-process", None), folder)
        self.ticks = recording.ticks[-1].truth.tick
        self.final_reports = {
            robot: encode(final_report) for robot, final_report in recording.final_reports.items()
        }
        self.by_key: dict[str, dict[int, bytes]] = {}
        peers = {robot.id: robot.peer for robot in played.robots}
        for robot, peer in peers.items():
            for frame in read(folder / f"agent-{robot}.journal"):
                message: Any = decode(
                    frame,
                    Environment
                    | RobotConfig
                    | Observation
                    | Report
                    | Command
                    | Estimate
                    | MissionEnd
                    | FinalReport,
                )
                match message:
                    case Observation():
                        key = keys.observation(RUN, robot)
                    case Command():
                        key = keys.command(RUN, robot)
                    case Estimate():
                        key = keys.estimate(RUN, robot)
                    case Report() if message.robot == robot:
                        key = keys.report(RUN, robot, peer)
                    case _:
                        continue
                self.by_key.setdefault(key, {})[message.tick] = frame


class Storm:
    """A generator of frames, each drawn for the tick in which it is put."""

    def __init__(self, genuine: Genuine, seed: int) -> None:
        self._draw = random.Random(seed)
        self._genuine = genuine.by_key
        self._last = genuine.ticks
        self.acted_on = [
            key
            for one, other in (AGENTS, AGENTS[::-1])
            for key in (keys.observation(RUN, one), keys.command(RUN, one), keys.report(RUN, one, other))
        ]
        """keys on whose frames a, b or the world acts"""
        self.watched = [
            keys.truth(RUN),
            keys.config(RUN, "a"),
            keys.world_alive(RUN),
            *[key for one in AGENTS for key in (keys.estimate(RUN, one), keys.robot_alive(RUN, one))],
        ]
        """other keys of the mission, whose frames have no effect"""
        self.ghost = keys.command(RUN, "ghost")
        self.wild = [
            *(
                "**",
                "tandem/**",
                f"tandem/{RUN}/**",
                "tandem/*/robot/*/command",
                f"tandem/{RUN}/robot/*/command",
            ),
            *(f"tandem/{RUN}/robot/a/*", f"tandem/{RUN}/r$*/a/observation", "*/*/*/*/*", "**/to/*"),
            *(f"{keys.command(RUN, 'a')}/**", f"tandem/{RUN}/robot/*/**/b"),
        ]
        """wildcards that match keys in `acted_on`"""
        self.odd = [
            *("tandem", "command", f"tandem/{RUN}", f"tandem/{RUN}/robot", f"tandem/{RUN}/robot/a"),
            *(f"{key}/more" for key in self.acted_on),
        ]
        """keys with too few or too many chunks, to which no process subscribes"""
        kinds: dict[Callable[[str, int], Shot], int] = {
            self.truncated: 15,
            self.flipped: 15,
            self.swapped: 15,
            self.huge: 1,
            self.replayed: 15,
            self.old: 12,
            self.posing: 12,
            self.to_come: 12,
            self.again: 3,
            self.everywhere: 5,
            self.nowhere: 2,
            self.deleted: 5,
        }
        self._kinds, self._weights = list(kinds), list(kinds.values())

    def shot(self, tick: int) -> Shot:
        """Return the next frame to put during `tick`."""
        [kind] = self._draw.choices(self._kinds, self._weights)
        if self._draw.random() < 0.1:
            shot = kind(self._draw.choice(self.acted_on), tick)
            if keys.parse(shot.key) is not None:
                shot = shot._replace(key=self._draw.choice(self.watched), treatment="unheard")
            return shot
        return kind(self._draw.choice(self.acted_on), tick)

    def truncated(self, key: str, tick: int) -> Shot:
        frame = self._any(tick)
        return Shot("truncated", key, frame[: self._draw.randrange(len(frame))], "refused")

    def flipped(self, key: str, tick: int) -> Shot:
        frame = bytearray(self._any(tick))
        for bit in self._draw.sample(range(8 * len(frame)), self._draw.randint(1, 3)):
            frame[bit // 8] ^= 1 << bit % 8
        return Shot("bits flipped", key, bytes(frame), "refused")

    def swapped(self, key: str, tick: int) -> Shot:
        other = self._draw.choice([other for other in self._genuine if other != key])
        return Shot("of another key", key, self._of(other, tick), "refused")

    def huge(self, key: str, _: int) -> Shot:
        size = self._draw.choice([MAX_SENT_BYTES, MAX_SENT_BYTES + 1, LINK_BYTES])
        return Shot("huge", key, self._draw.randbytes(1) * size, "refused")

    def replayed(self, key: str, tick: int) -> Shot:
        """Return an unchanged old frame of the correct sender."""
        topic = _topic(key)
        old = [past for past in self._genuine[key] if past <= tick - 2] if topic == "report" else []
        if tick < 2 or (topic == "report" and not old):
            return self.truncated(key, tick)
        past = self._draw.choice(old) if old else self._draw.randrange(tick - 1)
        treatment: Treatment = "refused" if topic == "observation" else "passed over"
        return Shot(f"{topic} replayed", key, self._genuine[key][past], treatment)

    def old(self, key: str, tick: int) -> Shot:
        """Return a valid frame of a past tick that differs from the one sent then."""
        if tick < 2:
            return self.truncated(key, tick)
        past = self._draw.randrange(max(0, tick - 80), tick - 1)
        message = self._forged(key, past)
        treatments: dict[type, Treatment] = {Command: "passed over", Report: "either"}
        kind = type(message).__name__
        return Shot(f"{kind} of an old tick", key, encode(message), treatments.get(type(message), "refused"))

    def to_come(self, key: str, _: int) -> Shot:
        message = self._forged(key, self._last + self._draw.randint(3, 10 ** self._draw.randint(1, 9)))
        return Shot(f"{type(message).__name__} of a tick to come", key, encode(message), "refused")

    def posing(self, key: str, tick: int) -> Shot:
        """Return a frame on the key of one robot that names another robot."""
        robot = _robot(key)
        message = replace(self._forged(key, tick, end=False), robot="c" if robot == "a" else "a")
        if _topic(key) == "command" and self._draw.random() < 0.3:
            return Shot("from another", self.ghost, encode(replace(message, robot="ghost")), "refused")
        return Shot("from another", key, encode(message), "refused")

    def again(self, key: str, tick: int) -> Shot:
        """Return the genuine frame of this tick, unchanged."""
        frame = self._genuine[key].get(tick)
        if frame is None:
            return self.flipped(key, tick)
        return Shot("of this tick, again", key, frame, "either")

    def everywhere(self, _: str, tick: int) -> Shot:
        return Shot("on a wildcard", self._draw.choice(self.wild), self._any(tick), "refused")

    def nowhere(self, _: str, tick: int) -> Shot:
        return Shot("of too few or many chunks", self._draw.choice(self.odd), self._any(tick), "unheard")

    def deleted(self, key: str, _: int) -> Shot:
        return Shot("deletion", key, None, "refused")

    def _any(self, tick: int) -> bytes:
        return self._of(self._draw.choice(list(self._genuine)), tick)

    def _of(self, key: str, tick: int) -> bytes:
        """Return a genuine frame of `key`, of a tick shortly before `tick` if there is one."""
        genuine = self._genuine[key]
        near = max(0, tick - self._draw.randrange(100))
        return genuine[near] if near in genuine else self._draw.choice(list(genuine.values()))

    def _forged(self, key: str, tick: int, *, end: bool = True) -> Any:
        """Return a message of `tick` that no process of the mission ever sends."""
        robot, some = _robot(key), self._draw.uniform(0.01, 3.0)
        match _topic(key):
            case "observation" if end and self._draw.random() < 0.3:
                return MissionEnd(tick, "localised" if some < 1.0 else "failed")
            case "observation":
                return Observation(tick, robot, Controls(some / 3.0, some), some)
            case "command":
                return Command(tick, robot, some / 3.0, -some, 2, "storming")
            case _:
                return Report(tick, robot, 1, "storming", None, 0, 0, (), 0, (), 0, self._draw.randint(0, 1))


def _robot(key: str) -> str:
    found = keys.parse(key)
    assert found is not None
    return found.robot


def _topic(key: str) -> str:
    return {"observation": "observation", "command": "command"}.get(key.split("/")[4], "report")


class Tally:
    """The counts of frames put, and the results of the storm."""

    def __init__(self) -> None:
        self.treatments: Counter[tuple[str, Treatment]] = Counter()
        """number of frames by recipient and expected treatment"""
        self.kinds: Counter[tuple[str, str]] = Counter()
        """number of frames by kind and topic of the key"""
        self.memory: dict[str, list[float]] = {}
        """resident memory of each process in MB, MOMENTS values"""
        self.seconds = 0.0
        """duration of the storm"""
        self.statuses: list[int] = []
        self.refused: dict[str, int] = {}
        """number of frames that each process has refused"""
        self.late = 0
        """number of Commands of past ticks that the world has ignored"""
        self.outcome = ""
        self.same = False
        """true if `ticks.csv` equals that of the mission without a storm"""
        self.errors = ""
        """standard error of all processes"""

    @property
    def frames(self) -> int:
        """The number of frames put."""
        return self.kinds.total()

    def note(self, shot: Shot) -> None:
        """Count a frame that has been put."""
        for process in recipients(shot.key):
            self.treatments[process, shot.treatment] += 1
        concrete = shot.treatment != "unheard" and keys.parse(shot.key) is not None
        self.kinds[shot.kind, _topic(shot.key) if concrete else "others"] += 1

    def accounted(self, process: str) -> bool:
        """Return true if the process has refused all frames that it must, and no others than `either`."""
        must = self.treatments[process, "refused"]
        return must <= self.refused[process] <= must + self.treatments[process, "either"]


SUBSCRIBED = (
    ("world", keys.command(RUN, "*")),
    *[
        (one, key)
        for one, other in (AGENTS, AGENTS[::-1])
        for key in (keys.observation(RUN, one), keys.report(RUN, other, one))
    ],
)
"""The processes that act on frames, with the keys to which they subscribe."""


@cache
def recipients(key: str) -> Sequence[str]:
    """Return the processes that receive a frame put on `key`, once per matching subscription."""
    put = zenoh.KeyExpr(key)
    return [process for process, subscribed in SUBSCRIBED if put.intersects(zenoh.KeyExpr(subscribed))]


def rage(
    frames: int, seed: int, distance: float, folder: Path, advance: Callable[[], None] = lambda: None
) -> Tally:
    """Run a storm of `frames` frames on a mission whose anchors are `distance` m apart.

    `advance` is called after each frame.
    """
    file, out, calm = folder / "storm.toml", folder / "out", folder / "calm"
    calm.mkdir()
    file.write_text(scenario(distance))
    genuine = Genuine(load(str(file)), calm)
    tally, storm = Tally(), Storm(genuine, seed)
    with world(file, "--run", RUN, "--out", out) as (clock, endpoint), ExitStack() as others:
        agents = {
            robot: others.enter_context(
                TandemProcess("agent", robot, "--connect", endpoint, "--out", out, "-q")
            )
            for robot in AGENTS
        }
        for robot, agent in agents.items():
            agent.until_answered(robot, out)
        processes = {"world": clock, **agents}
        publishers = _publishers(others.enter_context(stranger_at(endpoint)), storm)
        stormy = genuine.ticks - CALM_TICKS
        began = time.monotonic()
        looks = iter(range(MOMENTS))
        due = next(looks)
        for tick in others.enter_context(_ticks(endpoint, genuine)):
            while tally.frames < min(frames, -(-frames * (tick + 1) // stormy)):
                if tally.frames * (MOMENTS - 1) >= due * frames:
                    _look(processes, tally)
                    due = next(looks)
                shot = storm.shot(tick)
                if shot.frame is None:
                    publishers[shot.key].declared.delete()
                else:
                    publishers[shot.key].put(shot.frame)
                tally.note(shot)
                advance()
            if tally.frames == frames and not tally.seconds:
                tally.seconds = time.monotonic() - began
                _look(processes, tally)
        tally.statuses = [process.ended().status for process in processes.values()]
        tally.errors = "".join(process.err for process in processes.values())
        totals = re.search(r"refused (\d+) frames in all(?:, and discarded (\d+))?", clock.err)
    result = json.loads((out / "summary.json").read_text())
    tally.outcome = result["outcome"]
    tally.refused = {robot: result["robots"][robot]["frames_refused"] for robot in AGENTS}
    tally.refused["world"], tally.late = (
        (int(number or 0) for number in totals.groups()) if totals else (0, 0)
    )
    tally.same = (out / "ticks.csv").read_bytes() == (calm / "ticks.csv").read_bytes()
    return tally


def stranger_at(endpoint: str) -> zenoh.Session:
    """Open a session with Zenoh's own configuration; Tandem's cannot send oversized frames."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps("client"))
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def _publishers(link: zenoh.Session, storm: Storm) -> dict[str, session.Publisher]:
    """Return a publisher for each key, after all processes have subscribed. Earlier frames would be lost."""
    subscribed = [*storm.acted_on, storm.ghost, *storm.wild]
    found = {key: session.publisher(link, key) for key in (*subscribed, *storm.watched, *storm.odd)}
    matched: dict[str, bool] = {}
    for key in subscribed:
        session.on_matching(found[key], partial(matched.__setitem__, key))
    until(lambda: all(matched.get(key) for key in subscribed), "all processes subscribe")
    return found


@contextmanager
def _ticks(endpoint: str, genuine: Genuine) -> Iterator[Iterator[int]]:
    """Yield an iterator over the ticks of the mission. PUPPETS answer a tick when the next is requested."""

    def on_no_world() -> None:
        raise AssertionError("no world")

    inbox = Inbox("storm")
    with session.open_client(at(endpoint), on_no_world) as link:
        commands = {robot: session.publisher(link, keys.command(RUN, robot)) for robot in PUPPETS}
        for robot in PUPPETS:
            session.subscribe(link, keys.observation(RUN, robot), inbox, "observation")
        tokens = [session.show_alive(link, keys.robot_alive(RUN, robot)) for robot in PUPPETS]
        yield _puppet_ticks(inbox, commands, genuine)
        del tokens


def _puppet_ticks(inbox: Inbox, commands: dict[str, session.Publisher], genuine: Genuine) -> Iterator[int]:
    latest = -1
    ended: set[str] = set()
    while len(ended) < len(PUPPETS):
        arrival = inbox.next(BOUND_S)
        assert arrival.topic == "observation", "the world sends nothing"
        robot = arrival.source.robot
        message: Observation | MissionEnd | FinalReport = decode(
            arrival.frame, Observation | MissionEnd | FinalReport
        )
        match message:
            case Observation(tick):
                if tick > latest:
                    latest = tick
                    yield tick
                commands[robot].put(genuine.by_key[keys.command(RUN, robot)][tick])
            case MissionEnd():
                commands[robot].put(genuine.final_reports[robot])
            case FinalReport():
                ended.add(robot)


def _look(processes: dict[str, TandemProcess], tally: Tally) -> None:
    for name, process in processes.items():
        status = Path(f"/proc/{process.pid}/status").read_text()
        found = re.search(r"VmRSS:\s*(\d+) kB", status)
        assert found is not None
        tally.memory.setdefault(name, []).append(int(found[1]) / 1024)


def tables(tally: Tally) -> Sequence[Table]:
    """Return tables of the frames put, their treatment, and memory."""
    topics = ("observation", "command", "report", "others")
    put = Table("kind", *topics, title="frames put, by topic of the key")
    for kind in sorted({kind for kind, _ in tally.kinds}):
        put.add_row(kind, *[f"{count:,}" if (count := tally.kinds[kind, topic]) else "" for topic in topics])
    treatments: tuple[Treatment, ...] = ("refused", "either", "passed over")
    became = Table("process", *treatments, "refused by it", title="expected treatment")
    memory = Table(
        "process", *[f"{100 * i // (MOMENTS - 1)} %" for i in range(MOMENTS)], title="resident memory, MB"
    )
    for process, sizes in tally.memory.items():
        counts = [f"{tally.treatments[process, treatment]:,}" for treatment in treatments]
        became.add_row(process, *counts, f"{tally.refused[process]:,}")
        memory.add_row(process, *[f"{size:.1f}" for size in sizes])
    return put, became, memory


def main(arguments: argparse.Namespace) -> int:
    """Run a storm, print the results, and return 0 if they are as expected."""
    console = Console()
    with tempfile.TemporaryDirectory(prefix="storm-") as folder, Progress(console=console) as progress:
        bar = progress.add_task("storm", total=arguments.frames)
        tally = rage(
            arguments.frames, arguments.seed, arguments.distance, Path(folder), lambda: progress.advance(bar)
        )
    for table in tables(tally):
        console.print(table)
    console.print(
        f"{tally.frames:,} frames in {tally.seconds:.0f} s, {tally.frames / tally.seconds:,.0f} a second; "
        f"{tally.outcome}, {'the same' if tally.same else 'A DIFFERENT'} ticks.csv; "
        f"the world ignored {tally.late:,} Commands of past ticks; statuses {tally.statuses}"
    )
    good = tally.outcome == "localised" and tally.same and all(map(tally.accounted, tally.memory))
    if not good:
        console.print(tally.errors)
    return 0 if good else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frames", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--distance", type=float, default=1000.0, help="distance of the anchors, m")
    sys.exit(main(parser.parse_args()))
