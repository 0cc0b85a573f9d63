"""The bridge between one robot's driver and its agent, in hardware mode.

It sends Observations made from the driver's readings to the agent, and executes the agent's Commands with the
driver. The agent is the same program as with a simulator. It runs in a process of its own, so if it ends, the
robot stops after the current manoeuvre.

A tick is a manoeuvre of T_s and a rest, for measurements, Reports and the decision. All robots of a mission
count the same ticks. Each sends a TickStart at the start of each tick, and sets its clock from those of
another robot (see `tick_source`). If none arrives, it uses its own clock.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

import zenoh

from protocol.journal.journal_file import Sink
from protocol.messages import (
    Cause,
    Command,
    Estimate,
    FinalReport,
    MissionEnd,
    RobotConfig,
    TickStart,
    Verdict,
)
from protocol.network import keys, session
from protocol.network.inbox import NO_ARRIVAL, Arrival, Inbox
from protocol.wire import MAX_REPORT_BYTES, encode
from world.hardware.driver import THINKING, Driver
from world.hardware.driver_journal import DriverHistory
from world.hardware.measurements import InvalidReading, mark_frames, observation_frame
from world.hardware.termination import Ending
from world.hardware.tick_source import UNHEARD, TickSource
from world.process import FINAL_REPORT_TIMEOUT_S, REPEAT_S, REPEAT_TO_ALL_S
from world.truth import limited_controls

PUT_S = 2.0
"""The time in s that Zenoh has to take a frame at the end of a mission.

Other robots close their links at the same time. Seldom, on a busy machine, Zenoh then takes no frame any
more, without a limit of time.
"""
ASTRAY = 64
"""The maximum number of ticks by which a TickStart may differ from the tick of its receiver.

One of a much earlier tick was sent by a robot that has been restarted without its journal.
"""
MOST_TICKS_AHEAD = 2
"""The maximum number of ticks by which a robot may be ahead of the one that it follows, and wait for it."""

SETTLING = 0.002
"""The duration of the rest before a reading, at least, as a fraction of a manoeuvre: clocks drift apart."""
AT_ONCE = 1000
"""The maximum number of messages that are processed without checking the time."""
UNKNOWN = -math.inf
"""An unknown time. It is less than any time, because clocks may start anywhere."""


class NoStart(TimeoutError):
    """An agent was not connected within the connection timeout. The text of the error names it."""


class DriverFailed(Exception):
    """The driver raised an error, or returned an invalid reading. The text of the error is the reason."""


class Field:
    """The mission of one robot, over one session."""

    def __init__(
        self,
        driver: Driver,
        config: RobotConfig,
        run: str,
        inbox: Inbox,
        *,
        max_ticks: int,
        manoeuvre_s: float,
        timeout: float = 30.0,
        journal: Sink | None = None,
    ) -> None:
        """Connect `driver` to the agent of `config` under the run name `run`.

        `manoeuvre_s` is the duration of a manoeuvre in s of wall time. `timeout` (s) limits each wait for an
        answer. Observations and Commands are written to `journal`, which already contains the RobotConfig.
        """
        self._driver = driver
        self._estimated: Callable[[Estimate], None] | None = getattr(driver, "estimated", None)
        self._config = config
        self._id, self._others = config.robot, config.others
        self.run = run
        self._inbox = inbox
        self._manoeuvre_s = manoeuvre_s
        self._tick_s = (1.0 + THINKING) * manoeuvre_s
        self._timeout = timeout + self._tick_s
        self._ended: Callable[[], None] = lambda: None
        self._journal = journal
        self._max_ticks = max_ticks
        self._ending = Ending(config, max_ticks, self._timeout, inbox.awake)
        self._source = TickSource(config, self._tick_s)
        self._end: MissionEnd | None = None
        """The end of the mission that follows from the journal; None before."""
        self._is_end_recorded = False
        """True if the journal contains the MissionEnd."""
        self._restarted = False
        """True if this process is a restarted one, even if it was killed before tick 0."""
        self._resumed = False
        """True if others may be ahead: this process was killed after tick 0, or has begun after others."""
        self._astray = max_ticks + 1 if self._source.joins else ASTRAY
        """The number of ticks by which the next TickStart may be ahead."""
        self._ahead = -1
        """The latest tick of another robot to which this one has had to catch up; -1 if none."""
        self._latest = -1
        """The latest tick in a TickStart that fits, or in which others are if some may be false; -1: none."""
        self._alive: set[str] = set()
        """The robots with a liveliness token."""
        self._unanswered: deque[tuple[int, bytes]] = deque()
        """The ticks and frames of the Observations that the agent has not answered."""
        self._answered = UNKNOWN
        """The time (`awake`) of the agent's last Command. An agent that only appears again does not count."""
        self._tick = -1
        self._next = UNKNOWN
        """The time at which the next tick begins."""
        self.missed = 0
        """The number of ticks in which the robot rested because a Command was missing."""

    def resume(self, history: DriverHistory, latest: int) -> None:
        """Continue at the end of the driver's journal. `latest` is the latest tick in the agent's journal.

        The robot rested while this process was down, so the others may be any number of ticks ahead.
        """
        self._restarted = True
        for one in history.ticks:
            for message in one.received:
                self._ending.receive(message)
            self._end = self._ending.after(one.observation.tick, one.command)
            self.missed += one.command is None
        self._end, self._is_end_recorded = history.end or self._end, history.end is not None
        self._tick, self._resumed, self._astray = history.tick, history.tick >= 0, self._max_ticks + 1
        self._unanswered.extend((one.observation.tick, one.frame) for one in history.ticks[latest + 1 :])

    @property
    def tick(self) -> int:
        """The current tick; -1 before tick 0."""
        return self._tick

    @property
    def verdict(self) -> Verdict | None:
        """The robot's final result; None until it has one."""
        return self._ending.verdict

    def attach(self, link: zenoh.Session) -> None:
        """Use the session `link` to communicate with the agent and the other robots."""
        me, run, inbox = self._id, self.run, self._inbox
        self._observation = session.publisher(link, keys.observation(run, me))
        self._tick_start = session.publisher(link, keys.tick_start(run, me))
        session.subscribe(link, keys.command(run, me), inbox, "command")
        if self._estimated is not None:
            session.subscribe(link, keys.estimate(run, me), inbox, "estimate")
        for robot in self._others:
            session.subscribe(link, keys.tick_start(run, robot), inbox, "tick-start")
        session.watch_liveliness(link, keys.robot_alive(run, "*"), inbox)
        session.answer(link, keys.config(run, me), lambda *_: self._config)
        self._token = session.show_alive(link, keys.world_alive(run))

    def run_mission(self, wait: float, ended: Callable[[], None]) -> MissionEnd:
        """Run the whole mission, stop the robot, and return the MissionEnd.

        `wait` is the time in s to wait for all agents to connect. `ended` is called when the agent's process
        has ended. It may restart the process, or raise an error. Raises NoStart; the errors of `ended`;
        Interrupted by a signal; CannotRecord.
        """
        self._ended = ended
        end = self._end
        try:
            self._gather(self._inbox.clock() + wait)
            while end is None:
                end = self._play_tick()
        except DriverFailed as failure:
            end = self._failed(f"{self._id}'s driver: {failure}")
        finally:
            self._stop()
        if not self._is_end_recorded:
            self._write(encode(end))
        self._finish(end)
        return end

    def _write(self, *frames: bytes) -> None:
        """Write `frames` to the journal. Raises CannotRecord."""
        if self._journal is not None:
            self._journal.write(*frames)

    # --- a tick ---

    def _gather(self, give_up: float) -> None:
        """Wait until tick 0 can begin: for the first robot when all agents are connected, then for the rest.

        A resumed process only waits for its own agent, because the mission of others may have ended. The
        TickStart of a robot that now waits for this one may be lost: Zenoh loses what is sent just after two
        routers have connected, and this process may have been killed since. A robot therefore begins UNHEARD
        ticks after all are connected. One of a group begins at `give_up` without those that are missing, if
        any other is there. Meanwhile its agent is told every REPEAT_TO_ALL_S that it waits.

        Raises NoStart.
        """
        waiting_s = min(REPEAT_TO_ALL_S, 0.25 * self._timeout)
        tell = self._inbox.clock() + waiting_s
        unheard = self._inbox.clock() + UNHEARD * self._tick_s
        while not self._may_begin():
            missing = [one for one in (self._id, *self._others) if one not in self._alive]
            if missing and not self._restarted:
                unheard = self._inbox.clock() + UNHEARD * self._tick_s
            elif not missing and self._inbox.clock() >= unheard:
                self._next, self._astray = self._inbox.clock(), self._max_ticks + 1
                break
            if self._inbox.clock() >= give_up:
                if self._source.joins and self._id not in missing and self._alive > {self._id}:
                    what = f"{' and '.join(missing)}: not connected" if missing else "no TickStart received"
                    self._inbox.say(f"{what}; the mission begins")
                    break
                moved = "" if self._resumed else "; no robot has moved"
                raise NoStart(f"{' and '.join(missing or self._others)}: not connected{moved}")
            if (now := self._inbox.clock()) >= tell:
                self._observation.put(encode(TickStart(self._tick + 1, self._id)))
                tell = now + waiting_s
            until = min(give_up, tell, unheard) if unheard > now else min(give_up, tell)
            self._take(self._inbox.next(until - self._inbox.clock()))
        if self._next == UNKNOWN and not self._restarted:  # it follows nobody yet
            self._astray = ASTRAY
        self._answered = self._inbox.awake()

    def _may_begin(self) -> bool:
        if self._id not in self._alive:
            return False
        if self._resumed or self._next != UNKNOWN:
            return True
        return self._source.is_first and self._alive.issuperset(self._others)

    def _play_tick(self) -> MissionEnd | None:
        self._tick += 1
        tick = self._tick
        now = self._inbox.clock()
        if self._next == UNKNOWN or (now > self._next + self._tick_s and tick >= self._latest):
            self._next = now  # there is nobody to catch up with: time that was lost is not made up
        self._next += self._tick_s
        if tick >= self._ahead or self._next > now:  # none while catching up: others would wait
            self._tick_start.put(encode(self._ending.tick_start(tick)))
        observation, *marks = self._measured(tick)
        self._write(*marks, observation)
        self._unanswered.append((tick, observation))
        self._observation.put(observation)
        command = self._wait_for_command(tick)
        until = self._inbox.clock()
        if command is not None:
            self._write(encode(command))
            self._drive(command)
            until = self._inbox.clock() + (1.0 + SETTLING) * self._manoeuvre_s
        else:
            self.missed += 1
        while (now := self._inbox.clock()) < (end := max(until, self._next)):
            self._take(self._inbox.next(end - now))
            if command is not None and self._inbox.clock() > end + THINKING * self._manoeuvre_s:
                until = self._inbox.clock() + (1.0 + SETTLING) * self._manoeuvre_s  # it jumped
        self._take_waiting()
        if self._unanswered and self._inbox.awake() - self._answered > self._timeout:
            return self._failed(f"no answer from {self._id}'s agent for {self._timeout:g} s")
        return self._ending.after(tick, command)

    def _failed(self, what: str) -> MissionEnd:
        """Return the end of a mission that has failed by `what`."""
        return MissionEnd(max(self._tick, 0), "failed", (Cause("failed", text=what),))

    def _measured(self, tick: int) -> list[bytes]:
        """Return the frame of the Observation of `tick`, and that of its mark if it has one.

        Raises DriverFailed.
        """
        began = self._inbox.clock()
        try:
            reading = self._driver.sense(tick)
        except (Exception, SystemExit) as error:  # a driver of the user may raise anything
            raise DriverFailed(f"sense({tick}): {type(error).__name__}: {error}") from error
        self._inbox.waited(began, 0.0)  # nothing was taken meanwhile
        try:
            observation = observation_frame(reading, tick, self._config)
            return [observation, *mark_frames(reading, tick, self._id)]
        except InvalidReading as error:
            raise DriverFailed(f"sense({tick}): {error}") from None

    def _stop(self) -> None:
        try:
            self._driver.stop()
        except (Exception, SystemExit) as error:  # noqa: BLE001  # as above; the MissionEnd still has to be sent
            self._inbox.say(f"the driver does not stop: {type(error).__name__}: {error}")

    def _drive(self, command: Command) -> None:
        """Execute `command`, limited to v_max and omega_max. Raises DriverFailed."""
        controls = limited_controls(command, self._config.mission)
        try:
            self._driver.drive(controls.v, controls.omega)
        except (Exception, SystemExit) as error:  # as above
            raise DriverFailed(
                f"drive({controls.v:g}, {controls.omega:g}): {type(error).__name__}: {error}"
            ) from error

    def _wait_for_command(self, tick: int) -> Command | None:
        """Return the Command of this tick; None if it arrives too late for a manoeuvre in the tick."""
        while (left := self._next - self._manoeuvre_s - self._inbox.clock()) > 0.0:
            command = self._take(self._inbox.next(left))
            if command is not None and command.tick == tick:
                return command
        return None

    # --- what arrives ---

    def _take_waiting(self) -> None:
        """Process the messages that have arrived, so that this is also done if `sense` takes a whole tick."""
        for _ in range(AT_ONCE):
            arrival = self._inbox.next(0.0)
            if arrival is NO_ARRIVAL:
                return
            self._take(arrival)

    def _take(self, arrival: Arrival) -> Command | None:
        """Process what has arrived, and return it if it is a Command of the agent, of any tick."""
        match arrival.topic:
            case "command":
                return self._on_command(arrival)
            case "estimate":
                self._on_estimate(arrival)
            case "tick-start":
                self._on_tick_start(arrival)
            case "alive":
                self._alive.add(arrival.source.robot)
                if arrival.source.robot == self._id:
                    for _, frame in self._unanswered:  # it may have missed them while it was restarted
                        self._observation.put(frame)
            case "gone":
                self._alive.discard(arrival.source.robot)
            case "ended":
                self._ended()
            case _:
                pass
        return None

    def _on_command(self, arrival: Arrival) -> Command | None:
        command: Command | None = self._inbox.accepted(arrival, Command, MAX_REPORT_BYTES)
        if command is None or command.tick > self._tick:
            if command is not None:
                self._inbox.refuse(arrival, "its tick is in the future")
            return None
        while self._unanswered and self._unanswered[0][0] <= command.tick:
            self._unanswered.popleft()
            self._answered = self._inbox.awake()
        return command

    def _on_estimate(self, arrival: Arrival) -> None:
        """Give an Estimate to a driver that takes them. Raises DriverFailed."""
        estimate: Estimate | None = self._inbox.accepted(arrival, Estimate)
        if estimate is None or self._estimated is None:
            return
        try:
            self._estimated(estimate)
        except (Exception, SystemExit) as error:  # as above
            raise DriverFailed(f"estimated(): {type(error).__name__}: {error}") from error

    def _on_tick_start(self, arrival: Arrival) -> None:
        """Set the time of the next tick from a TickStart of the robot that this one follows.

        The next tick begins as many ticks later as its number is higher, and at once if it is lower. A robot
        that is behind sets its clock from any other one: if it was restarted, and in a group also if it
        begins late or is more than MOST_TICKS_AHEAD ticks behind. In a group that tolerates false robots,
        all set their clocks from several ones.
        """
        start: TickStart | None = self._inbox.accepted(arrival, TickStart, MAX_REPORT_BYTES)
        if start is None:
            return
        if not (self._agrees(start) if self._source.tolerates else self._follows(start)):
            self._inbox.refuse(arrival, f"it is of tick {start.tick}, this is tick {max(self._tick, 0)}")
        if self._is_current(start.tick):
            self._use(start, arrival.frame)

    def _follows(self, start: TickStart) -> bool:
        """Set the clock from `start` if this robot goes by that of its sender; False if it does not fit."""
        left, now, in_group = self._tick + 1 - start.tick, self._inbox.clock(), self._source.joins
        most = MOST_TICKS_AHEAD if self._resumed or self._astray == ASTRAY else ASTRAY
        fits = -self._astray <= left <= most and self._source.is_newer(start.robot, start.tick, now)
        begins = in_group and self._next == UNKNOWN
        behind = left < 0 and (self._resumed or (in_group and left < -MOST_TICKS_AHEAD))
        if fits:
            self._source.hear(start.robot, start.tick, now)
            self._latest = max(self._latest, start.tick)
        if not (begins or behind or self._source.leads(start.robot, now)):
            return True
        if fits:
            catches_up = behind or (begins and left < 0)
            self._ahead = start.tick if catches_up else -1
            self._resumed |= in_group and catches_up
            self._astray = ASTRAY
            self._next = now + left * self._tick_s
        return fits

    def _agrees(self, start: TickStart) -> bool:
        """Set the clock from those of several robots, of which some may be false; False if `start` is late.

        One suffices to begin when all are connected: an honest one begins then, too.
        """
        left, now = self._tick + 1 - start.tick, self._inbox.clock()
        if left > MOST_TICKS_AHEAD or not self._source.is_newer(start.robot, start.tick, now):
            return False
        self._source.hear(start.robot, start.tick, now)
        before = None if self._next == UNKNOWN else self._next - (self._tick + 1) * self._tick_s
        began = self._source.agreed(before, now)
        if began is None and start.tick <= MOST_TICKS_AHEAD and self._alive.issuperset(self._others):
            began = now - start.tick * self._tick_s
        if began is not None and began != before:
            self._ahead = self._latest = math.floor((now - began) / self._tick_s)
            self._next = began + (self._tick + 1) * self._tick_s
        return True

    def _is_current(self, tick: int) -> bool:
        """Return whether `tick` is near this robot's, or that of the robots with which it catches up."""
        return abs(tick - max(self._tick, self._ahead)) <= ASTRAY

    def _use(self, message: TickStart, frame: bytes) -> None:
        """Use a message of another robot for the end of the mission, and journal it if it changes something.

        The mission begins with tick 0, and its journal with the Observation of that tick.
        """
        if self._tick >= 0 and self._end is None and self._ending.receive(message):
            self._write(frame)

    # --- the end ---

    def _finish(self, end: MissionEnd) -> None:
        """Send `end` to the agent until it sends its FinalReport, and acknowledge that."""
        give_up = self._inbox.clock() + FINAL_REPORT_TIMEOUT_S
        while (now := self._inbox.clock()) < give_up and self._id in self._alive:
            if not self._is_taken(encode(end)):
                self._inbox.say(f"no FinalReport of {self._id}: Zenoh does not take the MissionEnd")
                return
            repeat = min(now + REPEAT_S, give_up)
            while (left := repeat - self._inbox.clock()) > 0.0:
                arrival = self._inbox.next(left)
                if arrival.topic == "gone":
                    self._alive.discard(arrival.source.robot)
                elif arrival.topic == "command" and isinstance(
                    self._inbox.accepted(arrival, Command | FinalReport), FinalReport
                ):
                    self._is_taken(arrival.frame)
                    return
        why = "no answer to the MissionEnd" if self._id in self._alive else "its agent has ended"
        self._inbox.say(f"no FinalReport of {self._id}: {why}")

    def _is_taken(self, frame: bytes) -> bool:
        """Send `frame` to the agent, and return whether Zenoh has taken it within PUT_S.

        If not, the thread keeps this object: publishers that Zenoh cannot undeclare must not be freed.
        """
        sender = threading.Thread(target=self._send, args=(frame,), daemon=True)
        sender.start()
        sender.join(PUT_S)
        return not sender.is_alive()

    def _send(self, frame: bytes) -> None:
        self._observation.put(frame)
