"""The agent process: it receives frames over Zenoh, journals them, runs the planner and sends its answers.

The process reacts only to arriving frames, and it never steps twice. A repeated Observation makes it send its
stored answers again, so a lost, late or duplicated frame costs time but changes no decision. The same holds
when this process, the peer's process or the world is killed: a restarted process receives again everything
that it needs. A suspended process and a broken link are handled in the same way. A link over which nothing
arrives is replaced by a new one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial

import zenoh

from agent.planning.planner import malformed
from agent.process.agent_journal import FramedReport
from agent.process.discovery import NoWorld, Search, Unwelcome, confirm, join
from agent.process.link import AgentLink
from agent.process.out_of_step import OutOfStep
from agent.process.recovery import OWN_REPORTS_KEPT, Memory
from agent.process.report_buffer import ReportBuffer
from agent.process.robot import REPORTS_KEPT
from protocol.messages import MissionEnd, Observation, RobotConfig, TickStart
from protocol.network import session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Arrival, Inbox
from protocol.wire import encode

FROM_WORLD = Observation | MissionEnd | TickStart
"""The messages that an agent receives from the world. A TickStart is of a tick that cannot begin yet."""
REPORT_SHARE = 0.5
"""The fraction of a tick to wait for the peer's report, in real time."""
FIELD_SHARE = 0.1
"""The REPORT_SHARE of hardware mode, which needs the rest of the tick for the manoeuvre."""
LAST_WORD_S = 0.5
"""The seconds for which frames of the world may still arrive after its liveliness token has disappeared."""
ENDED_S = 1.0
"""The seconds for which a MissionEnd of another tick must be repeated before it is accepted.

The world repeats its own MissionEnd for at least twice as long.
"""
AGAIN_S = 0.05
"""The least seconds between two repetitions of the stored answers.

One received frame may cause as many frames as there are reports to repeat.
"""


class AgentProcess:
    """One robot in one run, over a sequence of links."""

    def __init__(
        self,
        memory: Memory,
        run: str,
        inbox: Inbox,
        *,
        timeout: float = 30.0,
        launched: bool = False,
        on_kill_point: Callable[[str, int], None] = lambda *_: None,
    ) -> None:
        """Continue from `memory`, in the run named `run`.

        `timeout` is the longest time in s to wait for the world. An agent that is `launched` does not report
        that the world has gone: its launcher does. `on_kill_point` is called with the name of each step
        within a tick and the tick, so that a scheduled kill can happen there.
        """
        config = memory.robot.config
        self._others = {*config.others}
        self._inbox = inbox
        self._timeout = timeout
        self._tick_s = config.tick_s
        self._world_timeout = timeout + (self._tick_s or 0.0)
        """The longest time in s between two new frames from the world."""
        self._give_up = self._inbox.awake() + self._world_timeout
        """The time of `Inbox.awake` at which the world has been silent for too long."""
        self._on_kill_point = on_kill_point
        self._robot = memory.robot
        self._observation = memory.observation
        """The latest Observation."""
        self._due: float | None = None
        """The time after which listed reports are no longer awaited; None in lockstep."""
        if self._observation is not None and self._robot.command is None:
            self._set_due()
        real_time = self._tick_s is not None
        self._link = AgentLink(config, run, inbox)
        self._out_of_step = OutOfStep(config.robot, inbox, self._link.appear, real_time=real_time)
        self._report_buffer = ReportBuffer(
            inbox,
            memory.received,
            partial(malformed, planner=self._robot.planner),
            real_time=real_time,
        )
        self._launched = launched
        self._loss_reported = False
        """True once the loss of the world has been reported to the user."""
        self._repeated_at = -math.inf
        """The time of the last repetition."""
        self._repeat_at: float | None = None
        """The time of the next repetition, if one was requested within AGAIN_S of the last."""
        self._own_reports = deque(memory.own_reports, maxlen=OWN_REPORTS_KEPT)
        """The robot's own reports of its latest ticks in contact, by the receiving robot."""
        self.end: MissionEnd | None = memory.end if memory.final_report is not None else None
        """The MissionEnd, once it is accepted."""
        self._final_report = memory.final_report

    def run(self) -> MissionEnd:
        """Run the mission over the attached link and return its MissionEnd.

        Raises LinkLost if nothing arrives over this link, NoWorld if the world is absent for too long,
        and Interrupted when the process is asked to stop.
        """
        while self.end is None:
            arrival = self._next(self._due)
            match arrival.topic:
                case "observation":
                    message = self._inbox.accepted(arrival, FROM_WORLD)
                    if isinstance(message, MissionEnd) and (
                        message.tick == self._latest_tick or self._out_of_step.persists(message, ENDED_S)
                    ):
                        self._conclude(message)
                    elif isinstance(message, TickStart) or (
                        isinstance(message, Observation) and self._on_observation(message, arrival.frame)
                    ):
                        self._give_up = self._inbox.awake() + self._world_timeout
                case "report" if arrival.source.robot not in self._others:
                    self._inbox.refuse(arrival, "its sender is not in this mission")
                case "report":
                    self._report_buffer.take(arrival, self._latest_tick)
                case "gone" | "alive":
                    self._out_of_step.world(there=arrival.topic == "alive")
                    self._note_world(gone=arrival.topic == "gone")
                case _:
                    pass
            if self.end is None:
                self._decide_when_reports_complete()
                self._check_timeout()
        return self._answer_end(self.end)

    def unanswered(self) -> None:
        """Wait briefly between two attempts to open a link.

        Raises NoWorld if the world is absent for too long, or Interrupted.
        """
        self._note_world(gone=True)
        self._inbox.next(session.ASK_AGAIN_S)
        self._check_timeout()

    def _note_world(self, *, gone: bool) -> None:
        """Report the loss of the world to the user, once per loss.

        The liveliness token may have disappeared before this process saw it.
        """
        if gone and not self._loss_reported:
            self._say_gone("", self._world_timeout)
        self._loss_reported = gone

    def _say_gone(self, when: str, timeout: float) -> None:
        if not self._launched:
            self._inbox.say(f"the world has gone{when}; waiting {timeout:g} s for it")

    def attach(self, link: zenoh.Session) -> None:
        """Use `link` to send and receive from now on."""
        self._link.attach(link)

    def _next(self, until: float | None) -> Arrival:
        """Return the next arrival, or NOTHING after `until`.

        Meanwhile, repeat the stored answers when a repetition is due.

        Raises LinkLost if nothing arrives from the world for too long.
        """
        if self._repeat_at is not None and self._inbox.clock() >= self._repeat_at:
            self._repeat_answers()
        give_up = self._gives_up_at()
        return self._link.next(min(until or give_up, give_up, self._repeat_at or give_up))

    def _gives_up_at(self) -> float:
        """Return the time of the clock at which nothing has been received from the world for too long."""
        return self._give_up + self._inbox.clock() - self._inbox.awake()

    def _check_timeout(self) -> None:
        if self._inbox.clock() >= self._gives_up_at():  # the time until which `_next` waits, to the bit
            raise NoWorld(f"nothing received from the world for {self._world_timeout:g} s")

    @property
    def _latest_tick(self) -> int:
        """The tick of the latest Observation, or -1."""
        return self._observation.tick if self._observation is not None else -1

    # --- arrivals ---

    def _on_observation(self, observation: Observation, frame: bytes) -> bool:
        """Process an Observation and return whether it is in step. Raises NoWorld."""
        if observation.tick == self._latest_tick + 1:
            self._on_kill_point("observation", observation.tick)
            if self._due is not None:  # the world has advanced; absent reports count as missed
                self._due = -math.inf
                self._decide_when_reports_complete()
            self._out_of_step.over()
            self._observation = observation
            self._set_due()
            reports = self._robot.observation(observation, frame)
            if reports:
                self._own_reports.append(reports)
                self._send_reports(reports)
            return True
        if observation == self._observation:
            self._out_of_step.over()
            self._repeat_answers()
            return True
        self._out_of_step.observation(observation, self._latest_tick)
        return False

    def _set_due(self) -> None:
        if self._tick_s is not None and self._observation is not None:
            hardware_mode = any(contact.heard is None for contact in self._observation.contacts)
            self._due = self._inbox.clock() + (FIELD_SHARE if hardware_mode else REPORT_SHARE) * self._tick_s

    # --- answers ---

    def _decide_when_reports_complete(self) -> None:
        if self._observation is None or self._robot.command is not None:
            return
        received: list[FramedReport] = []
        missed: list[str] = []
        for contact in self._observation.contacts:
            peer, now, listed = contact.peer, self._observation.tick, contact.heard
            if listed is None:
                received += self._report_buffer.waiting(peer, now)
                listed = () if self._report_buffer.of(peer, now) else (now,)
            for tick in listed:
                framed = self._report_buffer.of(peer, tick)
                if framed is not None:
                    received.append(framed)
                elif self._due is None or self._inbox.clock() < self._due:
                    return
                else:
                    missed.append(peer)
        command = self._robot.decide(received, missed)
        self._due = None
        self._send_command(command.tick)
        if self._robot.journaled or self._link.estimate_wanted:
            estimate = self._robot.estimate()
            if self._link.estimate_wanted:
                self._link.estimate(estimate)
        self._report_buffer.list((framed.report.robot, framed.report.tick) for framed in received)
        self._report_buffer.forget(command.tick - REPORTS_KEPT, self._robot.contacts)

    def _send_reports(self, reports: Mapping[str, FramedReport]) -> None:
        for peer, framed in reports.items():
            self._link.report(peer, framed.frame)
            self._on_kill_point("report", framed.report.tick)

    def _send_command(self, tick: int) -> None:
        self._on_kill_point("journal", tick)
        self._link.command(self._robot.command_frame)
        self._on_kill_point("command", tick)

    def _repeat_answers(self) -> None:
        """Send the stored answers again, for a process that was restarted and may have lost them.

        In contact these include earlier reports.
        """
        now = self._inbox.clock()
        if now < self._repeated_at + AGAIN_S:
            self._repeat_at = self._repeated_at + AGAIN_S
            return
        self._repeated_at, self._repeat_at = now, None
        if self._robot.reports:
            oldest = self._robot.tick - OWN_REPORTS_KEPT
            for reports in self._own_reports:
                self._send_reports(
                    {
                        peer: framed
                        for peer, framed in reports.items()
                        if framed.report.tick > oldest and peer in self._robot.reports
                    }
                )
        if self._robot.command is not None:
            self._send_command(self._robot.command.tick)

    def _conclude(self, end: MissionEnd) -> None:
        self._report_buffer.forget(end.tick + REPORTS_KEPT + 1, self._robot.contacts)
        self._final_report = self._robot.final_report(
            end,
            reports_refused=self._inbox.refused["report"],
            reports_unheard=self._report_buffer.unheard,
            frames_refused=self._inbox.refused.total(),
        )
        self.end = end
        self._give_up = self._inbox.awake() + self._timeout

    def _answer_end(self, end: MissionEnd) -> MissionEnd:
        """Answer every repetition of the MissionEnd until the world confirms that it has the answer."""
        assert self._final_report is not None
        frame = encode(self._final_report)
        self._link.command(frame)
        self._out_of_step.over()
        gone = False
        while self._inbox.clock() < self._gives_up_at():
            arrival = self._next(self._inbox.clock() + LAST_WORD_S if gone else None)
            if arrival.topic == "observation":
                if arrival.frame == frame:
                    break
                message = self._inbox.accepted(arrival, FROM_WORLD)
                if isinstance(message, Observation):
                    self._out_of_step.observation(message, end.tick)
                elif isinstance(message, MissionEnd):
                    self._out_of_step.over()
                    self._link.command(frame)
            elif arrival.topic == "alive":
                self._out_of_step.world(there=True)
            elif arrival.topic == "gone":
                self._out_of_step.world(there=False)
                gone = True  # frames that the world sent before may still arrive
            elif gone and arrival.topic == "nothing":
                self._say_gone(" after its MissionEnd", self._timeout)
                gone = False
        return end


def run_agent(
    robot: str,
    run: str | None,
    endpoints: Endpoints,
    search: Search,
    *,
    start: Callable[[str, RobotConfig], AgentProcess],
    on_first_link: Callable[[], None],
    on_joined: Callable[[str, RobotConfig], None],
    on_end: Callable[[], None],
    end: MissionEnd | None = None,
) -> MissionEnd:
    """Join a run as `robot`, and take part in it until its MissionEnd, over as many sessions as are needed.

    A session whose link is lost is replaced by a new one. `run` names the run if several may be alive; `end`
    is the MissionEnd that the robot's journal contains already. `start` returns the process for the run and
    the configuration that the world has sent. `on_first_link` is called once a session is open, `on_joined`
    once the process is attached to it, and `on_end` after the MissionEnd, while the session is still open.

    Raises NoWorld if there is no world, and Unwelcome, but neither if a MissionEnd is known; CannotListen;
    Interrupted.
    """
    process: AgentProcess | None = None
    linked = False
    while True:
        try:
            unanswered = search.wait if process is None else process.unanswered
            with session.open_session(endpoints, unanswered, session.CLOSE_TIMEOUT_S) as link:
                if not linked:
                    on_first_link()
                    linked = True
                if process is None:
                    joined = join(link, run, robot, search)
                    if joined is None:  # a session that has lost its link finds nothing; a new one may
                        continue
                    process = start(*joined)
                    confirm(link, joined[0], robot, search)
                    process.attach(link)
                    on_joined(*joined)
                else:
                    process.attach(link)
                found = process.run()
                on_end()
                return found
        except session.LinkLost:
            continue
        except Unwelcome:
            if end is None:
                raise
            return end
        except NoWorld:
            end = process.end if process is not None else end
            if end is None:
                raise
            return end
