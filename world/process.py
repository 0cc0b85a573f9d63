"""The process of the world: it sends Observations and waits for Commands, which sets the pace of all robots.

In lockstep, a tick lasts until all robots have answered, and no decision depends on a timeout. In real time,
a tick lasts its period, and a robot without a Command rests for that tick.

In lockstep, the world repeats an unanswered Observation when the robot appears, and every REPEAT_S. It also
repeats that of the robot's peer, which then sends its Report again. This covers late starters, lost messages,
restarted agents and a restarted world. Every REPEAT_TO_ALL_S, the world repeats the Observations of all
robots, so that their agents do not take the link for lost.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import ExitStack
from typing import Any

import zenoh

from protocol.messages import Cause, Command, FinalReport, GroundTruth, Message, MissionEnd, Observation
from protocol.network import diagnosis, keys, session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import NO_ARRIVAL, Arrival, Inbox
from protocol.spelling import did_you_mean
from protocol.wire import encode
from world.simulation import Simulation

REPEAT_S = 0.25
"""The period in s in which an unanswered message is repeated."""
REPEAT_TO_ALL_S = 1.0
"""The period in s in which messages are repeated to all robots while one has not answered.

In hardware mode, an agent is told as often that its driver waits for other robots. It is shorter than the
time after which an agent replaces its link.
"""
JOINING_S = 0.9
"""The time in s for which a RobotConfig is reserved for a process whose liveliness token is not there yet.

An agent accepts a refusal that lasts a little longer.
"""
FINAL_REPORT_TIMEOUT_S = 2.0
"""The time in s to wait for the FinalReport of a robot that did not answer in the last tick.

In hardware mode, drivers wait as long for that of their agent.
"""


class NoAnswer(TimeoutError):
    """Robots did not answer within the timeout. The text of the error names them."""


class WorldProcess:
    """One run, over one or more sessions in turn. A session has to be attached before `run`."""

    def __init__(
        self,
        simulation: Simulation,
        run: str,
        inbox: Inbox,
        *,
        rate: float | None = None,
        timeout: float = 30.0,
        on_kill_point: Callable[[str, int], None] = lambda *_: None,
    ) -> None:
        """Run `simulation`, which may be a resumed one, under the run name `run`.

        `rate` is the speed of real time; None for lockstep. `timeout` (s) limits each wait for an answer.
        `on_kill_point` is called with the name and tick of each point at which the process can be killed.
        """
        self._run = run
        scenario = simulation.world.scenario
        self._scenario = scenario
        self._simulation = simulation
        self._on_kill_point = on_kill_point
        self._period = scenario.mission.period / rate if rate is not None else None
        self._tick_s = self._period or 0.0
        self._timeout = timeout
        self._inbox = inbox
        self._robots = [robot.id for robot in scenario.robots]
        self._peers = {one.id: one.encounter.peer if one.encounter else one.id for one in scenario.robots}
        """The peer of each robot, which repeats its Reports; in a team, it is the robot itself."""
        self._repeat = self._repeat_to_all = math.inf
        """The times of the next repetition to robots that have not answered, and to all robots."""
        self._alive: set[str] = set()
        """The robots with a liveliness token."""
        self._processes: dict[str, tuple[bytes, float]] = {}
        """The process that has the RobotConfig of each robot, and until when it is reserved for it."""
        self._answered = self._inbox.clock()
        """The time at which a robot last appeared, or sent a new answer."""
        self._late = 0
        """The number of discarded Commands of earlier ticks."""
        self._latest: dict[str, int] = {}
        """The tick of the latest Command of each robot, in time or not."""
        self._truth_wanted = False
        """True while a viewer subscribes to GroundTruth."""
        self._began: float | None = None
        """The time at which all robots had answered the first Observation."""
        self.running_s = 0.0
        """The wall time in s from `_began` to the MissionEnd."""
        self._ended: float | None = None
        """The time at which the MissionEnd was first sent."""
        self._final_reports: dict[str, FinalReport] = {}
        """The FinalReports received so far, by robot."""

    def attach(self, link: zenoh.Session, *, replaceable: bool = False) -> None:
        """Send and receive over the session `link` from now on.

        If it is `replaceable`, `run` raises LinkLost after SILENCE_S and a tick without messages, and if the
        session can only receive.
        """
        self._processes.clear()  # it is not known which of them end before the next line
        run, inbox = self._run, self._inbox
        self._check = session.LinkCheck(link, inbox, self._tick_s) if replaceable else None
        self._observation = {
            robot: session.publisher(link, keys.observation(run, robot)) for robot in self._robots
        }
        self._truth = session.publisher(link, keys.truth(run))
        session.on_matching(self._truth, self._want_truth)
        session.subscribe_directly(link, keys.command(run, "*"), inbox, "command")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), inbox)
        session.answer(link, keys.config(run, "*"), self._config)
        self._token = session.show_alive(link, keys.world_alive(run))

    def run(self) -> MissionEnd:
        """Run to the end of the mission, collect the FinalReports, and return the MissionEnd.

        Raises LinkLost if the link is lost; `run` may then be called again with another session. Raises
        Interrupted by a signal, and CannotRecord.
        """
        simulation = self._simulation
        due: float | None = None
        end = simulation.mission_end
        expected = self._robots if end is not None else []
        if simulation.tick > 0 and self._period is not None:  # a resumed run does not wait for all robots
            due = self._inbox.clock() + self._period
        try:
            while end is None:
                commands = self._answers(simulation.observations(), due)
                self._on_kill_point("command", simulation.tick)
                simulation.journal_commands(commands)
                self._on_kill_point("journal", simulation.tick)
                end = simulation.advance(commands)
                self._began = self._inbox.clock() if self._began is None else self._began
                if self._period is not None:
                    due = max((due or self._began) + self._period, self._inbox.clock())
        except NoAnswer as error:
            causes = (Cause("failed", text=str(error)),)
            end = simulation.end(MissionEnd(simulation.tick, "failed", causes))
        self._ended = self._inbox.clock() if self._ended is None else self._ended
        self.running_s = self._ended - self._began if self._began is not None else 0.0
        simulation.journal_final_reports(self._collect_final_reports(end, expected))
        self._print_missing_final_reports()
        self._put({robot: encode(final_report) for robot, final_report in simulation.final_reports.items()})
        if refused := self._inbox.refused.total():
            late = f", and discarded {self._late} Commands of earlier ticks" if self._late else ""
            self._inbox.say(f"refused {refused} frames in all{late}")
        return end

    # --- a tick ---

    def _answers(self, observations: list[Observation], due: float | None) -> dict[str, Command]:
        """Return the Command of each robot; in real time, those received until `due`, the end of the tick.

        Raises NoAnswer, LinkLost and Interrupted.
        """
        tick = self._simulation.tick
        frames = {observation.robot: encode(observation) for observation in observations}
        self._on_kill_point("observation", tick)
        self._put(frames)
        self._on_kill_point("report", tick)
        self._show_truth()
        commands: dict[str, Command] = {}
        now = self._inbox.clock()
        self._repeat, self._repeat_to_all = now + REPEAT_S, now + REPEAT_TO_ALL_S
        while due is not None or len(commands) < len(self._robots):
            arrival = self._next((self._repeat if due is None else due) - now)
            now = self._inbox.clock()
            if arrival.topic == "command":
                command = self._answer(arrival)
                if command is not None and command.robot not in commands:
                    commands[command.robot] = command
                    self._answered = now
            if arrival.topic == "alive" and arrival.source.robot in self._alive:
                self._send_missed(arrival.source.robot)
                self._put_again(frames, [arrival.source.robot])
            if due is None and now >= self._repeat:
                self._put_all_again(frames, frames.keys() - commands.keys(), now)
            if len(commands) < len(self._robots) and now - self._answered > self._timeout + self._tick_s:
                raise NoAnswer(self._who_is_missing(commands))
            if due is not None and now >= due and (arrival is NO_ARRIVAL or now >= due + self._tick_s):
                break
        return commands

    def _put(self, frames: Mapping[str, bytes]) -> None:
        for robot, frame in frames.items():
            self._observation[robot].put(frame)

    def _put_again(self, frames: Mapping[str, bytes], robots: Iterable[str]) -> None:
        """Send the `frames` of `robots` again, and those of their peers, which then repeat their Reports."""
        named = {*robots} & self._peers.keys()
        named |= {self._peers[robot] for robot in named}
        self._put({robot: frame for robot, frame in frames.items() if robot in named})

    def _put_all_again(self, frames: Mapping[str, bytes], missing: Iterable[str], now: float) -> None:
        """Repeat the `frames` of the robots that are `missing`, or of all robots if that is due."""
        self._repeat = now + REPEAT_S
        if now < self._repeat_to_all:
            self._put_again(frames, missing)
        else:
            self._repeat_to_all = now + REPEAT_TO_ALL_S
            self._put(frames)

    def _send_missed(self, robot: str) -> None:
        """Send the Observations of the ticks in which `robot` did not answer in time, in real time."""
        for observation in self._simulation.missed.get(robot, ()):
            self._observation[robot].put(encode(observation))

    def _next(self, timeout: float) -> Arrival:
        arrival = (self._check or self._inbox).next(timeout)
        robot = arrival.source.robot
        if arrival.topic == "alive" and robot in self._robots:
            if robot not in self._alive:
                self._answered = self._inbox.clock()
            self._alive.add(robot)
            if robot in self._processes:
                self._processes[robot] = self._processes[robot][0], math.inf
        elif arrival.topic == "gone":
            self._alive.discard(robot)
            if robot not in self._final_reports:
                self._processes.pop(robot, None)
        return arrival

    def _accepted(self, arrival: Arrival, kind: Any) -> Command | FinalReport | None:
        """Return the message that arrived, if it is a `kind` from the robot of its key; None if refused."""
        message: Command | FinalReport | None = self._inbox.accepted(arrival, kind)
        if message is not None and message.robot not in self._peers:
            self._inbox.refuse(arrival, f"its robot is given as '{message.robot}'")
            return None
        return message

    def _answer(self, arrival: Arrival) -> Command | None:
        """Return the Command that arrived, if it is one of this tick; None otherwise."""
        command = self._accepted(arrival, Command)
        if not isinstance(command, Command):
            return None
        if command.tick <= self._simulation.tick:
            self._latest[command.robot] = command.tick
        if command.tick == self._simulation.tick:
            return command
        if command.tick > self._simulation.tick:
            self._inbox.refuse(arrival, "its tick is in the future")
        else:
            self._late += 1
        return None

    def _who_is_missing(self, commands: Mapping[str, Command]) -> str:
        missing = [robot for robot in self._robots if robot not in commands]
        names = ", ".join(robot if robot in self._alive else f"{robot} (not connected)" for robot in missing)
        return f"no answer from {names} at tick {self._simulation.tick} for {self._timeout:g} s"

    def _print_missing_final_reports(self) -> None:
        """Print the robots without a FinalReport, and why."""
        reasons: dict[str, list[str]] = {}
        for robot in self._robots:
            if robot not in self._simulation.final_reports:
                reasons.setdefault(self._why_missing(robot), []).append(robot)
        for reason, robots in reasons.items():
            self._inbox.say(f"no FinalReport of {', '.join(robots)}: {reason}")

    def _why_missing(self, robot: str) -> str:
        latest = self._latest.get(robot)
        if robot not in self._alive:
            return "not connected" if latest is None else f"gone; the last Command was of tick {latest}"
        if latest is None:
            return "connected, but it sent no Command"
        if latest < self._simulation.tick:
            slower = "; a lower --rate leaves more time for each tick" if self._period is not None else ""
            return f"behind, at tick {latest} of {self._simulation.tick}{slower}"
        return "no answer to the MissionEnd"

    # --- outside the tick ---

    def _show_truth(self) -> None:
        if self._truth_wanted:
            truth = self._simulation.world.truth
            poses = dict(zip(self._robots, truth.poses, strict=True))
            self._truth.put(encode(GroundTruth(truth.tick, poses)))

    def _want_truth(self, wanted: bool) -> None:
        self._truth_wanted = wanted

    def _config(self, robot: str, process: bytes) -> Message | str:
        """Return the RobotConfig of `robot`, which is then reserved for `process`, or why it is refused."""
        if robot not in self._robots:
            near = did_you_mean(robot, self._robots)
            return f"this world has no robot '{robot}'; it has {', '.join(self._robots)}{near}"
        if process:
            now = self._inbox.clock()
            holder, until = self._processes.get(robot, (process, now))
            if holder != process and now < until:
                return session.occupied(robot, self._run)
            self._processes[robot] = process, now + JOINING_S
        return self._scenario.config(robot, self._period)

    def _collect_final_reports(self, end: MissionEnd, expected: Collection[str]) -> list[FinalReport]:
        """Send `end` to all robots until they have answered or are gone, and return the FinalReports.

        Robots that answered in the last tick are waited for up to the timeout, because they may be restarted.
        The `expected` ones and all others that are connected are waited for up to FINAL_REPORT_TIMEOUT_S.
        """
        frames = dict.fromkeys(self._robots, encode(end))
        received = self._final_reports = {**self._simulation.final_reports, **self._final_reports}
        now = self._inbox.clock()
        began = self._ended or now
        self._repeat = self._repeat_to_all = now
        printed = False
        while True:
            required = set(self._simulation.last_answered) - received.keys()
            others = self._alive.union(expected) - received.keys()
            give_up = began + (self._timeout if required else FINAL_REPORT_TIMEOUT_S)
            if now >= give_up or not (required or others):
                return list(received.values())
            if required and now >= began + FINAL_REPORT_TIMEOUT_S and not printed:
                printed = True
                names = ", ".join(sorted(required))
                self._inbox.say(f"waiting {self._timeout:g} s for the FinalReport of {names}")
            if now >= self._repeat:
                self._put_all_again(frames, required | others, now)
            arrival = self._next(min(self._repeat, give_up) - now)
            if arrival.topic == "alive":
                self._put_again(frames, [arrival.source.robot])
            if arrival.topic == "command":
                last = self._accepted(arrival, Command | FinalReport)
                if isinstance(last, FinalReport):
                    received[last.robot] = last
                elif last is not None and last.tick <= end.tick:
                    self._latest[last.robot] = last.tick
            now = self._inbox.clock()


class NoRouter(TimeoutError):
    """There is no router that the world, as a client, can connect to; the text says why."""


class WorldLinks:
    """The Zenoh sessions of a world, one at a time; a context manager that opens the first."""

    def __init__(self, endpoints: Endpoints, timeout: float, inbox: Inbox, busy_timeout: float) -> None:
        """Wait at most `timeout` s for a router, and `busy_timeout` s for a port in use to become free."""
        self.endpoints = endpoints
        self._timeout = timeout
        self._inbox = inbox
        self._busy_timeout = busy_timeout
        self._open = ExitStack()

    def open(self) -> None:
        """Close the session, if there is one, and open another.

        Raises CannotListen, NoRouter or Interrupted.
        """
        self._open.close()
        give_up = self._inbox.clock() + self._timeout
        self.session: zenoh.Session | None = None

        def unanswered() -> None:
            if self._inbox.clock() >= give_up:
                why = diagnosis.why(self.endpoints)
                raise NoRouter(f"no router at {self.endpoints}; gave up after {self._timeout:g} s: {why}")
            self._inbox.next(session.ASK_AGAIN_S)

        if self.endpoints.connect:
            later = threading.Timer(diagnosis.FIRST_WORD_S, self._warn_without_link)
            later.daemon = True
            later.start()
            self._open.callback(later.cancel)
        opened = session.open_session(self.endpoints, unanswered, self._busy_timeout)
        self.session = self._open.enter_context(opened)

    def _warn_without_link(self) -> None:
        """Print that no router is connected: a router runs without its peers, a client waits for one."""
        if self.session is None or not session.linked(self.session):
            self._inbox.say(f"no router at {self.endpoints} yet: {diagnosis.why(self.endpoints)}")

    def attach(self, process: WorldProcess) -> None:
        """Let `process` send and receive over the open session; robots can find it from then on."""
        assert self.session is not None
        process.attach(self.session, replaceable=self.endpoints.mode == "client")

    def run(self, process: WorldProcess) -> None:
        """Run the attached `process` to its MissionEnd over as many sessions as needed.

        Raises NoRouter, Interrupted.
        """
        while True:
            try:
                process.run()
            except session.LinkLost:
                self.open()
                self.attach(process)
            else:
                return

    def __enter__(self) -> WorldLinks:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()
