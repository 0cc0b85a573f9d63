"""The agent's process: Zenoh in, journal, planner, Zenoh out. It knows nothing but what it is told.

It reacts to what arrives and never steps twice: a Sense heard again makes it send again what it
answered, so whatever is lost, late or doubled costs time and changes nothing. So does a process that is
killed, its peer's or the world's: whoever is started again is told again what it must know. So do a process
that is stopped, and a link that goes down: one over which nothing comes any more is replaced.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from agent import radio
from agent.joining import ASK_AGAIN_S, NoWorld
from agent.memory import REPORTS_KEPT, REPORTS_TOLD, Memory
from agent.robot import Told
from protocol import keys, session
from protocol.inbox import NOTHING, Arrival, Inbox
from protocol.messages import End, Report, Sense
from protocol.wire import MAX_REPORT_BYTES, MalformedFrame, decode, encode

REPORT_SHARE = 0.5
"""of a tick in real time: how long to wait for the peer's report"""
LAST_WORD_S = 0.5
"""how long what the world has said may outlast its sign of life"""
SILENCE_S = 3.0
"""a link over which the world has said nothing for so long is replaced, though Zenoh gives one up after
`session.LEASE_S` and connects again: now and then nothing comes over such a link, for good"""
BEHIND_S = 3.0
"""how long the world must go on saying what is out of step, and nothing else, to be believed: a stranger may
say anything, and in real time what lies between may be outstanding"""
ENDED_S = 1.0
"""how long an End of another tick must be said; the world says its own for twice as long, or more"""
AGAIN_S = 0.05
"""how often to say again what was said: to one frame may answer as many as there are reports to tell"""


class LinkLost(Exception):
    """Nothing comes over this link any more; over another the world may be there."""


class AgentProcess:
    """One robot in one run, over one link after the other."""

    def __init__(
        self,
        memory: Memory,
        run: str,
        inbox: Inbox,
        *,
        patience: float = 30.0,
        reached: Callable[[str, int], None] | None = None,
    ) -> None:
        """`patience` (s) bounds the wait for the world; `reached` is told how far each tick has come."""
        briefing = memory.briefing
        self._id = briefing.robot
        self._peer = briefing.peer
        self._run = run
        self._inbox = inbox
        self._patience = patience
        self._tick_s = briefing.tick_s
        self._silence = patience + (self._tick_s or 0.0)
        """how long to wait for something new from the world"""
        self._give_up = time.monotonic() + self._silence
        self._reached = reached
        self._robot = memory.robot
        self._sense = memory.sense
        """the latest"""
        self._due: float | None = None
        """in real time: when to go on without the reports that it lists"""
        if self._sense is not None and self._robot.drive is None:
            self._set_due()
        self._odd: tuple[Sense | End, float] | None = None
        """what has been said out of step, with nothing in step since; and since when"""
        self._world_there = True
        self._said_again = 0.0
        """when all was last said again"""
        self._again: float | None = None
        """when to do so once more, if it was asked for too soon"""
        self._told = deque(memory.told, maxlen=REPORTS_TOLD)
        """its own latest reports"""
        self._reports = {told.report.tick: told for told in memory.heard}
        """the peer's, by tick, as they came"""
        self._listed = set(self._reports)
        """those of them that a Sense has listed"""
        self._unheard = 0
        """those that went without"""
        self._estimate_wanted = False
        self.end: End | None = memory.end if memory.farewell is not None else None
        """once the world has said it"""
        self._farewell = memory.farewell

    def play(self) -> End:
        """The run over the link that it is attached to, to its End.

        Raises LinkLost; NoWorld; or Interrupted when told to stop.
        """
        while self.end is None:
            arrival = self._next(self._due)
            match arrival.topic:
                case "sense":
                    message = self._accepted(arrival)
                    if isinstance(message, End) and self._is_over(message):
                        self._conclude(message)
                    elif isinstance(message, Sense) and self._on_sense(message, arrival.frame):
                        self._give_up = time.monotonic() + self._silence
                case "report":
                    self._on_report(arrival)
                case "gone" | "alive":
                    self._world_there, self._odd = arrival.topic == "alive", None
                    if not self._world_there:
                        self._inbox.say(f"the world has gone; waiting {self._silence:g} s for it")
                case _:
                    pass
            if self.end is None:
                self._decide_when_all_is_heard()
                self._check_patience()
        return self._part(self.end)

    def unanswered(self) -> None:
        """Wait a moment for another link. Raises NoWorld when that has been too long, or Interrupted."""
        self._inbox.next(ASK_AGAIN_S)
        self._check_patience()

    # --- the link ---

    def attach(self, link: zenoh.Session) -> None:
        """From now on, this is the link over which it hears and is heard."""
        me, peer, run = self._id, self._peer, self._run
        self._drive = session.publisher(link, keys.drive(run, me))
        self._report = session.publisher(link, keys.report(run, me, peer))
        self._estimate = session.publisher(link, keys.estimate(run, me))
        session.on_matching(self._estimate, self._want_estimate)
        session.subscribe(link, keys.sense(run, me), self._inbox, "sense")
        session.subscribe(link, keys.report(run, peer, me), self._inbox, "report")
        session.watch_liveliness(link, keys.world_alive(run), self._inbox)
        self._show_alive = partial(session.show_alive, link, keys.robot_alive(run, me))
        self._token = self._show_alive()
        self._heard_at = time.monotonic()

    def _next(self, until: float | None) -> Arrival:
        """What arrives next, NOTHING after `until`; says again what is asked for, once that is due.

        Raises LinkLost if the world is silent for too long.
        """
        now = time.monotonic()
        if self._again is not None and now >= self._again:
            self._say_again()
        lost = self._heard_at + SILENCE_S + (self._tick_s or 0.0)
        first = min(until or self._give_up, self._give_up, lost, self._again or lost)
        arrival = self._inbox.next(first - now)
        if arrival.topic == "sense":
            self._heard_at = time.monotonic()
        elif arrival is NOTHING and time.monotonic() >= lost:
            raise LinkLost
        return arrival

    def _check_patience(self) -> None:
        if time.monotonic() > self._give_up:
            raise NoWorld(f"nothing heard from the world for {self._silence:g} s")

    @property
    def _known(self) -> int:
        """The tick of its latest Sense."""
        return self._sense.tick if self._sense is not None else -1

    # --- what arrives ---

    def _accepted(self, arrival: Arrival) -> Sense | End | None:
        try:
            message: Sense | End = decode(arrival.frame, Sense | End)
        except MalformedFrame as error:
            self._inbox.refuse(arrival, error)
            return None
        if isinstance(message, Sense) and message.robot != self._id:
            self._inbox.refuse(arrival, f"it is meant for '{message.robot}'")
            return None
        return message

    def _is_over(self, end: End) -> bool:
        return end.tick == self._known or self._persists(end, ENDED_S)

    def _on_sense(self, sense: Sense, frame: bytes) -> bool:
        """Whether it is in step. Raises NoWorld."""
        if sense.tick == self._known + 1:
            if self._reached is not None:
                self._reached("sense", sense.tick)
            if self._due is not None:  # the world goes on; what has not come is missed
                self._due = 0.0
                self._decide_when_all_is_heard()
            self._odd = None
            self._sense = sense
            self._set_due()
            told = self._robot.sense(sense, frame)
            if told is not None:
                self._told.append(told)
                self._send_report(told)
            return True
        if sense == self._sense:
            self._odd = None
            self._say_again()
            return True
        self._out_of_step(sense, self._known)
        return False

    def _out_of_step(self, sense: Sense, known: int) -> None:
        """The world is elsewhere, if it stays there: one of the two has lost its past, or comes too late.

        In real time it tells what lies between. Raises NoWorld.
        """
        tick = sense.tick
        if self._tick_s is not None and tick < known:
            return  # told once more of what was missed
        if self._tick_s is not None and tick > known and self._odd is None:
            self._appear()  # who appears is told what it has missed
        if not self._persists(sense, BEHIND_S):
            return
        if tick == known:
            raise NoWorld(
                f"the record is another run's: in this one, {self._id} senses otherwise at tick {tick}"
            )
        late = "too late" if tick > known else "started again without its record"
        raise NoWorld(f"{late}: the world is at tick {tick}, {self._id} knows it up to {known}")

    def _persists(self, message: Sense | End, bound_s: float) -> bool:
        """Whether the world has said `message`, and nothing in step, for `bound_s`; until then it is refused.

        In lockstep it would say the same over and over; in real time its Senses go on.
        """
        now = time.monotonic()
        goes_on = self._tick_s is not None and isinstance(message, Sense)
        if self._odd is None or not (message == self._odd[0] or goes_on):
            self._odd = message, now
        if self._world_there and now - self._odd[1] >= bound_s:
            return True
        if not goes_on:
            self._inbox.refused["sense"] += 1  # it is told once it is believed
        return False

    def _appear(self) -> None:
        """Go and come, as the world sees it."""
        gone: Any = self._token  # its method is not typed
        gone.undeclare()
        self._token = self._show_alive()

    def _set_due(self) -> None:
        if self._tick_s is not None:
            self._due = time.monotonic() + REPORT_SHARE * self._tick_s

    def _on_report(self, arrival: Arrival) -> None:
        try:
            report = decode(arrival.frame, Report, MAX_REPORT_BYTES)
        except MalformedFrame as error:
            self._inbox.refuse(arrival, error)
            return
        wrong = radio.contradiction(report)
        if report.robot != keys.robot_of(arrival.key):
            wrong = f"it says it is from '{report.robot}'"
        if wrong is not None:
            self._inbox.refuse(arrival, wrong)
            return
        if self._tick_s is None and report.tick > self._known + 1:
            self._inbox.refuse(arrival, "it is of a tick to come")
        elif abs(report.tick - max(self._known, 0)) > REPORTS_KEPT:
            self._unheard += 1
        elif self._reports.setdefault(report.tick, Told(report, arrival.frame)).frame != arrival.frame:
            self._inbox.refuse(arrival, "it was told otherwise before")

    # --- what is done about it ---

    def _decide_when_all_is_heard(self) -> None:
        if self._sense is None or self._robot.drive is not None:
            return
        heard: list[Told] = []
        missed: list[str] = []
        for contact in self._sense.contacts:
            for tick in contact.heard:
                told = self._reports.get(tick)
                if told is not None:
                    heard.append(told)
                elif self._due is None or time.monotonic() < self._due:
                    return
                else:
                    missed.append(contact.peer)
        drive = self._robot.decide(heard, missed)
        self._due = None
        self._send_drive(drive.tick)
        if self._robot.journaled or self._estimate_wanted:
            estimate = self._robot.estimate()
            if self._estimate_wanted:
                self._estimate.put(estimate)
        self._listed.update(told.report.tick for told in heard)
        self._listed.update(*[contact.damaged for contact in self._sense.contacts])
        self._forget_reports(before=drive.tick - REPORTS_KEPT)

    def _forget_reports(self, before: int) -> None:
        """Those of ticks `before`, counting what nobody has asked for."""
        for tick in [tick for tick in self._reports if tick < before]:
            del self._reports[tick]
            self._unheard += tick not in self._listed and tick not in self._robot.unheard
            self._listed.discard(tick)

    def _send_report(self, told: Told) -> None:
        self._report.put(told.frame)
        if self._reached is not None:
            self._reached("report", told.report.tick)

    def _send_drive(self, tick: int) -> None:
        if self._reached is not None:
            self._reached("journal", tick)
        self._drive.put(self._robot.drive_frame)
        if self._reached is not None:
            self._reached("drive", tick)

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
        if self._robot.drive is not None:
            self._send_drive(self._robot.drive.tick)

    def _conclude(self, end: End) -> None:
        self._forget_reports(before=end.tick + REPORTS_KEPT + 1)
        self._farewell = self._robot.farewell(
            end,
            reports_refused=self._inbox.refused["report"],
            reports_unheard=self._unheard,
            frames_refused=self._inbox.refused.total(),
        )
        self.end = end
        self._give_up = time.monotonic() + self._patience

    def _part(self, end: End) -> End:
        """Answer the End, as often as it is said, until the world says that it has the answer on record."""
        assert self._farewell is not None
        frame = encode(self._farewell)
        self._drive.put(frame)
        self._odd = None
        gone = False
        while (now := time.monotonic()) < self._give_up:
            arrival = self._next(now + LAST_WORD_S if gone else None)
            if arrival.topic == "sense":
                if arrival.frame == frame:
                    break
                message = self._accepted(arrival)
                if isinstance(message, Sense):
                    self._out_of_step(message, end.tick)
                elif message is not None:
                    self._odd = None
                    self._drive.put(frame)
            elif arrival.topic == "alive":
                self._world_there, self._odd = True, None
            elif arrival.topic == "gone":
                self._world_there = False
                gone = True  # what it said before may be on its way
            elif gone and arrival.topic == "nothing":
                self._inbox.say(f"the world has gone after its End; waiting {self._patience:g} s for it")
                gone = False
        return end

    def _want_estimate(self, wanted: bool) -> None:
        self._estimate_wanted = wanted
