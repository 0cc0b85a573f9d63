"""The agent's process: Zenoh in, journal, planner, Zenoh out. It knows nothing but what it is told.

It reacts to what arrives and never steps twice: a Observation heard again makes it send again what it
answered, so whatever is lost, late or doubled costs time and changes nothing. So does a process that is
killed, its peer's or the world's: whoever is started again is told again what it must know. So do a process
that is stopped, and a link that goes down: one over which nothing comes any more is replaced.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import zenoh

from agent.process.discovery import ASK_AGAIN_S, NoWorld, Search, join
from agent.process.link import AgentLink, WorldLinkLost
from agent.process.out_of_step import OutOfStep
from agent.process.recovery import REPORTS_KEPT, REPORTS_TOLD, Memory
from agent.process.report_buffer import Post
from agent.process.robot import FramedReport
from protocol.messages import MissionEnd, Observation, RobotConfig
from protocol.network import session
from protocol.network.endpoints import Endpoints
from protocol.network.inbox import Arrival, Inbox
from protocol.wire import MalformedFrame, decode, encode

REPORT_SHARE = 0.5
"""of a tick in real time: how long to wait for the peer's report"""
FIELD_SHARE = 0.1
"""the same without a world, where the rest of the tick is for the manoeuvre"""
LAST_WORD_S = 0.5
"""how long what the world has said may outlast its sign of life"""
ENDED_S = 1.0
"""how long an End of another tick must be said; the world says its own for twice as long, or more"""
AGAIN_S = 0.05
"""how often to say again what was said: to one frame may answer as many as there are reports to tell"""


class AgentProcess:
    """One robot in one run, over one link after the other."""

    def __init__(
        self,
        memory: Memory,
        run: str,
        inbox: Inbox,
        *,
        timeout: float = 30.0,
        on_kill_point: Callable[[str, int], None] | None = None,
    ) -> None:
        """`timeout` (s) bounds the wait for the world; `on_kill_point` is told how far each tick has come."""
        config = memory.config
        self._id = config.robot
        self._inbox = inbox
        self._timeout = timeout
        self._tick_s = config.tick_s
        self._silence = timeout + (self._tick_s or 0.0)
        """how long to wait for something new from the world"""
        self._give_up = time.monotonic() + self._silence
        self._on_kill_point = on_kill_point
        self._robot = memory.robot
        self._observation = memory.observation
        """the latest"""
        self._due: float | None = None
        """in real time: when to go on without the reports that it lists"""
        if self._observation is not None and self._robot.command is None:
            self._set_due()
        real_time = self._tick_s is not None
        self._link = AgentLink(config, run, inbox)
        self._disorder = OutOfStep(self._id, inbox, self._link.appear, real_time=real_time)
        self._post = Post(inbox, memory.heard, real_time=real_time)
        self._gone = False
        """whether it has been told that the world has gone"""
        self._said_again = 0.0
        """when all was last said again"""
        self._again: float | None = None
        """when to do so once more, if it was asked for too soon"""
        self._told = deque(memory.told, maxlen=REPORTS_TOLD)
        """its own latest reports"""
        self.end: MissionEnd | None = memory.end if memory.final_report is not None else None
        """once the world has said it"""
        self._final_report = memory.final_report

    def play(self) -> MissionEnd:
        """The run over the link that it is attached to, to its MissionEnd.

        Raises LinkLost; NoWorld; or Interrupted when told to stop.
        """
        while self.end is None:
            arrival = self._next(self._due)
            match arrival.topic:
                case "observation":
                    message = self._accepted(arrival)
                    if isinstance(message, MissionEnd) and self._is_over(message):
                        self._conclude(message)
                    elif isinstance(message, Observation) and self._on_sense(message, arrival.frame):
                        self._give_up = time.monotonic() + self._silence
                case "report":
                    self._post.take(arrival, self._known)
                case "gone" | "alive":
                    self._disorder.world(there=arrival.topic == "alive")
                    self._notice(gone=arrival.topic == "gone")
                case _:
                    pass
            if self.end is None:
                self._decide_when_all_is_heard()
                self._check_patience()
        return self._part(self.end)

    def unanswered(self) -> None:
        """Wait a moment for another link. Raises NoWorld when that has been too long, or Interrupted."""
        self._notice(gone=True)
        self._inbox.next(ASK_AGAIN_S)
        self._check_patience()

    def _notice(self, *, gone: bool) -> None:
        """Tell once that the world has gone: its sign of life may have ended before it was seen."""
        if gone and not self._gone:
            self._inbox.say(f"the world has gone; waiting {self._silence:g} s for it")
        self._gone = gone

    def attach(self, link: zenoh.Session) -> None:
        """From now on, this is the session over which it hears and is heard."""
        self._link.attach(link)

    def _next(self, until: float | None) -> Arrival:
        """What arrives next, NOTHING after `until`; says again what is asked for, once that is due.

        Raises LinkLost if the world is silent for too long.
        """
        if self._again is not None and time.monotonic() >= self._again:
            self._say_again()
        return self._link.next(min(until or self._give_up, self._give_up, self._again or self._give_up))

    def _check_patience(self) -> None:
        if time.monotonic() > self._give_up:
            raise NoWorld(f"nothing heard from the world for {self._silence:g} s")

    @property
    def _known(self) -> int:
        """The tick of its latest Observation."""
        return self._observation.tick if self._observation is not None else -1

    # --- what arrives ---

    def _accepted(self, arrival: Arrival) -> Observation | MissionEnd | None:
        try:
            message: Observation | MissionEnd = decode(arrival.frame, Observation | MissionEnd)
        except MalformedFrame as error:
            self._inbox.refuse(arrival, error)
            return None
        if isinstance(message, Observation) and message.robot != self._id:
            self._inbox.refuse(arrival, f"it is meant for '{message.robot}'")
            return None
        return message

    def _is_over(self, end: MissionEnd) -> bool:
        return end.tick == self._known or self._disorder.persists(end, ENDED_S)

    def _on_sense(self, observation: Observation, frame: bytes) -> bool:
        """Whether it is in step. Raises NoWorld."""
        if observation.tick == self._known + 1:
            if self._on_kill_point is not None:
                self._on_kill_point("observation", observation.tick)
            if self._due is not None:  # the world goes on; what has not come is missed
                self._due = 0.0
                self._decide_when_all_is_heard()
            self._disorder.over()
            self._observation = observation
            self._set_due()
            told = self._robot.observation(observation, frame)
            if told is not None:
                self._told.append(told)
                self._send_report(told)
            return True
        if observation == self._observation:
            self._disorder.over()
            self._say_again()
            return True
        self._disorder.observation(observation, self._known)
        return False

    def _set_due(self) -> None:
        if self._tick_s is not None and self._observation is not None:
            in_field = any(contact.heard is None for contact in self._observation.contacts)
            self._due = time.monotonic() + (FIELD_SHARE if in_field else REPORT_SHARE) * self._tick_s

    # --- what is done about it ---

    def _decide_when_all_is_heard(self) -> None:
        if self._observation is None or self._robot.command is not None:
            return
        heard: list[FramedReport] = []
        missed: list[str] = []
        for contact in self._observation.contacts:
            listed = contact.heard
            if listed is None:
                heard += self._post.waiting(self._observation.tick)
                listed = () if self._post.of(self._observation.tick) else (self._observation.tick,)
            for tick in listed:
                told = self._post.of(tick)
                if told is not None:
                    heard.append(told)
                elif self._due is None or time.monotonic() < self._due:
                    return
                else:
                    missed.append(contact.peer)
        command = self._robot.decide(heard, missed)
        self._due = None
        self._send_drive(command.tick)
        if self._robot.journaled or self._link.estimate_wanted:
            estimate = self._robot.estimate()
            if self._link.estimate_wanted:
                self._link.estimate(estimate)
        self._post.list(told.report.tick for told in heard)
        for contact in self._observation.contacts:
            self._post.list(contact.damaged)
        self._post.forget(command.tick - REPORTS_KEPT, self._robot.unheard)

    def _send_report(self, told: FramedReport) -> None:
        self._link.report(told.frame)
        if self._on_kill_point is not None:
            self._on_kill_point("report", told.report.tick)

    def _send_drive(self, tick: int) -> None:
        if self._on_kill_point is not None:
            self._on_kill_point("journal", tick)
        self._link.command(self._robot.drive_frame)
        if self._on_kill_point is not None:
            self._on_kill_point("command", tick)

    def _say_again(self) -> None:
        """All that whoever was started again may have lost: earlier reports, too, if the peer is near."""
        now = time.monotonic()
        if now < self._said_again + AGAIN_S:
            self._again = self._said_again + AGAIN_S
            return
        self._said_again, self._again = now, None
        if self._robot.told is not None:
            oldest = self._robot.told.report.tick - REPORTS_TOLD
            for told in self._told:
                if told.report.tick > oldest:
                    self._send_report(told)
        if self._robot.command is not None:
            self._send_drive(self._robot.command.tick)

    def _conclude(self, end: MissionEnd) -> None:
        self._post.forget(end.tick + REPORTS_KEPT + 1, self._robot.unheard)
        self._final_report = self._robot.final_report(
            end,
            reports_refused=self._inbox.refused["report"],
            reports_unheard=self._post.unheard,
            frames_refused=self._inbox.refused.total(),
        )
        self.end = end
        self._give_up = time.monotonic() + self._timeout

    def _part(self, end: MissionEnd) -> MissionEnd:
        """Answer the MissionEnd, as often as it is said, until the world says that it has the answer on record."""
        assert self._final_report is not None
        frame = encode(self._final_report)
        self._link.command(frame)
        self._disorder.over()
        gone = False
        while (now := time.monotonic()) < self._give_up:
            arrival = self._next(now + LAST_WORD_S if gone else None)
            if arrival.topic == "observation":
                if arrival.frame == frame:
                    break
                message = self._accepted(arrival)
                if isinstance(message, Observation):
                    self._disorder.observation(message, end.tick)
                elif message is not None:
                    self._disorder.over()
                    self._link.command(frame)
            elif arrival.topic == "alive":
                self._disorder.world(there=True)
            elif arrival.topic == "gone":
                self._disorder.world(there=False)
                gone = True  # what it said before may be on its way
            elif gone and arrival.topic == "nothing":
                self._inbox.say(
                    f"the world has gone after its MissionEnd; waiting {self._timeout:g} s for it"
                )
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

    Raises NoWorld if there is no world and no MissionEnd is known; Unwelcome; CannotListen; Interrupted.
    """
    process: AgentProcess | None = None
    linked = False
    while True:
        try:
            unanswered = search.go_on if process is None else process.unanswered
            with session.open_session(endpoints, unanswered, session.CLOSE_TIMEOUT_S) as link:
                if not linked:
                    on_first_link()
                    linked = True
                if process is None:
                    joined = join(link, run, robot, search)
                    if joined is None:  # a session that has lost its link finds nothing; a new one may
                        continue
                    process = start(*joined)
                    process.attach(link)
                    on_joined(*joined)
                else:
                    process.attach(link)
                found = process.play()
                on_end()
                return found
        except WorldLinkLost:
            continue
        except NoWorld:
            end = process.end if process is not None else end
            if end is None:
                raise
            return end
